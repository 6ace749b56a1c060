"""Compiled kernels that find partners along epipolar lines; see `matching`."""

from typing import Any, NamedTuple

import numba
import numpy as np

from backend.numerics.kernels import kernel, row_loop
from backend.numerics.lattice import lattice_row
from backend.numerics.reasons import Reason

_EMPTY = np.float32(np.nan)
_ONE = np.uint64(1)
# Numbers in a kernel have to be float32 one by one: a Python float makes the whole loop float64.
_ZERO, _HALF, _ONE_PX, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_MANY = np.float32(np.inf)
_NO_MATCH = np.uint16(Reason.NO_MATCH)
_AMBIGUOUS = np.uint16(Reason.AMBIGUOUS_MATCH)
_ONE_WAY = np.uint16(Reason.LEFT_RIGHT_CHECK)
_SAME_PLACE_PX = 3.0
"""Crossings of one coordinate this near to each other are noise on one surface, not two surfaces."""
_NEAR = np.float32(_SAME_PLACE_PX)
CHECKED_ROWS = 2
"""The check both ways looks at every n-th row of the reference: it asks for a place within pixels."""
SPARE_CELLS = 16
"""Cells at the end of an index row for what isn't wanted."""
_TILE = 512
"""Pixels whose intermediate rows stay in the first-level cache."""
_FLATTEST = np.float32(50.0)
"""Spread of four pixels over the change along the epipolar line above which the line can't be followed."""
_HAIR = np.float32(1e-3)
"""Overshoot in [px] that isn't worth another step to the neighbouring four pixels."""


class Index(NamedTuple):
    """At which x the rows of both canvases cross each value low + k step; inf where at two places."""

    reference: Any  # float32[rows / CHECKED_ROWS, cells + SPARE_CELLS]
    other: Any  # float32[rows, cells + SPARE_CELLS]


class Limits(NamedTuple):
    """Numbers of a whole match."""

    x0: Any  # float32: first column of the other canvas
    y0: Any
    low: Any  # float32: the grid's first value
    per_step: Any  # float32: one over the grid's step
    jump: Any
    agreement: Any


