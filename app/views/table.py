"""Rows of numbers."""

from collections.abc import Mapping
from typing import Any

from app import markup
from app.numbers import heading, named, number

_MOST_ROWS = 40


def table_html(value: Any) -> str:
    """Draw a list of records, or a mapping from name to number; empty if there is nothing in it."""
    if isinstance(value, Mapping):
        return (
            markup.facts((str(k).replace("_", " "), _cell(v, str(k))) for k, v in value.items())
            if value
            else ""
        )
    rows = [row for row in value or () if isinstance(row, Mapping)]
    if not rows:
        return ""
    columns = [str(column) for column in rows[0]]
    cells = ([_cell(row.get(c), c) for c in columns] for row in rows[:_MOST_ROWS])
    drawn = markup.table([heading(c) for c in columns], cells)
    left = len(rows) - _MOST_ROWS
    return drawn + (markup.div("ug-note", f"and {left} more rows") if left > 0 else "")


def _cell(value: Any, name: str) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(number(v) for v in value)
    return named(name, value)
