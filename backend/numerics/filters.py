"""Which points of an organised cloud to leave out; nothing here moves a point or fills a hole.

A cloud is given by its depths: the points lie on their pixels' rays.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32

from backend.numerics.errors import NumericsError
from backend.numerics.kernels import kernel, kernel_input, row_loop
from backend.numerics.lattice import Lattice


class Kept(NamedTuple):
    """Points that a filter keeps."""

    keep: Bool[np.ndarray, "h w"]
    """False where the point is missing already or left out."""
    removed: int
    """Number of points that were there and are left out."""


def valid_points(depth_mm: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return where there is a point."""
    return np.asarray(np.isfinite(depth_mm))


def remove(depth_mm: Float32[np.ndarray, "h w"], kept: Kept) -> Bool[np.ndarray, "h w"]:
    """Set the points that a filter doesn't keep to NaN, in place; return where they were."""
    gone = np.asarray(valid_points(depth_mm) & ~kept.keep)
    depth_mm[gone] = np.nan
    return gone


def within_limits(
    depth_mm: Float32[np.ndarray, "h w"],
    values: Float32[np.ndarray, "h w"],
    *,
    lowest: float = -np.inf,
    highest: float = np.inf,
    sigma: Float32[np.ndarray, "h w"] | None = None,
    sigmas: float = 0.0,
) -> Kept:
    """Keep points whose value (residual, modulation, sigma, consistency) lies in a range, ends included.

    Parameters
    ----------
    depth_mm
        Organised cloud in [mm], NaN invalid.
    values
        One value per point. NaN is within every range: what isn't known removes nothing.
    lowest, highest
        The range.
    sigma, sigmas
        Standard deviation of the values, and how many of them a value may lie outside. NaN counts as 0.
    """
    keep = np.empty(depth_mm.shape, bool)
    removed = np.empty(depth_mm.shape[0], np.int64)
    certain = np.zeros((1, depth_mm.shape[1]), np.float32)
    _limit_rows(
        kernel_input(depth_mm),
        kernel_input(values),
        certain if sigma is None else kernel_input(sigma),
        np.array([lowest, highest, sigmas], np.float32),
        keep,
        removed,
    )
    return Kept(keep, int(removed.sum()))


def within_box(
    depth_mm: Float32[np.ndarray, "h w"],
    rays: Lattice,
    lowest_mm: tuple[float, float, float],
    highest_mm: tuple[float, float, float],
) -> Kept:
    """Keep points inside a box, borders included; infinite borders are allowed.

    Raises
    ------
    NumericsError
        If a lower border lies above its upper one.
    """
    low, high = np.asarray(lowest_mm, np.float32), np.asarray(highest_mm, np.float32)
    if not (low <= high).all():
        raise NumericsError(
            f"the clipping box {lowest_mm} to {highest_mm} mm is empty; exchange its borders"
        )
    valid = valid_points(depth_mm)
    x, y = rays.map() * depth_mm
    good = valid.copy()
    for axis, values in enumerate((x, y, depth_mm)):
        if np.isfinite(low[axis]) or np.isfinite(high[axis]):
            good &= (values >= low[axis]) & (values <= high[axis])
    return Kept(good, int(np.count_nonzero(valid)) - int(np.count_nonzero(good)))


def without_outliers(
    depth_mm: Float32[np.ndarray, "h w"],
    *,
    sigma_mm: Float32[np.ndarray, "h w"] | None = None,
    pixel_angle_rad: float,
    factor: float = 5.0,
    steepest: float = 4.0,
    company: int = 3,
) -> Kept:
    r"""Remove points that stand apart from the median depth of their 5x5 neighbourhood.

    Parameters
    ----------
    depth_mm
        Organised cloud in [mm], NaN invalid.
    sigma_mm
        Standard deviation of each point in [mm], NaN counts as 0. None: the robust spread of all points about
        the middle of their neighbours in the row stands for it.
    pixel_angle_rad
        Angle between neighbouring pixels, 1 / focal length in px.
    factor
        Number of standard deviations that are noise.
    steepest
        Tangent of the surface's tilt up to which a neighbourhood's own relief is no outlier: curved or
        stepped, it may differ from its median by this many pixel sizes.
    company
        A point that differs stays if so many of its 24 neighbours are as near to it as the limit: a limb or a
        thin wire is a minority, but not alone. 25 means that none stays.

    Returns
    -------
    Kept points and the number removed. The limit is

    .. math:: |Z - \operatorname{med} Z| \le \text{factor} \cdot \sigma + \text{steepest} \cdot Z \alpha

    Notes
    -----
    A tilted plane equals its median exactly. Missing neighbours have no part in the median. Nearly every point has
    company among the nearest pixels of its row, so that hardly any median is formed.
    """
    depth = kernel_input(depth_mm)
    keep = np.empty(depth.shape, bool)
    removed = np.empty(depth.shape[0], np.int64)
    if sigma_mm is None:
        spread = np.full((1, depth.shape[1]), _spread_along_rows(depth), np.float32)
    else:
        spread = kernel_input(sigma_mm)
    limits = np.array([factor, steepest * pixel_angle_rad], np.float32)
    _outlier_rows(depth, spread, limits, company, keep, removed)
    return Kept(keep, int(removed.sum()))


