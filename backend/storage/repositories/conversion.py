"""From a mapped record to the frozen row that leaves the storage layer."""

from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

from backend.storage.tables import Base

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Row = TypeVar("Row", bound="DataclassInstance")


def as_row(kind: type[Row], record: Base) -> Row:
    """Copy the columns that the row has; a column's attribute may end in an underscore."""
    return kind(**{f.name: _column(record, f.name) for f in fields(kind)})


def _column(record: Base, name: str) -> Any:
    # `metadata` belongs to SQLAlchemy's base class: the column's attribute is `metadata_`.
    return getattr(record, name + "_" if name == "metadata" else name)


def as_values(row: "DataclassInstance") -> dict[str, Any]:
    """Return the row's fields under the names of the columns' attributes."""
    return {
        f.name + "_" if f.name == "metadata" else f.name: getattr(row, f.name) for f in fields(row)
    }
