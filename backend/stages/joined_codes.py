"""One code per pixel from two looks: the first where it can be trusted, the second where that one can."""

from backend.domain.stage import stage
from backend.domain.states import Review
from backend.stages.code_joining import join
from backend.stages.edges import Codes
from backend.stages.second_look import SecondLook


@stage(title="Joined code", version=1, review=Review.ON_FAILURE)
def joined_codes(codes: Codes, second: SecondLook | None) -> Codes:
    """Take the code of the second look where light from two places spoils the first."""
    if second is None or second.codes is None:
        return codes
    return join(codes, second.codes, second.trusted)
