"""Compiled kernels that find partners along epipolar lines; see `matching`."""

from typing import Any, NamedTuple

import numba
import numpy as np

from backend.numerics.kernels import kernel, row_loop
from backend.numerics.lattice import lattice_row
from backend.numerics.matching_index import SAME_PLACE_PX, SPARE_CELLS
from backend.numerics.reasons import Reason

_EMPTY = np.float32(np.nan)
_ONE = np.uint64(1)
# Numbers in a kernel have to be float32 one by one: a Python float makes the whole loop float64.
_ZERO, _HALF, _ONE_PX, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_NO_MATCH = np.uint16(Reason.NO_MATCH)
_AMBIGUOUS = np.uint16(Reason.AMBIGUOUS_MATCH)
_ONE_WAY = np.uint16(Reason.LEFT_RIGHT_CHECK)
_NEAR = np.float32(SAME_PLACE_PX)
_CHECKED_SHIFT = np.int32(1)
CHECKED_ROWS = 1 << int(_CHECKED_SHIFT)
"""The check both ways looks at every n-th row of the reference: it asks for a place within pixels."""
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


# Start and first step are taken for a tile of pixels at a time: plain loops over few rows, and what is looked up
# apart from what is calculated, so that the latter become vector instructions.


@row_loop
def _pairs(plane: Any, at: Any, first: Any, second: Any) -> Any:
    """Fetch two neighbours each."""
    for n in range(first.size):
        k = np.uint64(at[n])
        first[n], second[n] = plane[k], plane[k + _ONE]


@row_loop
def _singles(plane: Any, at: Any, out: Any) -> Any:
    for n in range(out.size):
        out[n] = plane[np.uint64(at[n])]


@row_loop
def _cells_of(
    targets: Any, line: Any, index: Any, limits: Any, part: Any, other: Any, reference: Any
) -> Any:
    """Return the numbers of the index entries below each coordinate, and its place above; NaN outside of the index."""
    columns = np.int32(index.other.shape[1])
    rows, cells = np.float32(index.other.shape[0]), np.float32(columns - SPARE_CELLS - 1)
    for n in range(targets.size):
        nearest = line[n] + _HALF
        cell = (targets[n] - limits.low) * limits.per_step
        inside = (nearest >= _ZERO) & (nearest < rows) & (cell >= _ZERO) & (cell < cells)
        row = np.int32(nearest) if inside else np.int32(0)
        k = np.int32(cell) if inside else np.int32(0)
        part[n] = cell - np.float32(k) if inside else _EMPTY
        other[n] = row * columns + k
        reference[n] = (row >> _CHECKED_SHIFT) * columns + k


@row_loop
def _clear_starts(
    targets: Any,
    x: Any,
    part: Any,
    a: Any,
    b: Any,
    c: Any,
    d: Any,
    limits: Any,
    start: Any,
    reasons: Any,
) -> Any:
    """Start between two entries that agree and lead back; count pixels that need a closer look."""
    doubts = np.int32(0)
    for n in range(targets.size):
        back = c[n] + part[n] * (d[n] - c[n])
        clear = (abs(a[n] - b[n]) <= _TWO * _NEAR) & (abs(c[n] - d[n]) <= _TWO * _NEAR)
        clear &= abs(back - x[n]) <= limits.agreement  # nearly always; False with NaN and inf
        start[n] = a[n] + part[n] * (b[n] - a[n]) - limits.x0 if clear else _EMPTY
        within = part[n] == part[n]
        reasons[n] = _NO_MATCH if (targets[n] == targets[n]) & (not within) else np.uint16(0)
        doubts += np.int32(within & (not clear))
    return doubts


@row_loop
def _doubtful_starts(
    x: Any,
    part: Any,
    a: Any,
    b: Any,
    c: Any,
    d: Any,
    limits: Any,
    start: Any,
    second: Any,
    reasons: Any,
) -> Any:
    """Start where entries are missing or far apart; say whether a pixel has two places."""
    two_places = False
    for n in range(start.size):
        if np.isnan(part[n]) or not np.isnan(start[n]):
            continue
        first, other = _two_entries(a[n], b[n], part[n])
        if np.isnan(first):
            reasons[n] = _NO_MATCH
        elif np.isinf(first) or np.isinf(other):
            reasons[n] = _AMBIGUOUS
        elif not _mutual(c[n], d[n], part[n], x[n], limits.agreement):
            reasons[n] = _ONE_WAY
        else:
            start[n], second[n] = first - limits.x0, other - limits.x0
            two_places |= not np.isnan(other)
    return two_places


