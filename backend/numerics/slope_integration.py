"""From slopes to heights: least squares over all pairs of neighbours of a mask, by multigrid."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Float64

from backend.numerics.kernels import kernel, kernel_input

_COARSEST = 4
"""Levels end when a side is this small."""
_SWEEPS_AT_THE_END = 12
_SMALL_PX = 1 << 16
"""Grids below this are done by one thread: waking the others costs more."""
_MOST_ROUNDS = 300


class Integration(NamedTuple):
    """Heights, and how well one surface explains all slopes."""

    height_mm: Float64[np.ndarray, "h w"]
    """NaN outside the mask; each connected part has mean 0."""
    misfit_mm: float
    """Rms of (difference of two neighbours' heights) - (what their slopes say)."""
    rounds: int


def integrate_slopes(
    x_mm: Float[np.ndarray, "h w"],
    y_mm: Float[np.ndarray, "h w"],
    slope_x: Float[np.ndarray, "h w"],
    slope_y: Float[np.ndarray, "h w"],
    *,
    tolerance: float = 1e-7,
) -> Integration:
    r"""Integrate slopes over a mask of any shape.

    Parameters
    ----------
    x_mm, y_mm
        Where each pixel lies on the surface; any smooth map of the pixels, not necessarily an even grid.
    slope_x, slope_y
        dz/dx and dz/dy there. A pixel takes part where all four maps are finite.
    tolerance
        Relative residual of the normal equations at which to stop.

    Returns
    -------
    Integration
        Exact for surfaces of second order to rounding; on smooth ones the error is that of the trapezoid
        rule, a twelfth of d^3 z''' per neighbour, which mostly cancels.

    Notes
    -----
    Minimises :math:`\sum_{ij} (z_j - z_i - d_{ij})^2` over all neighbours in a row or a column with
    :math:`d_{ij} = \frac12 (s_i + s_j) \cdot (r_j - r_i)`: trapezoid rule along each step, as the paper's
    comparison recommends for masked apertures. Normal equations are a graph's Laplacian, solved by
    conjugate gradients, preconditioned by a V-cycle over 2 x 2 aggregates whose operators are halved, as
    piecewise constant corrections are too small by 2 [1]_. About 20 rounds for any size of picture.

    References
    ----------
    .. [1] D. Braess, "Towards algebraic multigrid for elliptic problems of second order",
       Computing 55, 379 (1995), doi:10.1007/BF02238488.
    """
    valid = np.isfinite(x_mm) & np.isfinite(y_mm) & np.isfinite(slope_x) & np.isfinite(slope_y)
    x, y, sx, sy = (
        np.where(valid, a, 0.0).astype(np.float64) for a in (x_mm, y_mm, slope_x, slope_y)
    )
    right = np.zeros(valid.shape)
    down = np.zeros(valid.shape)
    right[:, :-1] = valid[:, :-1] & valid[:, 1:]
    down[:-1] = valid[:-1] & valid[1:]
    steps_right = np.zeros(valid.shape)
    steps_down = np.zeros(valid.shape)
    steps_right[:, :-1] = _steps(
        x, y, sx, sy, (slice(None), slice(1, None)), (slice(None), slice(-1))
    )
    steps_down[:-1] = _steps(x, y, sx, sy, (slice(1, None),), (slice(-1),))
    steps_right *= right
    steps_down *= down
    wanted = -steps_right - steps_down
    wanted[:, 1:] += steps_right[:, :-1]
    wanted[1:] += steps_down[:-1]
    height, rounds = _solve(_levels(right, down), wanted, tolerance)
    height = _without_pistons(height, valid)
    return Integration(height, _misfit(height, right, down, steps_right, steps_down), rounds)


def _steps(
    x: Float64[np.ndarray, "h w"],
    y: Float64[np.ndarray, "h w"],
    sx: Float64[np.ndarray, "h w"],
    sy: Float64[np.ndarray, "h w"],
    there: tuple[slice, ...],
    here: tuple[slice, ...],
) -> Float64[np.ndarray, "a b"]:
    along_x = 0.5 * (sx[here] + sx[there]) * (x[there] - x[here])
    return np.asarray(along_x + 0.5 * (sy[here] + sy[there]) * (y[there] - y[here]))


def _misfit(
    height: Float64[np.ndarray, "h w"],
    right: Float64[np.ndarray, "h w"],
    down: Float64[np.ndarray, "h w"],
    steps_right: Float64[np.ndarray, "h w"],
    steps_down: Float64[np.ndarray, "h w"],
) -> float:
    pairs = right.sum() + down.sum()
    if pairs == 0:
        return float("nan")
    off_right = (np.diff(height, axis=1) - steps_right[:, :-1])[right[:, :-1] > 0]
    off_down = (np.diff(height, axis=0) - steps_down[:-1])[down[:-1] > 0]
    return float(np.sqrt(((off_right**2).sum() + (off_down**2).sum()) / pairs))


def _without_pistons(
    height: Float64[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w"]:
    """Give each connected part mean 0: slopes don't say how parts lie to one another."""
    import cv2

    count, labels = cv2.connectedComponents(valid.astype(np.uint8), connectivity=4)
    pixels = np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
    means = np.bincount(labels.ravel(), height.ravel(), minlength=count) / pixels
    return np.asarray(np.where(valid, height - means[labels], np.nan))


class _Level(NamedTuple):
    """One grid: weights of the steps to the right and down, and what a pixel's steps sum up to."""

    right: Float64[np.ndarray, "_h _w"]
    down: Float64[np.ndarray, "_h _w"]
    total: Float64[np.ndarray, "_h _w"]


def _levels(right: Float64[np.ndarray, "h w"], down: Float64[np.ndarray, "h w"]) -> list[_Level]:
    levels = [_level(right, down)]
    while max(levels[-1].total.shape) > _COARSEST:
        last = levels[-1]
        levels.append(
            _level(0.5 * _crossing(last.right, axis=1), 0.5 * _crossing(last.down, axis=0))
        )
    return levels


def _level(right: Float64[np.ndarray, "h w"], down: Float64[np.ndarray, "h w"]) -> _Level:
    total = right + down
    total[:, 1:] += right[:, :-1]
    total[1:] += down[:-1]
    return _Level(right, down, total)


def _crossing(weights: Float64[np.ndarray, "h w"], axis: int) -> Float64[np.ndarray, "a b"]:
    """Sum the weights of the steps that lead from one 2 x 2 block to the next."""
    padded = np.pad(weights, [(0, n % 2) for n in weights.shape])
    if axis == 1:
        last = padded[:, 1::2]
        return np.asarray(last[0::2] + last[1::2])
    last = padded[1::2]
    return np.asarray(last[:, 0::2] + last[:, 1::2])


def _solve(
    levels: list[_Level], wanted: Float64[np.ndarray, "h w"], tolerance: float
) -> tuple[Float64[np.ndarray, "h w"], int]:
    """Conjugate gradients; the system is singular (heights have no zero) but consistent."""
    solution = np.zeros_like(wanted)
    residual = wanted.copy()
    goal = tolerance * np.sqrt(_dot(residual, residual))
    if goal == 0.0:
        return solution, 0
    direction, product = np.zeros_like(wanted), np.empty_like(wanted)
    before = 1.0
    for round_ in range(1, _MOST_ROUNDS + 1):
        better = _v_cycle(levels, residual, 0)
        now = _dot(residual, better)
        direction = better + (now / before if round_ > 1 else 0.0) * direction
        _apply(*levels[0], direction, product)
        step = now / _dot(direction, product)
        solution += step * direction
        residual -= step * product
        before = now
        if np.sqrt(_dot(residual, residual)) <= goal:
            break
    return solution, round_


def _dot(a: Float64[np.ndarray, "h w"], b: Float64[np.ndarray, "h w"]) -> float:
    """Multiply and sum without BLAS, whose threads would go on spinning between these short calls."""
    return float(np.einsum("ij,ij->", a, b))


def _v_cycle(
    levels: list[_Level], wanted: Float64[np.ndarray, "h w"], depth: int
) -> Float64[np.ndarray, "h w"]:
    level = levels[depth]
    found = np.zeros_like(wanted)
    threads = numba.get_num_threads()
    if wanted.size < _SMALL_PX:
        numba.set_num_threads(1)
    if depth == len(levels) - 1:
        for colour in (0, 1) * _SWEEPS_AT_THE_END + (1, 0) * _SWEEPS_AT_THE_END:
            _smooth(*level, wanted, found, colour)
        numba.set_num_threads(threads)
        return found
    _smooth(*level, wanted, found, 0)
    _smooth(*level, wanted, found, 1)
    rest = np.empty_like(wanted)
    _apply(*level, found, rest)
    np.subtract(wanted, rest, out=rest)
    coarse = _v_cycle(levels, _gather(rest), depth + 1)
    numba.set_num_threads(threads if wanted.size >= _SMALL_PX else 1)
    found += np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[: rest.shape[0], : rest.shape[1]]
    # The same sweeps backwards: the preconditioner has to be symmetric.
    _smooth(*level, wanted, found, 1)
    _smooth(*level, wanted, found, 0)
    numba.set_num_threads(threads)
    return found


def _gather(values: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "a b"]:
    """Sum over 2 x 2 blocks."""
    padded = np.pad(values, [(0, n % 2) for n in values.shape])
    rows = padded[0::2] + padded[1::2]
    return np.ascontiguousarray(rows[:, 0::2] + rows[:, 1::2])


@kernel
def _apply(right: Any, down: Any, total: Any, z: Any, out: Any) -> None:
    """Multiply by the graph's Laplacian."""
    height, width = z.shape
    for y in numba.prange(height):
        for x in range(width):
            value = total[y, x] * z[y, x]
            if x > 0:
                value -= right[y, x - 1] * z[y, x - 1]
            if x < width - 1:
                value -= right[y, x] * z[y, x + 1]
            if y > 0:
                value -= down[y - 1, x] * z[y - 1, x]
            if y < height - 1:
                value -= down[y, x] * z[y + 1, x]
            out[y, x] = value


@kernel
def _smooth(right: Any, down: Any, total: Any, wanted: Any, z: Any, colour: Any) -> None:
    """Solve each pixel of one colour of the chessboard for itself, its neighbours given."""
    height, width = z.shape
    for y in numba.prange(height):
        for x in range((y + colour) % 2, width, 2):
            if total[y, x] > 0.0:
                value = wanted[y, x]
                if x > 0:
                    value += right[y, x - 1] * z[y, x - 1]
                if x < width - 1:
                    value += right[y, x] * z[y, x + 1]
                if y > 0:
                    value += down[y - 1, x] * z[y - 1, x]
                if y < height - 1:
                    value += down[y, x] * z[y + 1, x]
                z[y, x] = value / total[y, x]


def warm_up_kernels() -> None:
    """Compile or load the kernels."""
    y, x = (kernel_input(a) for a in np.mgrid[0.0:8.0, 0.0:8.0])
    integrate_slopes(x, y, x, y)
