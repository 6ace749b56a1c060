"""Partners in two cameras: equal projector coordinate on the epipolar line, sub-pixel, checked both ways."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, UInt16

from backend.numerics.errors import MatchingError
from backend.numerics.kernels import kernel, kernel_input, row_loop
from backend.numerics.lattice import lattice_row
from backend.numerics.reasons import Reason
from backend.numerics.rectification import Canvas, Rectification


class MatchSettings(NamedTuple):
    """When two pixels are partners."""

    jump_px: float | None = None
    """Neighbouring pixels whose coordinate differs by more are not one surface. None: 5 times the median step."""
    agreement_px: float = 2.0
    """A partner has to lead back to within this distance, in [px] of the rectified plane."""


class Matches(NamedTuple):
    """Where each pixel of the reference camera is seen by the other; NaN where it isn't."""

    x_other_px: Float32[np.ndarray, "h w"]
    """Rectified x of the partner."""
    sigma_disparity_px: Float32[np.ndarray, "h w"]
    """Standard deviation of the difference of both rectified x, from the noise of both coordinates."""
    slope: Float32[np.ndarray, "h w"]
    """Change of the projector coordinate per rectified px at the partner; its sign says how the code runs."""
    reasons: UInt16[np.ndarray, "h w"]
    """Why a pixel with a coordinate has no partner: `Reason` bits; 0 where the coordinate itself is missing."""


_DEFAULTS = MatchSettings()
_EMPTY = np.float32(np.nan)
_ONE = np.uint64(1)
_MANY = np.float32(np.inf)
_NO_MATCH = np.uint16(Reason.NO_MATCH)
_AMBIGUOUS = np.uint16(Reason.AMBIGUOUS_MATCH)
_ONE_WAY = np.uint16(Reason.LEFT_RIGHT_CHECK)
_SAME_PLACE_PX = 3.0
"""Crossings of one coordinate this near to each other are noise on one surface, not two surfaces."""
_JUMP_STEPS = 5.0
_CELLS_MAX = 4
_FLATTEST = 50.0
"""Spread of four pixels over the change along the epipolar line above which the line can't be followed."""
_HAIR = 1e-3
"""Overshoot in [px] that isn't worth another step to the neighbouring four pixels."""


def match(
    reference_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h2 w2"],
    rectification: Rectification,
    *,
    sigma_reference_px: Float32[np.ndarray, "h w"] | None = None,
    sigma_other_px: Float32[np.ndarray, "h2 w2"] | None = None,
    settings: MatchSettings = _DEFAULTS,
) -> Matches:
    r"""Find each reference pixel's partner on its epipolar line.

    Parameters
    ----------
    reference_px, other_px
        Projector coordinate of each camera's pixels in [px] (or any unit that both share),
        float32, NaN invalid. The coded direction has to change along the line between the cameras.
    rectification
        Geometry of the pair.
    sigma_reference_px, sigma_other_px
        Standard deviation of the coordinates in their unit. None means not known: sigma is NaN.
    settings
        What counts as a jump and as agreement.

    Returns
    -------
    Rectified x of the partner, its uncertainty, slope and reasons, float32 and uint16.

    Raises
    ------
    MatchingError
        If a map doesn't have its camera's size, holds no valid pixel, or the coordinate doesn't
        change along epipolar lines.

    Notes
    -----
    An index per row of the rectified plane says at which x the other camera's coordinate crosses each of a series
    of values; it is filled from the nearest pixels and serves as a start only. From there Newton's
    method runs along the exact epipolar line on the *original* map of the other camera, bilinear inside
    one valid 2x2 neighbourhood without a jump. So the reference isn't resampled, the other is interpolated
    once, and neither rectified size nor rotation touches the accuracy. With the weights w of the four pixels

    .. math:: \sigma_d^2 = \frac{\sigma_{ref}^2 + \sum_i w_i^2 \sigma_i^2}{(\partial u / \partial x)^2}

    A coordinate that crosses at two places of the row is ambiguous; a partner whose own index entry leads
    to another pixel of the reference fails the left-right check. No disparity range is needed.
    Memory: two indices of rows times projector columns, one map of the other canvas.
    """
    _check(reference_px, other_px, rectification)
    reference_px, other_px = kernel_input(reference_px), kernel_input(other_px)
    step = _median_step(reference_px, other_px)
    jump = settings.jump_px if settings.jump_px is not None else _JUMP_STEPS * step
    grid = _grid(other_px, step, rectification.other.width_px)
    pixel_of_other = rectification.pixel_of_other.map()
    index_other = _index(other_px, pixel_of_other, rectification.other, grid, jump)
    index_reference = _reference_index(reference_px, rectification, grid, jump)
    out = Matches(
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.uint16),
    )
    unknown = np.full((1, reference_px.shape[1]), np.nan, np.float32)
    _match_rows(
        reference_px,
        other_px,
        unknown if sigma_reference_px is None else kernel_input(sigma_reference_px),
        unknown if sigma_other_px is None else kernel_input(sigma_other_px),
        rectification.rectified_of_reference.nodes,
        pixel_of_other,
        np.array(rectification.other[:2], np.float64),
        index_reference,
        index_other,
        np.array([grid.low, grid.step, jump, settings.agreement_px], np.float64),
        *out,
    )
    return out


