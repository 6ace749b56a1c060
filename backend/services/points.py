"""A cloud made small enough for the screen, as bytes that a browser's side reads without parsing.

uint32 length of the header (little endian), header as JSON `{n, total, colour, scalars: {name: {unit, title, low,
high}}}`, float32 xyz (n, 3), uint8 rgb (n, 3) if there is colour, then float32 (n) for each scalar in turn.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int8, Integer, UInt64

from backend.domain.errors import InvalidSettingError, NotFoundError
from backend.domain.hints import Points
from backend.domain.stage import shown_fields
from backend.storage.artifacts import ArtifactStore

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

_SAMPLE = 200_000
_SCALES = 4
"""Halvings of the distance between points, from every 16th row and column to every one."""
_SHUFFLE, _LOW = np.uint64(2_654_435_761), np.uint64(2**32 - 1)
"""An odd number mixes the order of 32 bits without bringing two together: within a level, chance decides."""


def pack_points(
    result_type: type,
    document: Mapping[str, Any],
    field: str,
    store: ArtifactStore,
    *,
    budget: int,
    beyond: int = 0,
    scalar: str | None = None,
) -> bytes:
    """Thin a cloud to at most `budget` points and pack it.

    Points that know their pixel (`pixel_x`, `pixel_y`) are thinned evenly over the picture, others by chance
    (always the same). A larger budget brings the points of every smaller one and more between them: so a cloud can be sent
    coarse at first, and then what is `beyond`.

    Parameters
    ----------
    result_type, document
        The result that holds the cloud, as it is stored.
    field
        Name of the field with the points.
    store
        Where its arrays are.
    budget
        Most points to send, and as many come if there are.
    beyond
        Leave out the points that this budget brings.
    scalar
        Only this quantity; None: all.

    Raises
    ------
    NotFoundError
        If the result has no such points or scalar.
    """
    hints = {f.name: f.hint for f in shown_fields(result_type)}
    hint = hints.get(field)
    if not isinstance(hint, Points):
        raise NotFoundError(f"{result_type.__name__} has no points {field!r}.")
    if scalar is not None and scalar not in hint.scalars:
        known = ", ".join(hint.scalars) or "none"
        raise NotFoundError(f"{field} has no scalar {scalar!r}; it has {known}.")
    arrays = {name: _array(document, name, store) for name in (field, "pixel_x", "pixel_y")}
    points = arrays[field]
    if points is None:
        raise NotFoundError(f"This result has no {field}.")
    points = points.reshape(-1, 3)
    chosen = _chosen(points, arrays["pixel_x"], arrays["pixel_y"], budget, beyond)
    scalars = {
        name: values.reshape(-1)[chosen].astype("<f4")
        for name in hint.scalars
        if scalar in (None, name) and (values := _array(document, name, store)) is not None
    }
    facts = {name: _facts(hints.get(name), name, values) for name, values in scalars.items()}
    colour = _array(document, hint.colour, store) if hint.colour else None
    header = {
        "n": len(chosen),
        "total": len(points),
        "colour": colour is not None,
        "scalars": facts,
    }
    text = json.dumps(header).encode()
    parts = [len(text).to_bytes(4, "little"), text, points[chosen].astype("<f4").tobytes()]
    if colour is not None:
        parts.append(colour.reshape(-1, 3)[chosen].astype(np.uint8).tobytes())
    return b"".join([*parts, *(values.tobytes() for values in scalars.values())])


def _array(document: Mapping[str, Any], name: str, store: ArtifactStore) -> Array | None:
    value = document.get(name)
    if value is None:
        return None
    if not isinstance(value, Mapping) or "$array" not in value:
        raise InvalidSettingError(f"{name} is no array, so it can't be a part of a cloud.")
    return store.get(value["$array"])


def _chosen(
    points: Float32[np.ndarray, "n 3"], x: Array | None, y: Array | None, budget: int, beyond: int
) -> Integer[np.ndarray, "m"]:
    """Return the indices of the points to send, finite ones only."""
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(finite) <= budget and not beyond:
        return finite
    rank = np.arange(len(finite), dtype=np.uint64) * _SHUFFLE & _LOW
    if x is not None and y is not None and len(x) == len(y) == len(points):
        rank |= _levels(x[finite], y[finite]).astype(np.uint64) << np.uint64(32)
    return np.asarray(finite[_first(rank, budget) & ~_first(rank, beyond)])


def _first(rank: UInt64[np.ndarray, "n"], count: int) -> Bool[np.ndarray, "n"]:
    """Mark the `count` smallest; no two are equal."""
    if count >= len(rank):
        return np.ones(len(rank), np.bool_)
    if count == 0:
        return np.zeros(len(rank), np.bool_)
    return np.asarray(rank <= np.partition(rank, count - 1)[count - 1], np.bool_)


def _levels(x: Array, y: Array) -> Int8[np.ndarray, "n"]:
    """Say at which level of detail a pixel appears: each level doubles the number of points.

    Level 0 is every 16th row and column; from there on the middles of the squares come first, then those of
    their sides.
    """
    column, row = (np.rint(v - v.min(initial=np.inf)).astype(np.int32) for v in (x, y))
    level = np.zeros(len(x), np.int8)
    for scale in range(_SCALES):
        unit = 1 << (_SCALES - 1 - scale)
        odd_column, odd_row = column & unit, row & unit
        level[(odd_column & odd_row) != 0] = 2 * scale + 1
        level[(odd_column ^ odd_row) != 0] = 2 * scale + 2
    return level


def _facts(hint: Any, name: str, values: Array) -> dict[str, Any]:
    """Describe a scalar: unit, title, and the 1 % and 99 % percentile as ends of the colours."""
    sample = values[:: max(1, len(values) // _SAMPLE)]
    finite = sample[np.isfinite(sample)]
    low, high = np.percentile(finite, [1, 99]).tolist() if finite.size else (None, None)
    return {
        "unit": getattr(hint, "unit", ""),
        "title": getattr(hint, "title", name),
        "low": low,
        "high": high,
    }
