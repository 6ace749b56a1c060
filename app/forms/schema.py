"""From a JSON schema to settings that a form can show, and from typed text back to values."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from app.numbers import heading, number

Kind = Literal["number", "integer", "switch", "choice", "numbers", "text", "document"]

AUTOMATIC = "auto"
_LONG, _FIRST = 10, 6
_EDGE = 1e-9
"""How far a control keeps from a limit that is excluded."""


class UnreadableError(Exception):
    """What was typed is no value for this setting; the text says why."""


@dataclass(frozen=True)
class Setting:
    """One setting as a form shows it."""

    name: str
    title: str
    kind: Kind
    doc: str = ""
    unit: str = ""
    default: Any = None
    optional: bool = False
    """True if None is allowed: the stage chooses."""
    choices: tuple[Any, ...] = ()
    low: float | None = None
    high: float | None = None
    advanced: bool = False
    examples: tuple[str, ...] = ()
    """What may be typed, where the schema says so."""

    @property
    def label(self) -> str:
        """Title with unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def limits(self) -> str:
        """The allowed range in words, empty if there is none."""
        if self.low is None and self.high is None:
            return ""
        if self.low is None:
            return f"at most {number(self.high)}"
        if self.high is None:
            return f"at least {number(self.low)}"
        return f"{number(self.low)} to {number(self.high)}"

    @property
    def typed(self) -> bool:
        """True if the control takes text: lists, documents, and whatever may be automatic."""
        return self.kind in ("numbers", "text", "document") or (
            self.optional and self.kind in ("number", "integer")
        )


def read_schema(schema: Mapping[str, Any]) -> tuple[Setting, ...]:
    """Return the settings of a schema, in its order.

    In a long schema that calls nothing advanced, what comes after the first few is.
    """
    shared = schema.get("$defs", {})
    settings = tuple(_setting(n, p, shared) for n, p in schema.get("properties", {}).items())
    if len(settings) <= _LONG or any(s.advanced for s in settings):
        return settings
    return tuple(replace(s, advanced=i >= _FIRST) for i, s in enumerate(settings))


def _setting(name: str, described: Mapping[str, Any], shared: Mapping[str, Any]) -> Setting:
    facts = _resolved(described, shared)
    variants = [_resolved(v, shared) for v in facts.get("anyOf", [])]
    optional = any(v.get("type") == "null" for v in variants)
    kinds = [v for v in variants if v.get("type") != "null"]
    core = {**facts, **kinds[0]} if len(kinds) == 1 else facts
    # Titles and descriptions of the setting win over those of its type.
    core = {**core, **{k: facts[k] for k in ("title", "description", "default") if k in facts}}
    title, unit = _title(name, core)
    items = _resolved(core.get("items") or {}, shared) if core.get("type") == "array" else core
    return Setting(
        name=name,
        title=title,
        kind=_kind(core, shared, ambiguous=len(kinds) > 1),
        doc=str(core.get("description") or ""),
        unit=unit,
        default=core.get("default"),
        optional=optional,
        choices=_choices(core),
        low=_limit(items, "minimum", "exclusiveMinimum", +_EDGE),
        high=_limit(items, "maximum", "exclusiveMaximum", -_EDGE),
        advanced=bool(core.get("advanced")),
        examples=tuple(str(e) for e in core.get("examples", ())),
    )


def _title(name: str, core: Mapping[str, Any]) -> tuple[str, str]:
    """Return title and unit; where nobody wrote a title, the name has both."""
    title, unit = str(core.get("title") or ""), str(core.get("unit") or "")
    made_up = {"", name, name.replace("_", " ").title()}  # pydantic's own way to make a title
    if title not in made_up:
        return title, unit
    words, named_unit = heading(name)
    return words[:1].upper() + words[1:], unit or named_unit


def _resolved(described: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    facts = dict(described)
    references = [facts.pop("$ref", None), *(p.get("$ref") for p in facts.pop("allOf", []))]
    for reference in references:
        if reference:
            facts = {**shared.get(str(reference).rsplit("/", 1)[-1], {}), **facts}
    return facts


def _choices(core: Mapping[str, Any]) -> tuple[Any, ...]:
    return (core["const"],) if "const" in core else tuple(core.get("enum", ()))


def _kind(core: Mapping[str, Any], shared: Mapping[str, Any], *, ambiguous: bool) -> Kind:
    if ambiguous:
        return "document"
    if _choices(core):
        return "choice"
    simple: dict[str, Kind] = {
        "number": "number", "integer": "integer", "boolean": "switch", "string": "text",
    }  # fmt: skip
    if core.get("type") == "array":
        parts = [core["items"]] if core.get("items") else core.get("prefixItems", [])
        types = {_resolved(p, shared).get("type") for p in parts}
        return "numbers" if types and types <= {"number", "integer"} else "document"
    return simple.get(str(core.get("type")), "document")


def _limit(facts: Mapping[str, Any], inclusive: str, exclusive: str, edge: float) -> float | None:
    if inclusive in facts:
        return float(facts[inclusive])
    if exclusive in facts:
        return float(facts[exclusive]) + edge
    return None


def write(setting: Setting, value: Any, chosen: Any = None) -> str:
    """Return the text that stands for a value in a text control.

    Examples
    --------
    >>> write(Setting("t", "t", "number", optional=True), None, 41.6667)
    'auto: 41.67'
    """
    if value is None:
        return AUTOMATIC if chosen is None else f"{AUTOMATIC}: {_plainly(chosen)}"
    if setting.kind == "document":
        return json.dumps(value)
    return _plainly(value)


def _plainly(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(_plainly(v) for v in value)
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.10g}"
    return str(value)


def read(setting: Setting, text: str, chosen: Any = None) -> Any:
    """Return the value that was typed.

    Parameters
    ----------
    chosen
        What the stage chose by itself: as long as it stands behind "auto:" the setting stays automatic.

    Raises
    ------
    UnreadableError
        If the text is no value of this setting.
    """
    words = text.strip()
    if setting.optional and words in ("", AUTOMATIC, write(setting, None, chosen)):
        return None
    words = words.removeprefix(f"{AUTOMATIC}:").strip()
    if setting.kind == "text":
        return words
    if setting.kind == "document":
        return _document(words)
    if setting.kind == "numbers":
        return [
            _number(setting, part)
            for part in words.replace(";", ",").replace(" ", ",").split(",")
            if part
        ]
    return _number(setting, words)


def _document(words: str) -> Any:
    try:
        return json.loads(words)
    except ValueError:
        raise UnreadableError(f"“{words}” can't be read; write it as JSON") from None


def _number(setting: Setting, words: str) -> float | int:
    try:
        value = float(words)
    except ValueError:
        raise UnreadableError(f"“{words}” is not a number") from None
    outside = (setting.low is not None and value < setting.low) or (
        setting.high is not None and value > setting.high
    )
    if outside or not math.isfinite(value):
        raise UnreadableError(f"{number(value)} is out of range: {setting.limits or 'finite'}")
    return int(value) if setting.kind == "integer" and value.is_integer() else value
