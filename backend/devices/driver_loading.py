"""Drivers by name: built in, or from an installed package.

A package from outside offers drivers through the entry-point groups `unglare.cameras` and `unglare.projectors`;
each entry is a callable that takes the device's name in its rig and a mapping of options. Nothing of a package
is imported until a rig with its driver is opened, so one that is broken doesn't stop the others.
"""

import importlib
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from backend.devices.errors import RigConfigError
from backend.devices.pages import PageDesk
from backend.devices.protocols import Camera, Projector
from backend.domain.errors import UnglareError

CAMERAS = "unglare.cameras"
PROJECTORS = "unglare.projectors"

_DRIVERS = "backend.devices.drivers"
_BUILT_IN = {
    CAMERAS: {"aravis": f"{_DRIVERS}.aravis_camera:create_camera"},
    PROJECTORS: {"page": f"{_DRIVERS}.page_projector:create_projector"},
}


def make_camera(name: str, driver: str, options: Mapping[str, Any]) -> Camera:
    """Make a camera of a driver; nothing is opened yet.

    Raises
    ------
    RigConfigError
        If there is no such driver, it can't be loaded, or it refuses the options.
    """
    camera: Camera = _made(CAMERAS, name, driver, options)
    return camera


def make_projector(name: str, driver: str, options: Mapping[str, Any], desk: PageDesk) -> Projector:
    """Make a projector of a driver; nothing is opened yet. Built-in ones may need the projector pages.

    Raises
    ------
    RigConfigError
        If there is no such driver, it can't be loaded, or it refuses the options.
    """
    more = {"desk": desk} if driver in _BUILT_IN[PROJECTORS] else {}
    projector: Projector = _made(PROJECTORS, name, driver, options, **more)
    return projector


def available_drivers(group: str) -> tuple[str, ...]:
    """Return the drivers of `CAMERAS` or `PROJECTORS` that have a name; nothing is imported."""
    return (*_BUILT_IN[group], *sorted(_entries(group).keys() - _BUILT_IN[group].keys()))


def load_factory(group: str, name: str, driver: str) -> Callable[..., Any]:
    """Import a driver and return its factory; `name` is what sentences call the device.

    A factory may have attributes: `options_model`, the pydantic model of the options that it takes, and of a
    camera's `search`, a function that returns a `FoundCamera` for each camera it can see. Searching may
    broadcast: it is only called when an operator asks for it.

    Raises
    ------
    RigConfigError
        If there is no such driver or it can't be loaded.
    """
    entry = _entries(group).get(driver)
    place = _BUILT_IN[group].get(driver)
    try:
        if place is not None:
            module, _, attribute = place.partition(":")
            built_in: Callable[..., Any] = getattr(importlib.import_module(module), attribute)
            return built_in
        if entry is not None:
            from_package: Callable[..., Any] = entry.load()
            return from_package
    except Exception as error:
        raise RigConfigError(
            f"{name}: driver {driver} can't be loaded ({type(error).__name__}: {error}); check that its package is installed"
        ) from error
    known = ", ".join(available_drivers(group))
    raise RigConfigError(f"{name}: there is no driver {driver!r}; choose {known}")


def _made(group: str, name: str, driver: str, options: Mapping[str, Any], **more: object) -> Any:
    factory = load_factory(group, name, driver)
    try:
        return factory(name, dict(options), **more)
    except UnglareError:
        raise
    except Exception as error:
        # A third party's factory may raise anything; the cause keeps its traceback.
        raise RigConfigError(
            f"{name}: driver {driver} failed with {type(error).__name__}: {error}; check its options"
        ) from error


def _entries(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}
