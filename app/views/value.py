"""Numbers and texts: the stage's list of facts."""

from collections.abc import Iterable, Mapping
from typing import Any

from app.numbers import named
from backend.contract.scans import FieldView


def fact_rows(fields: Iterable[FieldView]) -> list[tuple[str, str]]:
    """Return title and value with unit of each field."""
    return [(str(f.hint.get("title") or f.name), _text(f)) for f in fields]


def _text(field: FieldView) -> str:
    unit, digits = str(field.hint.get("unit") or ""), int(field.hint.get("digits") or 4)
    if isinstance(field.value, Mapping):
        parts = (
            f"{name} {named(field.name, _plain(v), unit, digits)}"
            for name, v in field.value.items()
        )
        return " · ".join(parts)
    return named(field.name, _plain(field.value), unit, digits)


def _plain(value: Any) -> Any:
    """Undo what JSON does to numbers that aren't finite."""
    return None if value in ("nan", "inf", "-inf") else value