def sample_partner(
    values: Float32[np.ndarray, "h2 w2"], matches: Matches, rectification: Rectification
) -> Float32[np.ndarray, "h w"]:
    """Return what the other camera has at each partner (nearest pixel).

    Parameters
    ----------
    values
        Map of the other camera: modulation, residual, gray.
    matches
        Partners.
    rectification
        Geometry of the pair.

    Returns
    -------
    Values on the reference camera's pixels, float32; NaN where there is no partner.
    """
    out = np.empty(matches.x_other_px.shape, np.float32)
    _sample_rows(
        kernel_input(values),
        matches.x_other_px,
        rectification.rectified_of_reference.nodes,
        rectification.pixel_of_other.map(),
        np.array(rectification.other, np.int64),
        out,
    )
    return out


# ---------------------------------------------------------------- preparation


def _check(
    reference_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h2 w2"],
    rectification: Rectification,
) -> None:
    reference = rectification.rectified_of_reference
    sizes = ((reference.width_px, reference.height_px), rectification.other_size_px)
    for name, values, (width, height) in zip(
        ("reference", "other"), (reference_px, other_px), sizes, strict=True
    ):
        if values.shape != (height, width):
            raise MatchingError(
                f"the {name} camera's map is {values.shape[1]}x{values.shape[0]} px but its calibration"
                f" is for {width}x{height} px; use the calibration of this size"
            )
        if not np.isfinite(values[::7, ::7]).any() and not np.isfinite(values).any():
            raise MatchingError(
                f"no pixel of the {name} camera has a coordinate; see the reasons map of the stage before"
            )


def _median_step(
    reference_px: Float32[np.ndarray, "h w"], other_px: Float32[np.ndarray, "h2 w2"]
) -> float:
    """Return the median change of the coordinate between neighbours of both cameras."""
    steps = [_steps_of(values) for values in (reference_px, other_px)]
    median = float(np.median(np.concatenate(steps)))
    if not median > 0:
        raise MatchingError(
            "the projector coordinate doesn't change from pixel to pixel; check the capture and the"
            " fringe direction"
        )
    return median