@row_loop
def _nearest(values: Any, px: Any, py: Any, out: Any) -> Any:
    """Pick the pixel nearest to each position; NaN outside."""
    height, width = values.shape
    right, bottom = np.float32(width), np.float32(height)
    for i in range(out.size):
        x, y = np.floor(px[i] + _HALF), np.floor(py[i] + _HALF)
        inside = (x >= _ZERO) & (x < right) & (y >= _ZERO) & (y < bottom)
        # unsigned, or each access would test for an index that counts from the end
        column = np.uint64(np.int32(x)) if inside else np.uint64(0)
        row = np.uint64(np.int32(y)) if inside else np.uint64(0)
        value = values[row, column]
        out[i] = value if inside else _EMPTY


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
def _crossings(row: Any, place: Any, low: Any, per_step: Any, jump_cells: Any, out: Any) -> Any:
    """Write where the row crosses each value low + k step; inf where it does so at two places."""
    size = out.size - SPARE_CELLS
    end = np.float32(size)
    for cell in range(out.size):
        out[cell] = _EMPTY
    before = (row[0] - low) * per_step
    for i in range(1, row.size):
        now = (row[i] - low) * per_step
        difference = now - before
        if abs(difference) <= jump_cells:  # False with NaN
            highest, lowest = max(before, now), min(before, now)
            top = np.floor(highest)
            per_cell = (place[i] - place[i - 1]) / difference
            # Mostly none, one or two: written without asking, what isn't crossed into the spare cell. Whether
            # a value is crossed can't be foreseen, so each question would cost more than the answer. The spare
            # cells take turns: writing to one that was just written to means waiting for it.
            spare = np.uint64(size + 2 * (i % (SPARE_CELLS // 2)))
            for step in range(2):
                level = top - np.float32(step)
                crossed = (level >= lowest) & (level >= _ZERO) & (level < end) & (highest > lowest)
                k = np.uint64(np.int32(level)) if crossed else spare + np.uint64(step)
                _note(k, place[i - 1] + (level - before) * per_cell, out)
            if difference > _TWO or difference < -_TWO:
                level = top - _TWO
                while level >= lowest:
                    if _ZERO <= level < end:
                        _note(
                            np.uint64(np.int32(level)),
                            place[i - 1] + (level - before) * per_cell,
                            out,
                        )
                    level -= _ONE_PX
        before = now


@kernel
def index_rows(values: Any, nodes: Any, width: Any, every: Any, numbers: Any, index: Any) -> None:
    """Note where every n-th row of a canvas crosses the grid's values; `numbers` are x0, low, per_step, jump in steps."""
    for number in numba.prange(index.shape[0]):
        y = np.int64(number) * every
        rows = np.empty((4, width), np.float32)
        px, py, row, place = rows[0], rows[1], rows[2], rows[3]
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], y, work, px)
        lattice_row(nodes[1], y, work, py)
        _nearest(values, px, py, row)
        # the canvas' direction in the picture, hardly changing along a row
        across = (px[width - 1] - px[0]) / np.float32(width - 1)
        down = (py[width - 1] - py[0]) / np.float32(width - 1)
        square = across * across + down * down
        _true_places(px, py, numbers[0], across / square, down / square, place)
        _crossings(row, place, numbers[1], numbers[2], numbers[3], index[number])


@row_loop
def _two_entries(a: Any, b: Any, part: Any) -> Any:
    """Return the place between two index entries, and a second one if they are far apart."""
    if np.isnan(a):
        return b, _EMPTY
    if np.isnan(b):
        return a, _EMPTY
    if abs(a - b) <= _TWO * _NEAR:  # False if one is inf
        return a + part * (b - a), _EMPTY
    if part < _HALF:
        return a, b
    return b, a


@row_loop
def _mutual(a: Any, b: Any, part: Any, x: Any, agreement: Any) -> Any:
    """Tell whether the reference's own index leads from the coordinate back to x."""
    first, second = _two_entries(a, b, part)
    if np.isnan(first):
        return True  # a sliver narrower than the index: nothing speaks against it
    # inf, two places in the reference, is never near
    return abs(first - x) <= agreement or abs(second - x) <= agreement


@row_loop
def _start_row(
    targets: Any, x: Any, line: Any, index: Any, limits: Any, start: Any, second: Any, reasons: Any
) -> Any:
    """Look up where to start on each pixel's epipolar line; say whether a pixel has two places."""
    rows, cells = (
        np.float32(index.other.shape[0]),
        np.float32(index.other.shape[1] - SPARE_CELLS - 1),
    )
    two_places = False
    for i in range(targets.size):
        start[i] = second[i] = _EMPTY
        reasons[i] = 0
        if np.isnan(targets[i]):
            continue
        nearest = line[i] + _HALF
        cell = (targets[i] - limits.low) * limits.per_step
        if not ((nearest >= _ZERO) & (nearest < rows) & (cell >= _ZERO) & (cell < cells)):
            reasons[i] = _NO_MATCH
            continue
        row, k = np.uint64(np.int32(nearest)), np.uint64(np.int32(cell))
        part = cell - np.float32(np.int32(cell))
        a, b = index.other[row, k], index.other[row, k + _ONE]
        row //= np.uint64(CHECKED_ROWS)
        c, d = index.reference[row, k], index.reference[row, k + _ONE]
        back = c + part * (d - c)
        if (
            (abs(a - b) <= _TWO * _NEAR)
            & (abs(c - d) <= _TWO * _NEAR)
            & (abs(back - x[i]) <= limits.agreement)
        ):  # nearly always; False with NaN and inf
            start[i] = a + part * (b - a) - limits.x0
            continue
        first, other = _two_entries(a, b, part)
        if np.isnan(first):
            reasons[i] = _NO_MATCH
        elif np.isinf(first) or np.isinf(other):
            reasons[i] = _AMBIGUOUS
        elif not _mutual(c, d, part, x[i], limits.agreement):
            reasons[i] = _ONE_WAY
        else:
            start[i], second[i] = first - limits.x0, other - limits.x0
            two_places |= not np.isnan(other)
    return two_places


# The first step, a tile of pixels at a time: plain loops over few rows, and what is looked up apart from what is
# calculated, so that the latter become vector instructions.


@row_loop
def _corner_of(x: Any, y: Any, width: Any, height: Any, corner: Any, right: Any, below: Any) -> Any:
    """Return the number of the upper left of the four pixels around a position, and the position among them."""
    last_x, last_y = np.float32(width - 2), np.float32(height - 2)
    stride = np.int32(width)
    for n in range(corner.size):
        # Written so that NaN ends at 0: a wild index would read foreign memory.
        at_x = x[n] if x[n] > _ZERO else _ZERO
        at_y = y[n] if y[n] > _ZERO else _ZERO
        at_x = at_x if at_x < last_x else last_x
        at_y = at_y if at_y < last_y else last_y
        column, row = np.int32(at_x), np.int32(at_y)
        right[n] = x[n] - np.float32(column)
        below[n] = y[n] - np.float32(row)
        corner[n] = row * stride + column


@row_loop
def _follow(
    plane: Any, next_row: Any, corner: Any, right: Any, below: Any, out: Any, change: Any
) -> Any:
    """Interpolate a smooth plane, and give its change along the row."""
    for n in range(corner.size):
        k = np.uint64(corner[n])
        value = plane[k]
        change[n] = plane[k + _ONE] - value
        out[n] = value + right[n] * change[n] + below[n] * (next_row[k] - value)


@row_loop
def _evaluate(
    values: Any,
    next_row: Any,
    corner: Any,
    a: Any,
    b: Any,
    dx: Any,
    dy: Any,
    value: Any,
    slope: Any,
    spread: Any,
) -> Any:
    """Interpolate between four pixels: value, slope along the epipolar line, range of the four."""
    for n in range(corner.size):
        k = np.uint64(corner[n])
        u00, u01, u10, u11 = values[k], values[k + _ONE], next_row[k], next_row[k + _ONE]
        top, bottom, left = u01 - u00, u11 - u10, u10 - u00
        twist = bottom - top
        slope[n] = (top + b[n] * twist) * dx[n] + (left + a[n] * twist) * dy[n]
        value[n] = u00 + a[n] * top + b[n] * (left + a[n] * twist)
        spread[n] = max(max(u00, u01), max(u10, u11)) - min(min(u00, u01), min(u10, u11))


@row_loop
def _step(
    targets: Any, value: Any, slope: Any, spread: Any, jump: Any, a: Any, b: Any, move: Any
) -> Any:
    """Take one Newton step; NaN where the four pixels are no surface that can be followed."""
    for n in range(move.size):
        good = (spread[n] <= jump) & (abs(slope[n]) * _FLATTEST >= spread[n])
        good &= (abs(a[n] - _HALF) <= _HALF) & (abs(b[n] - _HALF) <= _HALF)  # within the picture
        step = (targets[n] - value[n]) / slope[n]
        move[n] = step if good & (abs(step) <= _NEAR) else _EMPTY


@row_loop
def _land(
    start: Any, move: Any, a: Any, b: Any, dx: Any, dy: Any, x: Any, again: Any, weight: Any
) -> Any:
    """Accept what stays among its four pixels, and say from where the others have to go on."""
    middle = _HALF + _HAIR
    for n in range(move.size):
        right, below = a[n] + move[n] * dx[n], b[n] + move[n] * dy[n]
        # Inside the cell whose four pixels gave the slope there is nothing left to correct.
        inside = (abs(right - _HALF) <= middle) & (abs(below - _HALF) <= middle)  # False with NaN
        place = start[n] + move[n]
        x[n] = place if inside else _EMPTY
        again[n] = _EMPTY if inside else place
        left, above = _ONE_PX - right, _ONE_PX - below
        weight[n] = (left * left + right * right) * (above * above + below * below)


@row_loop
def _weigh(sigma: Any, corner: Any, a: Any, b: Any, stride: Any, weight: Any, variance: Any) -> Any:
    """Variance of an interpolated value whose four pixels are as noisy as the nearest one."""
    for n in range(corner.size):
        column = np.int32(1 if a[n] > _HALF else 0)
        row = np.int32(stride if b[n] > _HALF else 0)
        noise = sigma[np.uint64(corner[n] + column + row)]
        variance[n] = weight[n] * noise * noise


@row_loop
def _first_step(
    values: Any,
    sigma: Any,
    pixel_of_canvas: Any,
    targets: Any,
    start: Any,
    line: Any,
    jump: Any,
    rows: Any,
    x: Any,
    slope: Any,
    variance: Any,
    again: Any,
) -> Any:
    """Refine the starts of one tile; `again` holds those that left their four pixels, else NaN."""
    size = targets.size
    rows_px, columns = pixel_of_canvas.shape[1], pixel_of_canvas.shape[2]
    height, width = values.shape
    corner, flat = rows.corner[:size], values.reshape(-1)
    right, below, dx, dy = (
        rows.single[0, :size],
        rows.single[1, :size],
        rows.single[2, :size],
        rows.single[3, :size],
    )
    px, py, move, weight = (
        rows.single[4, :size],
        rows.single[5, :size],
        rows.single[6, :size],
        rows.single[7, :size],
    )
    _corner_of(start, line, columns, rows_px, corner, right, below)
    plane = pixel_of_canvas[0].reshape(-1)
    _follow(plane, plane[columns:], corner, right, below, px, dx)
    plane = pixel_of_canvas[1].reshape(-1)
    _follow(plane, plane[columns:], corner, right, below, py, dy)
    _corner_of(px, py, width, height, corner, right, below)
    # value and spread take the places that aren't used any more
    _evaluate(flat, flat[width:], corner, right, below, dx, dy, px, slope, py)
    _step(targets, px, slope, py, jump, right, below, move)
    _land(start, move, right, below, dx, dy, x, again, weight)
    if sigma.shape[0] == height:
        _weigh(sigma.reshape(-1), corner, right, below, width, weight, variance)
    else:
        variance[:] = _ZERO


@row_loop
def _refine_row(  # noqa: C901  # one loop: splitting it costs a call with 40 arguments per pixel
    values: Any,
    sigma: Any,
    pixel_of_canvas: Any,
    targets: Any,
    start: Any,
    line: Any,
    jump: Any,
    out_x: Any,
    out_slope: Any,
    out_variance: Any,
) -> Any:
    """Follow each epipolar line that has a start to where the coordinate is the target.

    Writes x, the slope du/dx and the variance of u there; nothing if there is no such place nearby.
    """
    height, width = values.shape
    rows, columns = pixel_of_canvas.shape[1], pixel_of_canvas.shape[2]
    noisy = sigma.shape[0] == height
    for n in range(targets.size):
        x = np.float64(start[n])
        if np.isnan(x):
            continue
        last = x
        # unsigned, or each access would test for an index that counts from the end
        row = np.uint64(min(max(np.int64(np.floor(line[n])), np.int64(0)), np.int64(rows - 2)))
        row_below = row + _ONE
        fy = line[n] - np.float64(row)
        for attempt in range(10):
            floor_x = np.floor(x)
            if floor_x < 0 or floor_x >= columns - 1 or abs(x - last) > _SAME_PLACE_PX:
                break
            fx = x - floor_x
            column = np.uint64(np.int64(floor_x))
            px00, py00 = pixel_of_canvas[0, row, column], pixel_of_canvas[1, row, column]
            dpx = pixel_of_canvas[0, row, column + _ONE] - px00
            dpy = pixel_of_canvas[1, row, column + _ONE] - py00
            px = px00 + fx * dpx + fy * (pixel_of_canvas[0, row_below, column] - px00)
            py = py00 + fx * dpy + fy * (pixel_of_canvas[1, row_below, column] - py00)
            floor_px, floor_py = np.floor(px), np.floor(py)
            if floor_px < 0 or floor_py < 0 or floor_px >= width - 1 or floor_py >= height - 1:
                break
            a, b = px - floor_px, py - floor_py
            i, j = np.uint64(np.int64(floor_px)), np.uint64(np.int64(floor_py))
            right, below = i + _ONE, j + _ONE
            u00, u01 = values[j, i], values[j, right]
            u10, u11 = values[below, i], values[below, right]
            spread = max(max(u00, u01), max(u10, u11)) - min(min(u00, u01), min(u10, u11))
            # max and min may pass over NaN, the sum doesn't
            if not (spread <= jump) or np.isnan(u00 + u01 + u10 + u11):
                break
            top, bottom = u01 - u00, u11 - u10
            slope = ((1.0 - b) * top + b * bottom) * dpx
            slope += ((1.0 - a) * (u10 - u00) + a * (u11 - u01)) * dpy
            if abs(slope) * _FLATTEST < spread:
                break
            value = (1.0 - b) * (u00 + a * top) + b * (u10 + a * bottom)
            move = (targets[n] - value) / slope
            if attempt >= 4:
                move *= 0.5  # two cells that send us to and fro
            x += move
            a, b = a + move * dpx, b + move * dpy
            # Inside the cell whose four pixels gave the slope there is nothing left to correct.
            if min(a, b) >= -_HAIR and max(a, b) <= 1.0 + _HAIR:
                out_x[n], out_slope[n], out_variance[n] = x, slope, 0.0
                if noisy:
                    out_variance[n] = (
                        ((1.0 - a) * (1.0 - b) * sigma[j, i]) ** 2
                        + (a * (1.0 - b) * sigma[j, right]) ** 2
                        + ((1.0 - a) * b * sigma[below, i]) ** 2
                        + (a * b * sigma[below, right]) ** 2
                    )
                break


@row_loop
def _choose_row(
    second: Any,
    x: Any,
    slope: Any,
    variance: Any,
    x2: Any,
    slope2: Any,
    variance2: Any,
    reasons: Any,
) -> Any:
    """Where the index had two places: take the one that holds, refuse both if both do."""
    for i in range(second.size):
        if np.isnan(second[i]) or np.isnan(x2[i]):
            continue
        if np.isnan(x[i]):
            x[i], slope[i], variance[i] = x2[i], slope2[i], variance2[i]
        elif abs(x[i] - x2[i]) > _SAME_PLACE_PX:
            x[i] = slope[i] = variance[i] = np.nan
            reasons[i] = _AMBIGUOUS


@row_loop
def _finish_row(
    x: Any, slope: Any, sigma: Any, variance: Any, x0: Any, out: Any, out_sigma: Any
) -> Any:
    for i in range(x.size):
        out[i] = x[i] + x0
        noise = np.sqrt(sigma[i] * sigma[i] + variance[i]) / abs(slope[i])
        out_sigma[i] = noise if x[i] == x[i] else _EMPTY


@row_loop
def _explain_row(targets: Any, x: Any, reasons: Any) -> Any:
    for i in range(x.size):
        lost = (x[i] != x[i]) & (targets[i] == targets[i]) & (reasons[i] == 0)
        reasons[i] = _NO_MATCH if lost else reasons[i]


class _Rows(NamedTuple):
    """Intermediate values of one tile."""

    single: Any  # float32[8, tile]
    corner: Any  # int32[tile]


@row_loop
def _match_row(
    reference_row: Any,
    other_px: Any,
    sigma_other: Any,
    pixel_of_canvas: Any,
    x: Any,
    line: Any,
    index: Any,
    limits: Any,
    rows: Any,
    tile: Any,
    reasons: Any,
) -> Any:
    """Find the partners of one row: rows 0, 1 and 2 become x, slope and variance."""
    width = reference_row.size
    found, slope, variance, start, second = rows[0], rows[1], rows[2], rows[3], rows[4]
    again = rows[5]
    two_places = _start_row(reference_row, x, line, index, limits, start, second, reasons)
    for begin in range(0, width, _TILE):
        end = min(begin + _TILE, width)
        _first_step(
            other_px,
            sigma_other,
            pixel_of_canvas,
            reference_row[begin:end],
            start[begin:end],
            line[begin:end],
            limits.jump,
            tile,
            found[begin:end],
            slope[begin:end],
            variance[begin:end],
            again[begin:end],
        )
    jump = limits.jump
    _refine_row(
        other_px,
        sigma_other,
        pixel_of_canvas,
        reference_row,
        again,
        line,
        jump,
        found,
        slope,
        variance,
    )
    if two_places:
        x2, slope2, variance2 = rows[6], rows[7], rows[8]
        x2[:] = _EMPTY
        _refine_row(
            other_px,
            sigma_other,
            pixel_of_canvas,
            reference_row,
            second,
            line,
            jump,
            x2,
            slope2,
            variance2,
        )
        _choose_row(second, found, slope, variance, x2, slope2, variance2, reasons)


@kernel
def match_rows(
    reference_px: Any,
    other_px: Any,
    sigma_reference: Any,
    sigma_other: Any,
    nodes: Any,
    pixel_of_canvas: Any,
    index: Any,
    limits: Any,
    out_x: Any,
    out_sigma: Any,
    out_reasons: Any,
) -> None:
    """Find the partners of all rows, see `matching.match`."""
    height, width = reference_px.shape
    known = np.int64(1 if sigma_reference.shape[0] == height else 0)
    for row in numba.prange(height):
        rows = np.empty((11, width), np.float32)
        tile = _Rows(np.empty((8, _TILE), np.float32), np.empty(_TILE, np.int32))
        work = np.empty(nodes.shape[2], np.float64)
        x, line = rows[9], rows[10]
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, line)
        line -= limits.y0
        _match_row(
            reference_px[row],
            other_px,
            sigma_other,
            pixel_of_canvas,
            x,
            line,
            index,
            limits,
            rows,
            tile,
            out_reasons[row],
        )
        sigma = sigma_reference[np.int64(row) * known]
        _finish_row(rows[0], rows[1], sigma, rows[2], limits.x0, out_x[row], out_sigma[row])
        _explain_row(reference_px[row], rows[0], out_reasons[row])


