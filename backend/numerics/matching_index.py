"""Compiled kernel that notes at which x the rows of a canvas cross each of a series of coordinates; see `matching`."""

from typing import Any

import numba
import numpy as np

from backend.numerics.kernels import kernel, row_loop
from backend.numerics.lattice import lattice_row

_EMPTY = np.float32(np.nan)
# Numbers in a kernel have to be float32 one by one: a Python float makes the whole loop float64.
_ZERO, _HALF, _ONE_PX, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_MANY = np.float32(np.inf)
SAME_PLACE_PX = 3.0
"""Crossings of one coordinate this near to each other are noise on one surface, not two surfaces."""
_NEAR = np.float32(SAME_PLACE_PX)
SPARE_CELLS = 16
"""Cells at the end of an index row for what isn't wanted."""
_TILE = 512
"""Pixels whose intermediate rows stay in the first-level cache."""


@row_loop
def _nearest(px: Any, py: Any, width: Any, height: Any, number: Any) -> Any:
    """Return the number of the pixel nearest to each position; -1 outside."""
    right, bottom = np.float32(width), np.float32(height)
    stride = np.int32(width)
    for i in range(number.size):
        x, y = np.floor(px[i] + _HALF), np.floor(py[i] + _HALF)
        inside = (x >= _ZERO) & (x < right) & (y >= _ZERO) & (y < bottom)
        number[i] = np.int32(y) * stride + np.int32(x) if inside else np.int32(-1)


@row_loop
def _picked(values: Any, number: Any, out: Any) -> Any:
    """Fetch pixels by their numbers; NaN for -1."""
    for i in range(out.size):
        # unsigned, or each access would test for an index that counts from the end
        value = values[np.uint64(max(number[i], np.int32(0)))]
        out[i] = value if number[i] >= 0 else _EMPTY


@row_loop
def _true_places(px: Any, py: Any, x0: Any, across: Any, down: Any, place: Any) -> Any:
    """Say where on the canvas the pixels lie that `_nearest` picks."""
    for i in range(place.size):
        off_x = np.floor(px[i] + _HALF) - px[i]
        off_y = np.floor(py[i] + _HALF) - py[i]
        place[i] = x0 + np.float32(i) + across * off_x + down * off_y


@row_loop
def _note(k: Any, place: Any, out: Any) -> Any:
    """Write one crossing into its cell; two far apart make it infinite."""
    old = out[k]
    same = old if abs(old - place) <= _NEAR else _MANY
    out[k] = place if np.isnan(old) else same


@row_loop
def _levels(
    row: Any, place: Any, low: Any, per_step: Any, jump_cells: Any, end: Any, cells: Any, at: Any
) -> Any:
    """Say for each step of the row in which cells its two highest crossings belong, and where they are.

    What isn't crossed gets a spare cell. They take turns: writing to one that was just written to means waiting
    for it. Says whether a step may have more crossings.
    """
    steep = np.int32(0)
    for i in range(row.size - 1):
        before, now = (row[i] - low) * per_step, (row[i + 1] - low) * per_step
        difference = now - before
        highest, lowest = max(before, now), min(before, now)
        top = np.floor(highest)
        usable = (abs(difference) <= jump_cells) & (highest > lowest)  # False with NaN
        per_cell = (place[i + 1] - place[i]) / difference
        spare = np.int32(end) + np.int32(2) * (np.int32(i) & np.int32(SPARE_CELLS // 2 - 1))
        crossed = usable & (top >= lowest) & (top >= _ZERO) & (top < end)
        cells[0, i] = np.int32(top) if crossed else spare
        at[0, i] = place[i] + (top - before) * per_cell
        level = top - _ONE_PX
        crossed = usable & (level >= lowest) & (level >= _ZERO) & (level < end)
        cells[1, i] = np.int32(level) if crossed else spare + np.int32(1)
        at[1, i] = place[i] + (level - before) * per_cell
        steep += np.int32(usable & (abs(difference) > _TWO))
    return steep > 0


@row_loop
def _note_all(cells: Any, at: Any, size: Any, out: Any) -> Any:
    """Write crossings into their cells, without asking: whether a value is crossed can't be foreseen."""
    for i in range(size):
        _note(np.uint64(cells[0, i]), at[0, i], out)
        _note(np.uint64(cells[1, i]), at[1, i], out)


@row_loop
def _note_steep(
    row: Any, place: Any, low: Any, per_step: Any, jump_cells: Any, end: Any, out: Any
) -> Any:
    """Write the crossings below the two highest ones of each step."""
    for i in range(row.size - 1):
        before, now = (row[i] - low) * per_step, (row[i + 1] - low) * per_step
        difference = now - before
        if _TWO < abs(difference) <= jump_cells:
            lowest = min(before, now)
            per_cell = (place[i + 1] - place[i]) / difference
            level = np.floor(max(before, now)) - _TWO
            while level >= lowest:
                if _ZERO <= level < end:
                    _note(np.uint64(np.int32(level)), place[i] + (level - before) * per_cell, out)
                level -= _ONE_PX


@row_loop
def _crossings(
    row: Any, place: Any, low: Any, per_step: Any, jump_cells: Any, cells: Any, at: Any, out: Any
) -> Any:
    """Write where the row crosses each value low + k step; inf where it does so at two places."""
    end = np.float32(out.size - SPARE_CELLS)
    out[:] = _EMPTY
    for begin in range(0, row.size - 1, _TILE):
        last = min(begin + _TILE, row.size - 1) + 1
        steps, places = row[begin:last], place[begin:last]
        steep = _levels(steps, places, low, per_step, jump_cells, end, cells, at)
        _note_all(cells, at, steps.size - 1, out)
        if steep:
            _note_steep(steps, places, low, per_step, jump_cells, end, out)


@kernel
def index_rows(values: Any, nodes: Any, width: Any, every: Any, numbers: Any, index: Any) -> None:
    """Note where every n-th row of a canvas crosses the grid's values; `numbers` are x0, low, per_step, jump in steps."""
    for number in numba.prange(index.shape[0]):
        y = np.int64(number) * every
        rows = np.empty((4, width), np.float32)
        px, py, row, place = rows[0], rows[1], rows[2], rows[3]
        nearest, work = np.empty(width, np.int32), np.empty(nodes.shape[2], np.float64)
        cells, at = np.empty((2, _TILE), np.int32), np.empty((2, _TILE), np.float32)
        lattice_row(nodes[0], y, work, px)
        lattice_row(nodes[1], y, work, py)
        _nearest(px, py, values.shape[1], values.shape[0], nearest)
        _picked(values.reshape(-1), nearest, row)
        # the canvas' direction in the picture, hardly changing along a row
        across = (px[width - 1] - px[0]) / np.float32(width - 1)
        down = (py[width - 1] - py[0]) / np.float32(width - 1)
        square = across * across + down * down
        _true_places(px, py, numbers[0], across / square, down / square, place)
        _crossings(row, place, numbers[1], numbers[2], numbers[3], cells, at, index[number])
