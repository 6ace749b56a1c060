"""Partners in two cameras: equal projector coordinate on the epipolar line, sub-pixel, checked both ways."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, UInt16

from backend.numerics.errors import MatchingError
from backend.numerics.kernels import kernel, row_loop
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
_MANY = np.float32(np.inf)
_NO_MATCH = np.uint16(Reason.NO_MATCH)
_AMBIGUOUS = np.uint16(Reason.AMBIGUOUS_MATCH)
_ONE_WAY = np.uint16(Reason.LEFT_RIGHT_CHECK)
_SAME_PLACE_PX = 3.0
"""Crossings of one coordinate this near to each other are noise on one surface, not two surfaces."""
_JUMP_STEPS = 5.0
_CELLS_MAX = 4


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
    step = _median_step(reference_px, other_px)
    jump = settings.jump_px if settings.jump_px is not None else _JUMP_STEPS * step
    low, cells = _range(other_px, step, rectification.other.width_px)
    grid = (low, step)
    pixel_of_other = rectification.pixel_of_other.map()
    index_other = _index(other_px, pixel_of_other, rectification.other, grid, cells, jump)
    index_reference = _reference_index(reference_px, rectification, grid, cells, jump)
    out = Matches(
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.uint16),
    )
    unknown = np.full((1, 1), np.nan, np.float32)
    _match_rows(
        reference_px,
        other_px,
        unknown if sigma_reference_px is None else sigma_reference_px,
        unknown if sigma_other_px is None else sigma_other_px,
        rectification.rectified_of_reference.nodes,
        pixel_of_other,
        np.array(rectification.reference, np.int64),
        np.array(rectification.other, np.int64),
        index_reference,
        index_other,
        np.array([low, step, jump, settings.agreement_px], np.float64),
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
        values,
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
    for name, values, lattice in (
        ("reference", reference_px, rectification.rectified_of_reference),
        ("other", other_px, None),
    ):
        if lattice is not None and values.shape != (lattice.height_px, lattice.width_px):
            raise MatchingError(
                f"the {name} camera's map is {values.shape[1]}x{values.shape[0]} px but its calibration"
                f" is for {lattice.width_px}x{lattice.height_px} px; use the calibration of this size"
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
    rows = values[:: max(values.shape[0] // 128, 1)]
    columns = values[:, :: max(values.shape[1] // 128, 1)]
    across, down = np.abs(np.diff(rows, axis=1)), np.abs(np.diff(columns, axis=0))
    across, down = across[np.isfinite(across)], down[np.isfinite(down)]
    # The coded direction is the one that changes; cameras may be mounted on their side.
    if across.size == 0 or (down.size and np.median(down) > np.median(across)):
        return down
    return across


def _range(other_px: Float32[np.ndarray, "h2 w2"], step: float, width_px: int) -> tuple[float, int]:
    low, high = float(np.nanmin(other_px)), float(np.nanmax(other_px))
    cells = int((high - low) / step) + 2
    return low, min(cells, _CELLS_MAX * width_px)


def _index(
    values: Float32[np.ndarray, "h w"],
    pixel_of_canvas: Float32[np.ndarray, "2 rows columns"],
    canvas: Canvas,
    grid: tuple[float, float],
    cells: int,
    jump: float,
) -> Float32[np.ndarray, "rows cells"]:
    index = np.empty((canvas.height_px, cells), np.float32)
    _index_rows(values, pixel_of_canvas, float(canvas.x0_px), grid[0], grid[1], jump, index)
    return index


def _reference_index(
    reference_px: Float32[np.ndarray, "h w"],
    rectification: Rectification,
    grid: tuple[float, float],
    cells: int,
    jump: float,
) -> Float32[np.ndarray, "rows cells"]:
    canvas = rectification.reference
    index = np.empty((canvas.height_px, cells), np.float32)
    _index_lattice_rows(
        reference_px,
        rectification.pixel_of_reference.nodes,
        canvas.width_px,
        float(canvas.x0_px),
        grid[0],
        grid[1],
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
            for k in range(max(first, 0), min(last, out.size - 1) + 1):
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
    k = np.int64(np.floor(cell))
    a = index_row[k] if 0 <= k < index_row.size else _EMPTY
    b = index_row[k + 1] if 0 <= k + 1 < index_row.size else _EMPTY
    if np.isnan(a):
        return b, _EMPTY
    if np.isnan(b):
        return a, _EMPTY
    if abs(a - b) <= 2.0 * _SAME_PLACE_PX:  # False if one is inf
        return np.float32(a + (cell - k) * (b - a)), _EMPTY
    if cell - k < 0.5:
        return a, b
    return b, a


@row_loop
def _refine(
    values: Any, sigma: Any, pixel_of_canvas: Any, x: Any, y: Any, target: Any, jump: Any
) -> Any:
    """Follow the epipolar line from x to where the coordinate is the target.

    Returns x (NaN if there is no such place nearby), slope du/dx, and the variance of u there.
    """
    height, width = values.shape
    start = x
    row = min(max(np.int64(np.floor(y)), 0), pixel_of_canvas.shape[1] - 2)
    old_i, old_j = np.int64(-1), np.int64(-1)
    for attempt in range(10):
        column = np.int64(np.floor(x))
        if column < 0 or column >= pixel_of_canvas.shape[2] - 1:
            break
        fx, fy = x - column, y - row
        px00, px01 = pixel_of_canvas[0, row, column], pixel_of_canvas[0, row, column + 1]
        py00, py01 = pixel_of_canvas[1, row, column], pixel_of_canvas[1, row, column + 1]
        dpx, dpy = px01 - px00, py01 - py00
        px = px00 + fx * dpx + fy * (pixel_of_canvas[0, row + 1, column] - px00)
        py = py00 + fx * dpy + fy * (pixel_of_canvas[1, row + 1, column] - py00)
        i, j = np.int64(np.floor(px)), np.int64(np.floor(py))
        if i < 0 or j < 0 or i >= width - 1 or j >= height - 1:
            break
        u00, u01 = values[j, i], values[j, i + 1]
        u10, u11 = values[j + 1, i], values[j + 1, i + 1]
        spread = max(max(u00, u01), max(u10, u11)) - min(min(u00, u01), min(u10, u11))
        # max and min may pass over NaN, the sum doesn't
        if not (spread <= jump) or np.isnan(u00 + u01 + u10 + u11):
            break
        a, b = px - i, py - j
        gx = (1.0 - b) * (u01 - u00) + b * (u11 - u10)
        gy = (1.0 - a) * (u10 - u00) + a * (u11 - u01)
        slope = gx * dpx + gy * dpy
        value = (1.0 - b) * (u00 + a * (u01 - u00)) + b * (u10 + a * (u11 - u10))
        if abs(slope) * 50.0 < spread:
            break
        move = (target - value) / slope
        if attempt >= 4:
            move *= 0.5  # two cells that send us to and fro
        x += min(max(move, -2.0), 2.0)
        if abs(x - start) > _SAME_PLACE_PX:
            break
        settled = abs(move) < 1e-4 or (i == old_i and j == old_j and abs(move) < 2e-2)
        if settled:
            # Still within the cell whose four pixels were used, or a hair outside
            w00, w01 = (1.0 - a) * (1.0 - b), a * (1.0 - b)
            w10, w11 = (1.0 - a) * b, a * b
            variance = 0.0
            if sigma.shape[0] == height:
                variance = (
                    (w00 * sigma[j, i]) ** 2
                    + (w01 * sigma[j, i + 1]) ** 2
                    + (w10 * sigma[j + 1, i]) ** 2
                    + (w11 * sigma[j + 1, i + 1]) ** 2
                )
            return x, slope, variance
        old_i, old_j = i, j
    return np.nan, np.nan, np.nan


@row_loop
def _mutual(index_row: Any, cell: Any, x: Any, agreement: Any) -> Any:
    """Tell whether the reference's own index leads from the coordinate back to x."""
    first, second = _look_up(index_row, cell)
    if np.isnan(first):
        return True  # a sliver narrower than the index: nothing speaks against it
    # inf, two places in the reference, is never near
    return abs(first - x) <= agreement or abs(second - x) <= agreement


