"""Rigs by name: built in, from an installed package, or as `package.module:factory`.

A package from outside offers rigs through the entry-point group `unglare.rigs`; each entry is a callable
that takes a mapping of options and returns a `Rig`. Nothing of a package is imported until its rig is opened,
so one that is broken doesn't stop the others.
"""

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from backend.devices.errors import RigConfigError, RigNotFoundError
from backend.devices.plug_ins import (
    IMPORT_S,
    LISTED_S,
    call_plug_in,
    lacking,
    load_plug_in,
    package_of,
    plug_ins,
)
from backend.devices.protocols import Rig

GROUP = "unglare.rigs"
DEFAULT_METHOD = "hdr-fringe"
_BUILT_IN = {
    "simulated": "backend.devices.sim:create_rig",
    "sim-lcd": "backend.devices.sim:create_lcd_rig",
}

_REQUIRED = (
    *("name", "info", "cameras", "projector", "facts", "calibration"),
    *("open", "close", "__enter__", "__exit__"),
)


@dataclass(frozen=True)
class RigEntry:
    """A rig that can be opened by name."""

    name: str
    package: str
    """Distribution that it comes from, with version."""


def available_rigs() -> tuple[RigEntry, ...]:
    """Return the rigs that have a name, the built-in one first; nothing is imported."""
    built_in = (RigEntry(name, "unglare") for name in _BUILT_IN)
    entries = plug_ins(GROUP).values()
    return (
        *built_in,
        *(RigEntry(e.name, package_of(e)) for e in entries if e.name not in _BUILT_IN),
    )


def open_rig(name: str, options: Mapping[str, object] | None = None) -> Rig:
    """Make a rig; its devices are opened by `Rig.open` or by entering it.

    Parameters
    ----------
    name
        `simulated`, a name from `available_rigs`, or `package.module:factory`.
    options
        What its factory takes; for `simulated` see `SimulatedRigConfig`.

    Raises
    ------
    RigNotFoundError
        If there is no such rig, module or factory.
    RigConfigError
        If the factory refuses the options or doesn't return a rig.
    """
    factory = _factory(name)
    rig = call_plug_in(f"rig {name}: its factory", lambda: factory(dict(options or {})))
    missing = lacking(rig, _REQUIRED)
    if missing:
        raise RigConfigError(
            f"rig {name}: its factory returned a {type(rig).__name__} without {missing};"
            " see backend.devices.protocols.Rig"
        )
    opened: Rig = rig
    return opened


def options_schema(name: str) -> dict[str, Any]:
    """Return the JSON schema of a rig's options, empty where its factory doesn't say.

    A factory says it by an attribute `options_model`: the pydantic model of the mapping that it takes. Beside the
    properties the schema may hold a `title`, `methods`, the methods that the rig is made for, and
    `not_for_methods`; its property `scene` may have a `pattern` that tells whose scene a name is.

    Raises
    ------
    RigNotFoundError
        If there is no such rig, module or factory.
    RigConfigError
        If the factory describes its options by what is no pydantic model.
    """
    return schema_of(f"rig {name}: its factory's options_model", _factory(name, LISTED_S))


def schema_of(what: str, factory: object) -> dict[str, Any]:
    """Return the JSON schema of the options that a factory of a rig or driver takes, empty where it doesn't say.

    Raises
    ------
    RigConfigError
        If its `options_model` is no pydantic model.
    """
    model = getattr(factory, "options_model", None)
    if model is None:
        return {}
    schema = call_plug_in(what, lambda: model.model_json_schema(), "it has to be a pydantic model")
    return dict(schema)


def rig_for(scene: str | None, method: str) -> str:
    """Return the built-in rig that a scene belongs to, or without a scene the one that a method is made for.

    Examples
    --------
    >>> rig_for("plane", "hdr-fringe"), rig_for("mirror-flat", "fringe-reflection")
    ('simulated', 'sim-lcd')
    """
    schemas = {name: options_schema(name) for name in _BUILT_IN}
    for name, schema in schemas.items():
        pattern = schema["properties"]["scene"].get("pattern")
        made_for = method in schema.get("methods", ())
        if (pattern and re.search(pattern, scene)) if scene else made_for:
            return name
    return next(iter(_BUILT_IN))


def method_for(rig: str) -> str:
    """Return the method that a rig says it is made for first, else hdr-fringe; a rig file says nothing.

    Examples
    --------
    >>> method_for("simulated"), method_for("sim-lcd")
    ('hdr-fringe', 'fringe-reflection')
    """
    methods = (
        options_schema(rig).get("methods") if rig in _BUILT_IN or rig in plug_ins(GROUP) else None
    )
    return str(methods[0]) if methods else DEFAULT_METHOD


def _factory(name: str, within_s: float = IMPORT_S) -> Callable[[Mapping[str, object]], Any]:
    entry = None if name in _BUILT_IN else plug_ins(GROUP).get(name)
    if entry is not None:
        return _callable(name, load_plug_in(entry, within_s))
    place = _BUILT_IN.get(name, name)
    if ":" in place:
        module, _, attribute = place.partition(":")
        return _callable(name, _imported(name, module, attribute))
    names = ", ".join(rig.name for rig in available_rigs())
    raise RigNotFoundError(
        f"there is no rig {name!r}; choose {names}, or give package.module:factory"
    )


def _imported(name: str, module: str, attribute: str) -> object:
    try:
        return getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:
        # Importing a third party's module may fail in any way; the cause keeps its traceback.
        raise RigNotFoundError(
            f"rig {name} can't be loaded ({type(error).__name__}: {error}); check that its package is installed"
        ) from error


def _callable(name: str, factory: object) -> Callable[[Mapping[str, object]], Any]:
    if not callable(factory):
        raise RigNotFoundError(
            f"rig {name} is a {type(factory).__name__}, not a function that makes a rig; check its name"
        )
    return factory
