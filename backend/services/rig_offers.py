"""Which rigs a scan can be made with."""

from backend.contract.rigs import RigOffer
from backend.devices import loading


def offer_rigs() -> tuple[RigOffer, ...]:
    """Describe every rig that has a name. One that can't be loaded is offered with the reason why not.

    A rig's factory may carry `options_model`, a pydantic model of what it takes: the form is made of it.
    """
    return tuple(_offer(entry.name, entry.package) for entry in loading.available_rigs())


def _offer(name: str, package: str) -> RigOffer:
    return RigOffer(name=name, title=name, doc=package, options_schema={})
