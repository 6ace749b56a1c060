"""One code per pixel from two looks: the first where it can be trusted, the second where that one can."""

from dataclasses import replace

from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.second_look import pulled_sigma
from backend.stages.code_joining import join
from backend.stages.edges import Codes
from backend.stages.second_look import SecondLook


@stage(title="Joined code", version=2, review=Review.ON_FAILURE)
def joined_codes(codes: Codes, second: SecondLook | None) -> Codes:
    """Take the code of the second look where light from two places spoils the first, and doubt what is left so."""
    if second is None:
        return codes
    doubted = {
        name: pulled_sigma(sigma_px, second.second_light[name], second.marked[name] > 0)
        for name, sigma_px in codes.sigma_px.items()
        if name in second.second_light
    }
    first = replace(codes, sigma_px={**codes.sigma_px, **doubted}) if doubted else codes
    return first if second.codes is None else join(first, second.codes, second.trusted)
