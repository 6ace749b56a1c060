"""A picture over two settings: what its columns and rows mean, and the point that a setting takes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.client import ApiClient
from app.numbers import heading, quantity
from backend.contract.scans import FieldView, StageState

Array = NDArray[Any]


@dataclass(frozen=True)
class Axes:
    """Values of columns and rows.

    Parameters
    ----------
    x, y
        Value of each column and row, evenly or not, increasing or decreasing.
    names
        Title and unit of both.
    point
        The (x, y) that was chosen, in these values.
    setting
        The setting that takes another point; None: none does.
    """

    x: Array
    y: Array
    names: tuple[tuple[str, str], tuple[str, str]]
    point: tuple[float, float] | None = None
    setting: str | None = None

    @classmethod
    def of(cls, api: ApiClient, stage: StageState, field: FieldView) -> "Axes | None":
        """Read the axes of a field; None if it is an ordinary picture."""
        hint = field.hint
        x, y = (_numbers(api, stage, hint.get(name)) for name in ("x", "y"))
        if hint.get("kind") != "picture" or x is None or y is None:
            return None
        chosen = _chosen(api, stage, hint)
        setting = hint.get("edits") if hint.get("point") else None
        names = (_name(stage, str(hint["x"])), _name(stage, str(hint["y"])))
        known = setting if setting in stage.settings else None
        return cls(x, y, names, chosen, known)

    def value_at(self, x_px: float, y_px: float) -> list[float]:
        """Return the values at a pixel: those of the nearest column and row."""
        return [_tidy(self.x[_index(self.x, x_px)]), _tidy(self.y[_index(self.y, y_px)])]

    def pixel_of(self, x: float, y: float) -> tuple[float, float]:
        """Return where a pair of values lies, between pixels as well."""
        return _position(self.x, x), _position(self.y, y)

    def rows(self, x_px: float, y_px: float) -> list[tuple[str, str]]:
        """Return the values at a pixel in words."""
        pairs = zip(self.names, self.value_at(x_px, y_px), strict=True)
        found = [(title, quantity(value, unit)) for (title, unit), value in pairs]
        if found[0][0] == found[1][0]:
            return [(f"{found[0][0]}, across", found[0][1]), (f"{found[1][0]}, down", found[1][1])]
        return found


def _index(values: Array, position: float) -> int:
    return int(np.clip(round(position), 0, len(values) - 1))


def _position(values: Array, value: float) -> float:
    order = np.argsort(values)
    return float(np.interp(value, values[order], order.astype(np.float64)))


def _tidy(value: Any) -> float:
    number = float(value)
    return int(number) if number.is_integer() else number


def _chosen(
    api: ApiClient, stage: StageState, hint: Mapping[str, Any]
) -> tuple[float, float] | None:
    """Return the point of the setting if it is edited, else the one that the stage chose."""
    view = stage.settings.get(str(hint.get("edits")))
    present = view.value if view is not None else None
    found = present if present is not None else _numbers(api, stage, hint.get("point"))
    if found is None or len(found) != 2:
        return None
    return float(found[0]), float(found[1])


def _numbers(api: ApiClient, stage: StageState, name: Any) -> Array | None:
    field = next((f for f in stage.fields if f.name == name), None)
    if field is None:
        return None
    if reference := field.arrays.get(""):
        return np.asarray(api.array(reference.hash), dtype=np.float64).ravel()
    return np.array(field.value, dtype=np.float64) if isinstance(field.value, list) else None


def _name(stage: StageState, name: str) -> tuple[str, str]:
    field = next((f for f in stage.fields if f.name == name), None)
    if field is not None and field.hint.get("title"):
        return str(field.hint["title"]), str(field.hint.get("unit") or "")
    words, unit = heading(name)
    return words[:1].upper() + words[1:], unit
