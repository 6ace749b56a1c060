"""Which rigs a scan can be made with."""

from functools import lru_cache

from backend.contract.rigs import RigOffer
from backend.devices import loading
from backend.devices.plug_ins import PlugInPendingError
from backend.devices.rig_file import RigFile
from backend.devices.rig_shelf import KeptRig, RigShelf
from backend.domain.errors import UnglareError


def offer_rigs() -> tuple[RigOffer, ...]:
    """Describe every rig that has a name. One that can't be loaded is offered with the reason why not."""
    return tuple(_offer(entry.name, entry.package) for entry in loading.available_rigs())


def offer_kept_rigs(shelf: RigShelf) -> tuple[RigOffer, ...]:
    """Describe the station's rig files; one that can't be used is offered with the reason why not."""
    return tuple(_kept(rig) for rig in shelf.kept())


def _kept(rig: KeptRig) -> RigOffer:
    offer = RigOffer(name=rig.name, title=_title(rig.name), doc=str(rig.path), options_schema={})
    try:
        file = RigFile.read(rig.path)
    except UnglareError as error:
        return offer.model_copy(update={"error": error.sentence})
    return offer.model_copy(update={"title": file.title or offer.title})


def _offer(name: str, package: str) -> RigOffer:
    """Describe a rig; a package that is still being imported is asked again the next time."""
    try:
        return _settled_offer(name, package)
    except PlugInPendingError as error:
        return RigOffer(
            name=name, title=_title(name), doc=package, options_schema={}, error=error.sentence
        )


@lru_cache(maxsize=64)
def _settled_offer(name: str, package: str) -> RigOffer:
    offer = RigOffer(name=name, title=_title(name), doc=package, options_schema={})
    try:
        schema = loading.options_schema(name)
    except PlugInPendingError:
        raise
    except UnglareError as error:
        return offer.model_copy(update={"error": error.sentence})
    named = str(schema.get("title", ""))
    # A title of one word is the options' class, which nobody named for operators.
    title = named if " " in named else offer.title
    return offer.model_copy(update={"options_schema": schema, "title": title})


def _title(name: str) -> str:
    return name.replace("-", " ").replace("_", " ").capitalize()
