"""Which rigs a scan can be made with."""

from functools import lru_cache

from backend.contract.rigs import RigOffer
from backend.devices import loading
from backend.domain.errors import UnglareError


def offer_rigs() -> tuple[RigOffer, ...]:
    """Describe every rig that has a name. One that can't be loaded is offered with the reason why not."""
    return tuple(_offer(entry.name, entry.package) for entry in loading.available_rigs())


@lru_cache(maxsize=64)
def _offer(name: str, package: str) -> RigOffer:
    title = name.replace("-", " ").replace("_", " ").capitalize()
    offer = RigOffer(name=name, title=title, doc=package, options_schema={})
    try:
        return offer.model_copy(update={"options_schema": loading.options_schema(name)})
    except UnglareError as error:
        return offer.model_copy(update={"error": error.sentence})
