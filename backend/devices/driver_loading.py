"""Drivers by name: built in, or from an installed package.

A package from outside offers drivers through the entry-point groups `unglare.cameras` and `unglare.projectors`;
each entry is a callable that takes the device's name in its rig and a mapping of options. Nothing of a package
is imported until a rig with its driver is opened, so one that is broken doesn't stop the others.
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from backend.devices.errors import RigConfigError
from backend.devices.foreign import is_ours, misfit
from backend.devices.options import meant, shortened
from backend.devices.pages import PageDesk
from backend.devices.plug_ins import (
    IMPORT_S,
    call_plug_in,
    lacking,
    load_plug_in,
    package_of,
    plug_ins,
)
from backend.devices.protocols import Camera, Projector
from backend.domain.errors import UnglareError

CAMERAS = "unglare.cameras"
PROJECTORS = "unglare.projectors"

_DRIVERS = "backend.devices.drivers"
_BUILT_IN = {
    CAMERAS: {
        "aravis": f"{_DRIVERS}.aravis_camera:create_camera",
        "pylon": f"{_DRIVERS}.pylon_camera:create_camera",
        "gentl": f"{_DRIVERS}.gentl_camera:create_camera",
        "video": f"{_DRIVERS}.video_camera:create_camera",
    },
    PROJECTORS: {
        "page": f"{_DRIVERS}.page_projector:create_projector",
        "dlpc350": f"{_DRIVERS}.dlpc350:create_projector",
        "none": f"{_DRIVERS}.no_projector:create_projector",
    },
}

_DEVICE = ("name", "info", "state", "open", "close", "reconnect", "capabilities")
_REQUIRED = {
    CAMERAS: (*_DEVICE, "settings", "configure", "arm", "trigger", "get_frame", "disarm", "abort"),
    PROJECTORS: (*_DEVICE, "load", "show", "blank"),
}
_PROTOCOLS: dict[str, type] = {CAMERAS: Camera, PROJECTORS: Projector}


@dataclass(frozen=True)
class DriverEntry:
    """A driver that rig files can name."""

    name: str
    package: str
    """Distribution that it comes from, with version."""


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
    return tuple(entry.name for entry in driver_entries(group))


def driver_entries(group: str) -> tuple[DriverEntry, ...]:
    """Return the drivers of `CAMERAS` or `PROJECTORS`, ours first; nothing is imported."""
    ours = (DriverEntry(name, "unglare") for name in _BUILT_IN[group])
    others = (
        DriverEntry(name, package_of(entry))
        for name, entry in plug_ins(group).items()
        if name not in _BUILT_IN[group]
    )
    return (*ours, *others)


def load_factory(
    group: str, name: str, driver: str, within_s: float = IMPORT_S
) -> Callable[..., Any]:
    """Import a driver and return its factory; `name` is what sentences call the device.

    A factory may have attributes: `options_model`, the pydantic model of the options that it takes, `library`, which
    raises a sentence where a library that the devices need is missing (`options.takes` sets both), and of a camera's
    `search`, a function that returns a `FoundCamera` for each camera it can see. Searching may
    broadcast: it is only called when an operator asks for it.

    Raises
    ------
    RigConfigError
        If there is no such driver or it can't be loaded.
    """
    factory = _imported(group, name, driver, within_s)
    if not callable(factory):
        raise RigConfigError(
            f"{name}: driver {driver} is a {type(factory).__name__}, not a function that makes a device; check its"
            " package"
        )
    made: Callable[..., Any] = factory
    return made


def missing_library(factory: Callable[..., Any]) -> str | None:
    """Return the sentence with the install command where the library that a driver needs isn't there."""
    look = getattr(factory, "library", None)
    try:
        if look is not None:
            call_plug_in("the driver's library", look, "install it anew")
    except UnglareError as error:
        return error.sentence
    return None


def _imported(group: str, name: str, driver: str, within_s: float) -> Any:
    entry, place = plug_ins(group).get(driver), _BUILT_IN[group].get(driver)
    if place is not None:
        module, _, attribute = place.partition(":")
        return getattr(importlib.import_module(module), attribute)
    if entry is not None:
        try:
            return load_plug_in(entry, within_s)
        except RigConfigError as error:
            raise RigConfigError(f"{name}: {error.sentence}") from error
    known = available_drivers(group)
    raise RigConfigError(
        f"{name}: there is no driver {shortened(repr(driver))}; choose {', '.join(known)}{meant(driver, known)}"
    )


def _made(group: str, name: str, driver: str, options: Mapping[str, Any], **more: object) -> Any:
    factory = load_factory(group, name, driver)
    made = call_plug_in(
        f"{name}: driver {driver}",
        lambda: factory(name, dict(options), **more),
        "check its options",
    )
    missing = lacking(made, _REQUIRED[group])
    if missing:
        raise RigConfigError(
            f"{name}: driver {driver} made a {type(made).__name__} without {missing}; see"
            f" backend.devices.protocols.{_PROTOCOLS[group].__name__}"
        )
    problem = "" if is_ours(made) else misfit(made, _PROTOCOLS[group])
    if problem:
        raise RigConfigError(
            f"{name}: driver {driver} made a {type(made).__name__} whose {problem}; see"
            f" backend.devices.protocols.{_PROTOCOLS[group].__name__}"
        )
    return made
