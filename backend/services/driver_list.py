"""Which camera and projector drivers rig files can name, what each takes, and why one can't be used."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from backend.devices.driver_loading import (
    CAMERAS,
    PROJECTORS,
    driver_entries,
    load_factory,
    missing_library,
)
from backend.devices.loading import schema_of
from backend.devices.plug_ins import LISTED_S
from backend.domain.errors import NotFoundError, UnglareError


@dataclass(frozen=True)
class DriverOption:
    """One option, as a rig file gives it."""

    name: str
    values: str
    """What it may be, in words."""
    default: Any
    """None where it is required or has none."""
    required: bool
    text: str


@dataclass(frozen=True)
class ListedDriver:
    """One driver."""

    name: str
    kind: str
    """`camera` or `projector`."""
    package: str
    title: str
    problem: str | None
    """Why no device can be opened with it, with the way out; None: it can be used."""
    options: tuple[DriverOption, ...]
    schema: dict[str, Any]
    """The options as JSON schema."""


def list_drivers(name: str = "") -> tuple[ListedDriver, ...]:
    """Describe all drivers, or those of one name; this imports them.

    Raises
    ------
    NotFoundError
        If there is none of that name.
    """
    known = [(group, entry) for group in (CAMERAS, PROJECTORS) for entry in driver_entries(group)]
    chosen = [(group, entry) for group, entry in known if name in ("", entry.name)]
    if not chosen:
        names = ", ".join(dict.fromkeys(entry.name for _, entry in known))
        raise NotFoundError(f"There is no driver {name!r}; choose {names}.")
    return tuple(_listed(group, entry.name, entry.package) for group, entry in chosen)


def _listed(group: str, name: str, package: str) -> ListedDriver:
    kind = group.removeprefix("unglare.").removesuffix("s")
    try:
        factory = load_factory(group, kind, name, LISTED_S)
        schema = schema_of(f"driver {name}: its factory's options_model", factory)
    except UnglareError as error:
        sentence = error.sentence.removeprefix(f"{kind}: ")
        return ListedDriver(name, kind, package, "", sentence, (), {})
    title = str(schema.get("description", "")).partition("\n")[0]
    problem = missing_library(factory)
    return ListedDriver(name, kind, package, title, problem, tuple(_options(schema)), schema)


def _options(schema: dict[str, Any]) -> Iterator[DriverOption]:
    """List the options, those that are required first."""
    required = schema.get("required", ())
    properties = schema.get("properties", {})
    for name, described in sorted(properties.items(), key=lambda item: item[0] not in required):
        yield DriverOption(
            name=name,
            values=_values(described, schema.get("$defs", {})),
            default=_default(described),
            required=name in required,
            text=" ".join(str(described.get("description", "")).split()),
        )


def _default(described: dict[str, Any]) -> Any:
    default = described.get("default")
    if isinstance(default, list | tuple) and _values(described, {}).startswith("size"):
        return "x".join(map(str, default))
    return default


_WORDS = {"number": "number", "integer": "whole number", "boolean": "true or false"}


def _values(described: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Say what a value may be.

    Examples
    --------
    >>> _values({"anyOf": [{"type": "number", "minimum": 0, "maximum": 10}, {"type": "null"}]}, {})
    'number, 0 to 10'
    >>> _values({"enum": ["rising", "falling"], "type": "string"}, {})
    'rising or falling'
    """
    if "$ref" in described:
        return _values(definitions[str(described["$ref"]).rpartition("/")[2]], definitions)
    if "anyOf" in described:
        ways = [way for way in described["anyOf"] if way.get("type") != "null"]
        return " or ".join(dict.fromkeys(_values(way, definitions) for way in ways))
    if "const" in described or "enum" in described:
        return " or ".join(map(str, described.get("enum", [described.get("const")])))
    if described.get("type") == "array":
        return _values_of_array(described, definitions)
    kind = str(described.get("type", "value"))
    kind = "mapping" if kind == "object" else "text" if kind == "string" else _WORDS.get(kind, kind)
    return ", ".join(filter(None, (kind, _range(described))))


def _values_of_array(described: dict[str, Any], definitions: dict[str, Any]) -> str:
    items = described.get("prefixItems")
    if not items:
        return f"list of {_values(described.get('items', {}), definitions)}"
    if len(items) == 2 and {item.get("type") for item in items} == {"integer"}:
        return "size, e.g. 1280x800"
    return "[" + ", ".join(_values(item, definitions) for item in items) + "]"


def _range(described: dict[str, Any]) -> str:
    low, above = described.get("minimum"), described.get("exclusiveMinimum")
    high, below = described.get("maximum"), described.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"{low:.10g} to {high:.10g}"
    words = (("from", low), ("above", above), ("up to", high), ("below", below))
    return ", ".join(f"{word} {value:.10g}" for word, value in words if value is not None)
