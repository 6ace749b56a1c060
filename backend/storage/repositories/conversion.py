"""From a mapped record to the frozen row that leaves the storage layer, and back."""

from dataclasses import fields
from typing import Any, TypeVar

from backend.storage.tables import Base

Row = TypeVar("Row")


def as_row(kind: type[Row], record: Base) -> Row:
    """Copy the columns that the row (a frozen dataclass) has a field for."""
    return kind(**{name: getattr(record, _attribute(name)) for name in _names(kind)})


def as_values(row: object) -> dict[str, Any]:
    """Return a row's fields under the names of the columns' attributes."""
    return {_attribute(name): getattr(row, name) for name in _names(row)}


def _names(row: Any) -> list[str]:
    return [field.name for field in fields(row)]


def _attribute(name: str) -> str:
    # `metadata` belongs to SQLAlchemy's base class: the column's attribute is `metadata_`.
    return "metadata_" if name == "metadata" else name