@row_loop
def _partner(
    values: Any,
    sigma: Any,
    pixel_of_canvas: Any,
    index_row: Any,
    cell: Any,
    origin: Any,
    y: Any,
    target: Any,
    jump: Any,
) -> Any:
    """Return rectified x, slope, variance and reason of one coordinate's partner."""
    first, second = _look_up(index_row, cell)
    if np.isinf(first) or np.isinf(second):
        return np.nan, np.nan, np.nan, _AMBIGUOUS
    if np.isnan(first):
        return np.nan, np.nan, np.nan, _NO_MATCH
    x, slope, variance = _refine(values, sigma, pixel_of_canvas, first - origin, y, target, jump)
    if not np.isnan(second):
        x2, slope2, variance2 = _refine(
            values, sigma, pixel_of_canvas, second - origin, y, target, jump
        )
        if np.isnan(x):
            x, slope, variance = x2, slope2, variance2
        elif abs(x2 - x) > _SAME_PLACE_PX:
            return np.nan, np.nan, np.nan, _AMBIGUOUS
    if np.isnan(x):
        return np.nan, np.nan, np.nan, _NO_MATCH
    return x + origin, slope, variance, np.uint16(0)


@row_loop
def _match_row(
    targets: Any,
    sigma_row: Any,
    values: Any,
    sigma: Any,
    x: Any,
    y: Any,
    pixel_of_canvas: Any,
    reference: Any,
    other: Any,
    index_reference: Any,
    index_other: Any,
    limits: Any,
    out_x: Any,
    out_sigma: Any,
    out_slope: Any,
    out_reasons: Any,
) -> Any:
    low, step, jump, agreement = limits[0], limits[1], limits[2], limits[3]
    for i in range(targets.size):
        out_x[i] = out_sigma[i] = out_slope[i] = _EMPTY
        out_reasons[i] = 0
        if np.isnan(targets[i]):
            continue
        target = np.float64(targets[i])
        line = y[i] - other[1]
        row = np.int64(np.floor(line + 0.5))
        if row < 0 or row >= index_other.shape[0]:
            out_reasons[i] = _NO_MATCH
            continue
        cell = (target - low) / step
        place, slope, variance, reason = _partner(
            values,
            sigma,
            pixel_of_canvas,
            index_other[row],
            cell,
            np.float64(other[0]),
            line,
            target,
            jump,
        )
        if reason == 0 and not _mutual(index_reference[row], cell, x[i], agreement):
            reason = _ONE_WAY
        out_reasons[i] = reason
        if reason == 0:
            out_x[i] = place
            out_slope[i] = slope
            own = sigma_row[i if sigma_row.size > 1 else 0]
            out_sigma[i] = np.sqrt(own * own + variance) / abs(slope)