def _spread_along_rows(depth_mm: Float32[np.ndarray, "h w"]) -> float:
    """Return the robust standard deviation of depths about the middle of their neighbours in the row."""
    rows = depth_mm[:: max(1, depth_mm.shape[0] // 64)]
    apart = np.abs(rows[:, 1:-1] - (rows[:, :-2] + rows[:, 2:]) / 2)
    known = apart[np.isfinite(apart)]
    # a third of the variance of a difference from the mean of two is that mean's
    return 1.4826 * float(np.median(known)) * float(np.sqrt(2 / 3)) if known.size else 0.0


def without_specks(
    depth_mm: Float32[np.ndarray, "h w"],
    *,
    least_pixels: int,
    pixel_angle_rad: float,
    steepest: float = 6.0,
) -> Kept:
    """Remove connected patches of fewer pixels than `least_pixels`.

    Parameters
    ----------
    depth_mm
        Organised cloud in [mm], NaN invalid.
    least_pixels
        Size of the smallest patch to keep. 0 and 1 keep all.
    pixel_angle_rad
        Angle between neighbouring pixels, 1 / focal length in px.
    steepest
        Neighbours (left, right, above, below) are connected up to this tangent of the tilt at the cloud's median
        depth.

    Returns
    -------
    Kept points and the number removed.

    Notes
    -----
    Patches are unions of runs along rows, first within strips of rows side by side, then across their borders.
    Cost: three passes over the depth; memory: one label per pixel.
    """
    depth = kernel_input(depth_mm)
    valid = valid_points(depth)
    if least_pixels <= 1 or not valid.any():
        return Kept(valid, 0)
    some = depth.ravel()[:: max(1, depth.size // 100_000)]
    some = some[np.isfinite(some)]
    middle_mm = float(np.median(some if some.size else depth[valid]))
    jump_mm = np.float32(steepest * pixel_angle_rad * middle_mm)
    label = np.empty(depth.size, np.int32)
    _label_runs(depth, jump_mm, label)
    _join_rows(depth, jump_mm, label, _STRIP)
    removed = np.empty(depth.shape[0], np.int64)
    _keep_patches(label, least_pixels, valid, removed)
    return Kept(valid, int(removed.sum()))


def pixel_angle(K: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle between neighbouring pixels of a camera in [rad]."""
    return float(2.0 / (K[0, 0] + K[1, 1]))


# ---------------------------------------------------------------- kernels


@row_loop
def _limit_row(depth: Any, values: Any, sigma: Any, limits: Any, keep: Any) -> Any:
    low, high, sigmas = limits[0], limits[1], limits[2]
    removed = 0
    for i in range(depth.size):
        slack = sigmas * sigma[i]
        slack = slack if slack > np.float32(0.0) else np.float32(0.0)  # also where it is NaN
        outside = (values[i] < low - slack) | (values[i] > high + slack)  # False with NaN
        valid = depth[i] == depth[i]
        keep[i] = valid & ~outside
        removed += 1 if valid & outside else 0
    return removed


@kernel
def _limit_rows(depth: Any, values: Any, sigma: Any, limits: Any, keep: Any, removed: Any) -> None:
    known = np.int64(1 if sigma.shape[0] == depth.shape[0] else 0)
    for row in numba.prange(depth.shape[0]):
        removed[row] = _limit_row(
            depth[row], values[row], sigma[np.int64(row) * known], limits, keep[row]
        )


@row_loop
def _company_in_row(
    depth: Any, sigma: Any, limits: Any, company: Any, limit: Any, keep: Any
) -> Any:
    """Note each point's limit, and keep the points with company among the next two on either side."""
    factor, relief = limits[0], limits[1]
    for i in range(depth.size):
        spread = sigma[i] if sigma[i] > np.float32(0.0) else np.float32(0.0)  # also where it is NaN
        limit[i] = factor * spread + relief * depth[i]
        keep[i] = False
    for i in range(2, depth.size - 2):
        z, most = depth[i], limit[i]
        near = np.int32(1 if abs(depth[i - 2] - z) <= most else 0)
        near += np.int32(1 if abs(depth[i - 1] - z) <= most else 0)
        near += np.int32(1 if abs(depth[i + 1] - z) <= most else 0)
        near += np.int32(1 if abs(depth[i + 2] - z) <= most else 0)
        keep[i] = near >= company


@row_loop
def _fits(depth: Any, row: Any, i: Any, limit: Any, company: Any, window: Any) -> Any:
    """Tell whether a point has company in its whole neighbourhood, or equals its median."""
    height, width = depth.shape
    z = depth[row, i]
    near, count = -1, 0  # the point itself isn't company
    for y in range(max(row - 2, 0), min(row + 3, height)):
        for x in range(max(i - 2, 0), min(i + 3, width)):
            value = depth[y, x]
            if value == value:
                window[count] = value
                count += 1
                near += 1 if abs(value - z) <= limit else 0
    if near >= company:
        return True
    median = np.median(window[:count])
    return abs(z - median) <= limit


@kernel
def _outlier_rows(
    depth: Any, sigma: Any, limits: Any, company: Any, keep: Any, removed: Any
) -> None:
    height, width = depth.shape
    known = np.int64(1 if sigma.shape[0] == height else 0)
    for row in numba.prange(height):
        limit = np.empty(width, np.float32)
        window = np.empty(25, np.float32)
        _company_in_row(depth[row], sigma[np.int64(row) * known], limits, company, limit, keep[row])
        count = 0
        for i in range(width):
            if not keep[row, i] and not np.isnan(depth[row, i]):
                keep[row, i] = _fits(depth, row, i, limit[i], company, window)
                count += 0 if keep[row, i] else 1
        removed[row] = count


_MISSING = np.int32(-(2**31))
_STRIP = 64
"""Rows that are joined by one thread."""


@row_loop
def _label_row(depth: Any, first: Any, jump: Any, label: Any) -> Any:
    """Label runs: the first pixel of a run holds minus its length, the others the number of the first."""
    start = -1
    before = np.float32(np.nan)
    for i in range(depth.size):
        z = depth[i]
        if z != z:
            label[i] = _MISSING
        elif abs(z - before) <= jump:  # False with NaN
            label[i] = first + start
            label[start] -= 1
        else:
            start = i
            label[i] = -1
        before = z


@kernel
def _label_runs(depth: Any, jump: Any, label: Any) -> None:
    width = depth.shape[1]
    for row in numba.prange(depth.shape[0]):
        first = np.int64(row) * width
        _label_row(depth[row], first, jump, label[first : first + width])


@row_loop
def _root(label: Any, pixel: Any) -> Any:
    while label[pixel] >= 0:
        pixel = label[pixel]
    return pixel


@row_loop
def _join_row(above: Any, here: Any, first_above: Any, first: Any, jump: Any, label: Any) -> Any:
    """Unite the runs of two neighbouring rows where they touch; labels stay minus sizes at the roots."""
    touched = False
    for i in range(here.size):
        touches = abs(here[i] - above[i]) <= jump  # False with NaN
        if not touches:
            touched = False
            continue
        known = (
            touched and abs(here[i] - here[i - 1]) <= jump and abs(above[i] - above[i - 1]) <= jump
        )
        touched = True
        if known:
            continue  # the same two runs as a pixel before
        a, b = _root(label, first_above + i), _root(label, first + i)
        if a == b:
            continue
        if label[a] > label[b]:  # sizes are negative: b is the larger patch
            a, b = b, a
        label[a] += label[b]
        label[b] = a


@kernel
def _join_rows(depth: Any, jump: Any, label: Any, strip: Any) -> None:
    height, width = depth.shape
    strips = (height + strip - 1) // strip
    for number in numba.prange(strips):
        first_row = np.int64(number) * strip
        for row in range(first_row + 1, min(first_row + strip, height)):
            _join_row(depth[row - 1], depth[row], (row - 1) * width, row * width, jump, label)
    for number in range(1, strips):
        row = number * strip
        _join_row(depth[row - 1], depth[row], (row - 1) * width, row * width, jump, label)


@kernel
def _keep_patches(label: Any, least: Any, keep: Any, removed: Any) -> None:
    height, width = keep.shape
    for row in numba.prange(height):
        first = np.int64(row) * width
        run, large, count = np.int64(-1), False, 0
        for i in range(width):
            if not keep[row, i]:
                continue
            pixel = first + i
            start = label[pixel]
            if start < 0 or start != run:  # one root serves a run
                large = -label[_root(label, pixel)] >= least
                run = pixel if start < 0 else np.int64(start)
            keep[row, i] = large
            count += 0 if large else 1
        removed[row] = count