@row_loop
def _start(
    targets: Any,
    x: Any,
    line: Any,
    index: Any,
    limits: Any,
    rows: Any,
    start: Any,
    second: Any,
    reasons: Any,
) -> Any:
    """Look up where to start on each pixel's epipolar line; say whether a pixel has two places."""
    size = targets.size
    part, a, b = rows.single[0, :size], rows.single[1, :size], rows.single[2, :size]
    c, d = rows.single[3, :size], rows.single[4, :size]
    other, reference = rows.corner[0, :size], rows.corner[1, :size]
    _cells_of(targets, line, index, limits, part, other, reference)
    _pairs(index.other.reshape(-1), other, a, b)
    _pairs(index.reference.reshape(-1), reference, c, d)
    second[:] = _EMPTY
    if _clear_starts(targets, x, part, a, b, c, d, limits, start, reasons) == 0:
        return False
    return _doubtful_starts(x, part, a, b, c, d, limits, start, second, reasons)


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
    value: Any, right_of: Any, below_of: Any, right: Any, below: Any, out: Any, change: Any
) -> Any:
    """Interpolate a smooth plane, and give its change along the row."""
    for n in range(out.size):
        change[n] = right_of[n] - value[n]
        out[n] = value[n] + right[n] * change[n] + below[n] * (below_of[n] - value[n])


@row_loop
def _evaluate(
    u00: Any,
    u01: Any,
    u10: Any,
    u11: Any,
    a: Any,
    b: Any,
    dx: Any,
    dy: Any,
    value: Any,
    slope: Any,
    spread: Any,
) -> Any:
    """Interpolate between four pixels: value, slope along the epipolar line, range of the four."""
    for n in range(value.size):
        top, bottom, left = u01[n] - u00[n], u11[n] - u10[n], u10[n] - u00[n]
        twist = bottom - top
        slope[n] = (top + b[n] * twist) * dx[n] + (left + a[n] * twist) * dy[n]
        value[n] = u00[n] + a[n] * top + b[n] * (left + a[n] * twist)
        highest = max(max(u00[n], u01[n]), max(u10[n], u11[n]))
        spread[n] = highest - min(min(u00[n], u01[n]), min(u10[n], u11[n]))


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
    single = rows.single
    corner, flat = rows.corner[0, :size], values.reshape(-1)
    right, below, dx, dy = single[0, :size], single[1, :size], single[2, :size], single[3, :size]
    px, py, move, weight = single[4, :size], single[5, :size], single[6, :size], single[7, :size]
    u00, u01, u10, u11 = single[8, :size], single[9, :size], single[10, :size], single[11, :size]
    _corner_of(start, line, columns, rows_px, corner, right, below)
    for plane, place, change in ((0, px, dx), (1, py, dy)):
        smooth = pixel_of_canvas[plane].reshape(-1)
        _pairs(smooth, corner, u00, u01)
        _singles(smooth[columns:], corner, u10)
        _follow(u00, u01, u10, right, below, place, change)
    _corner_of(px, py, width, height, corner, right, below)
    _pairs(flat, corner, u00, u01)
    _pairs(flat[width:], corner, u10, u11)
    # value and spread take the places that aren't used any more
    _evaluate(u00, u01, u10, u11, right, below, dx, dy, px, slope, py)
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
            if floor_x < 0 or floor_x >= columns - 1 or abs(x - last) > SAME_PLACE_PX:
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
        elif abs(x[i] - x2[i]) > SAME_PLACE_PX:
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

    single: Any  # float32[12, tile]
    corner: Any  # int32[2, tile]


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
    two_places = False
    for begin in range(0, width, _TILE):
        end = min(begin + _TILE, width)
        two_places |= _start(
            reference_row[begin:end],
            x[begin:end],
            line[begin:end],
            index,
            limits,
            tile,
            start[begin:end],
            second[begin:end],
            reasons[begin:end],
        )
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
        tile = _Rows(np.empty((12, _TILE), np.float32), np.empty((2, _TILE), np.int32))
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