@row_loop
def _between(plane: Any, row: Any, column: Any, fx: Any, fy: Any) -> Any:
    corner = plane[row, column]
    return corner + fx * (plane[row, column + 1] - corner) + fy * (plane[row + 1, column] - corner)


@kernel
def sample_rows(
    values: Any, x_other: Any, nodes: Any, pixel_of_canvas: Any, other: Any, out: Any
) -> None:
    """Fetch what the other camera has at each partner, see `matching.sample_partner`."""
    height, width = x_other.shape
    rows, columns = pixel_of_canvas.shape[1], pixel_of_canvas.shape[2]
    for row in numba.prange(height):
        y = np.empty(width, np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[1], row, work, y)
        for i in range(width):
            out[row, i] = _EMPTY
            if np.isnan(x_other[row, i]):
                continue
            x, line = x_other[row, i] - other[0], y[i] - other[1]
            column = min(max(np.int64(np.floor(x)), np.int64(0)), np.int64(columns - 2))
            above = min(max(np.int64(np.floor(line)), np.int64(0)), np.int64(rows - 2))
            px = _between(pixel_of_canvas[0], above, column, x - column, line - above)
            py = _between(pixel_of_canvas[1], above, column, x - column, line - above)
            nearest_x, nearest_y = np.int64(np.floor(px + 0.5)), np.int64(np.floor(py + 0.5))
            if 0 <= nearest_x < values.shape[1] and 0 <= nearest_y < values.shape[0]:
                out[row, i] = values[nearest_y, nearest_x]