@kernel
def _match_rows(
    reference_px: Any,
    other_px: Any,
    sigma_reference: Any,
    sigma_other: Any,
    nodes: Any,
    pixel_of_canvas: Any,
    reference: Any,
    other: Any,
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
        x = np.empty(width, np.float64)
        y = np.empty(width, np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, y)
        _match_row(
            reference_px[row],
            sigma_reference[np.int64(row) * known],
            other_px,
            sigma_other,
            x,
            y,
            pixel_of_canvas,
            reference,
            other,
            index_reference,
            index_other,
            limits,
            out_x[row],
            out_sigma[row],
            out_slope[row],
            out_reasons[row],
        )


@kernel
def _sample_rows(
    values: Any, x_other: Any, nodes: Any, pixel_of_canvas: Any, other: Any, out: Any
) -> None:
    height, width = x_other.shape
    for row in numba.prange(height):
        y = np.empty(width, np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[1], row, work, y)
        for i in range(width):
            out[row, i] = _EMPTY
            if np.isnan(x_other[row, i]):
                continue
            column = np.int64(np.floor(x_other[row, i] - other[0] + 0.5))
            line = np.int64(np.floor(y[i] - other[1] + 0.5))
            if 0 <= line < pixel_of_canvas.shape[1] and 0 <= column < pixel_of_canvas.shape[2]:
                px = np.int64(np.floor(pixel_of_canvas[0, line, column] + 0.5))
                py = np.int64(np.floor(pixel_of_canvas[1, line, column] + 0.5))
                if 0 <= px < values.shape[1] and 0 <= py < values.shape[0]:
                    out[row, i] = values[py, px]