def _steps_of(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "n"]:
    rows = values[:: max(values.shape[0] // 64, 1)]
    columns = values[:, :: max(values.shape[1] // 16, 1)]
    across, down = np.abs(np.diff(rows, axis=1)), np.abs(np.diff(columns, axis=0))
    across, down = across[np.isfinite(across)], down[np.isfinite(down)]
    # The coded direction is the one that changes; cameras may be mounted on their side.
    if across.size == 0 or (down.size and np.median(down) > np.median(across)):
        return down
    return across


class _Grid(NamedTuple):
    """Values of the coordinate at which an index notes the place: low + k step."""

    low: float
    step: float
    cells: int


def _grid(other_px: Float32[np.ndarray, "h2 w2"], step: float, width_px: int) -> _Grid:
    """Lay about one value on each pixel of the other camera."""
    low, high = float(np.nanmin(other_px)), float(np.nanmax(other_px))
    step = max(step, (high - low) / (_CELLS_MAX * width_px))
    # one below, for a coordinate a hair under the lowest
    return _Grid(low - step, step, int((high - low) / step) + 4)


def _index(
    values: Float32[np.ndarray, "h w"],
    pixel_of_canvas: Float32[np.ndarray, "2 rows columns"],
    canvas: Canvas,
    grid: _Grid,
    jump: float,
) -> Float32[np.ndarray, "rows cells"]:
    index = np.empty((canvas.height_px, grid.cells), np.float32)
    _index_rows(values, pixel_of_canvas, float(canvas.x0_px), grid.low, grid.step, jump, index)
    return index


def _reference_index(
    reference_px: Float32[np.ndarray, "h w"],
    rectification: Rectification,
    grid: _Grid,
    jump: float,
) -> Float32[np.ndarray, "rows cells"]:
    canvas = rectification.reference
    index = np.empty((canvas.height_px, grid.cells), np.float32)
    _index_lattice_rows(
        reference_px,
        rectification.pixel_of_reference.nodes,
        canvas.width_px,
        float(canvas.x0_px),
        grid.low,
        grid.step,
        jump,
        index,
    )
    return index


# ---------------------------------------------------------------- kernels


@row_loop
def _nearest(values: Any, px: Any, py: Any, out: Any) -> Any:
    """Pick the pixel nearest to each position; NaN outside."""
    height, width = values.shape
    for i in range(out.size):
        x = np.int32(np.floor(px[i] + np.float32(0.5)))
        y = np.int32(np.floor(py[i] + np.float32(0.5)))
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        out[i] = values[y, x] if inside else _EMPTY


@row_loop
def _crossings(row: Any, x0: Any, low: Any, step: Any, jump: Any, out: Any) -> Any:
    """Write where the row crosses each value low + k step; inf where it does so at two places."""
    for k in range(out.size):
        out[k] = _EMPTY
    before = (row[0] - low) / step
    jump_cells = jump / step
    for i in range(1, row.size):
        now = (row[i] - low) / step
        difference = now - before
        if abs(difference) <= jump_cells and difference != 0.0:  # False with NaN
            first = np.int64(np.ceil(min(before, now)))
            last = np.int64(np.floor(max(before, now)))
            begin, end = max(first, np.int64(0)), min(last, np.int64(out.size - 1))
            for k in range(begin, end + 1):
                place = np.float32(x0 + i - 1 + (k - before) / difference)
                if np.isnan(out[k]):
                    out[k] = place
                elif not abs(out[k] - place) <= _SAME_PLACE_PX:
                    out[k] = _MANY
        before = now


@kernel
def _index_rows(
    values: Any, pixel_of_canvas: Any, x0: Any, low: Any, step: Any, jump: Any, index: Any
) -> None:
    for y in numba.prange(index.shape[0]):
        row = np.empty(pixel_of_canvas.shape[2], np.float32)
        _nearest(values, pixel_of_canvas[0, y], pixel_of_canvas[1, y], row)
        _crossings(row, x0, low, step, jump, index[y])


@kernel
def _index_lattice_rows(
    values: Any, nodes: Any, width: Any, x0: Any, low: Any, step: Any, jump: Any, index: Any
) -> None:
    for y in numba.prange(index.shape[0]):
        row = np.empty(width, np.float32)
        px = np.empty(width, np.float32)
        py = np.empty(width, np.float32)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], y, work, px)
        lattice_row(nodes[1], y, work, py)
        _nearest(values, px, py, row)
        _crossings(row, x0, low, step, jump, index[y])


@row_loop
def _look_up(index_row: Any, cell: Any) -> Any:
    """Return the place of a coordinate between two index entries, and a second one if they are far apart."""
    below = np.floor(cell)
    if not (below >= 0.0 and below < index_row.size - 1):
        return _EMPTY, _EMPTY
    k = np.uint64(np.int64(below))
    a, b = index_row[k], index_row[k + _ONE]
    if np.isnan(a):
        return b, _EMPTY
    if np.isnan(b):
        return a, _EMPTY
    if abs(a - b) <= 2.0 * _SAME_PLACE_PX:  # False if one is inf
        return np.float32(a + (cell - below) * (b - a)), _EMPTY
    if cell - below < 0.5:
        return a, b
    return b, a


@row_loop
def _mutual(first: Any, second: Any, x: Any, agreement: Any) -> Any:
    """Tell whether the reference's own index leads from the coordinate back to x."""
    if np.isnan(first):
        return True  # a sliver narrower than the index: nothing speaks against it
    # inf, two places in the reference, is never near
    return abs(first - x) <= agreement or abs(second - x) <= agreement


@row_loop
def _start_row(
    targets: Any,
    x: Any,
    line: Any,
    index_reference: Any,
    index_other: Any,
    limits: Any,
    start: Any,
    second: Any,
    reasons: Any,
) -> Any:
    """Look up where to start on each pixel's epipolar line; say whether a pixel has two places."""
    low, scale, agreement = limits[0], 1.0 / limits[1], limits[3]
    two_places = False
    for i in range(targets.size):
        start[i] = second[i] = np.nan
        reasons[i] = 0
        if np.isnan(targets[i]):
            continue
        nearest = np.floor(line[i] + 0.5)
        if nearest < 0 or nearest >= index_other.shape[0]:
            reasons[i] = _NO_MATCH
            continue
        row = np.uint64(np.int64(nearest))
        cell = (targets[i] - low) * scale
        first, other = _look_up(index_other[row], cell)
        back, back_too = _look_up(index_reference[row], cell)
        if np.isnan(first):
            reasons[i] = _NO_MATCH
        elif np.isinf(first) or np.isinf(other):
            reasons[i] = _AMBIGUOUS
        elif not _mutual(back, back_too, x[i], agreement):
            reasons[i] = _ONE_WAY
        else:
            start[i], second[i] = first, other
            two_places |= not np.isnan(other)
    return two_places


@row_loop
def _refine_row(  # noqa: C901  # one loop: splitting it costs a call with 40 arguments per pixel
    values: Any,
    sigma: Any,
    pixel_of_canvas: Any,
    targets: Any,
    start: Any,
    line: Any,
    x0: Any,
    jump: Any,
    out_x: Any,
    out_slope: Any,
    out_variance: Any,
) -> Any:
    """Follow each epipolar line from its start to where the coordinate is the target.

    Writes x, the slope du/dx and the variance of u there; NaN if there is no such place nearby.
    """
    height, width = values.shape
    rows, columns = pixel_of_canvas.shape[1], pixel_of_canvas.shape[2]
    noisy = sigma.shape[0] == height
    for n in range(targets.size):
        out_x[n] = out_slope[n] = out_variance[n] = np.nan
        x = start[n] - x0
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
                out_x[n], out_slope[n], out_variance[n] = x + x0, slope, 0.0
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
    targets: Any,
    sigma_row: Any,
    x: Any,
    slope: Any,
    variance: Any,
    out_x: Any,
    out_sigma: Any,
    out_slope: Any,
    out_reasons: Any,
) -> Any:
    for i in range(x.size):
        out_x[i], out_slope[i] = x[i], slope[i]
        out_sigma[i] = np.sqrt(sigma_row[i] * sigma_row[i] + variance[i]) / abs(slope[i])
        if np.isnan(x[i]) and not np.isnan(targets[i]) and out_reasons[i] == 0:
            out_reasons[i] = _NO_MATCH


@kernel
def _match_rows(
    reference_px: Any,
    other_px: Any,
    sigma_reference: Any,
    sigma_other: Any,
    nodes: Any,
    pixel_of_canvas: Any,
    corner: Any,
    index_reference: Any,
    index_other: Any,
    limits: Any,
    out_x: Any,
    out_sigma: Any,
    out_slope: Any,
    out_reasons: Any,
) -> None:
    height, width = reference_px.shape
    known = np.int64(1 if sigma_reference.shape[0] == height else 0)
    for row in numba.prange(height):
        xs = np.empty((10, width), np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        x, line, start, second = xs[0], xs[1], xs[2], xs[3]
        found, slope, variance = xs[4], xs[5], xs[6]
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, line)
        line -= corner[1]
        targets = reference_px[row]
        two_places = _start_row(
            targets, x, line, index_reference, index_other, limits, start, second, out_reasons[row]
        )
        _refine_row(
            other_px,
            sigma_other,
            pixel_of_canvas,
            targets,
            start,
            line,
            corner[0],
            limits[2],
            found,
            slope,
            variance,
        )
        if two_places:
            _refine_row(
                other_px,
                sigma_other,
                pixel_of_canvas,
                targets,
                second,
                line,
                corner[0],
                limits[2],
                xs[7],
                xs[8],
                xs[9],
            )
            _choose_row(second, found, slope, variance, xs[7], xs[8], xs[9], out_reasons[row])
        _finish_row(
            targets,
            sigma_reference[np.int64(row) * known],
            found,
            slope,
            variance,
            out_x[row],
            out_sigma[row],
            out_slope[row],
            out_reasons[row],
        )


@row_loop
def _between(plane: Any, row: Any, column: Any, fx: Any, fy: Any) -> Any:
    corner = plane[row, column]
    return corner + fx * (plane[row, column + 1] - corner) + fy * (plane[row + 1, column] - corner)


@kernel
def _sample_rows(
    values: Any, x_other: Any, nodes: Any, pixel_of_canvas: Any, other: Any, out: Any
) -> None:
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
