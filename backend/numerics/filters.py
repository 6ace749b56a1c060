"""Which points of an organised cloud to leave out; nothing here moves a point or fills a hole."""

from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float, Float32

from backend.numerics.errors import NumericsError
from backend.numerics.kernels import kernel


class Kept(NamedTuple):
    """Points that a filter keeps."""

    keep: Bool[np.ndarray, "h w"]
    """False where the point is missing already or left out."""
    removed: int
    """Number of points that were there and are left out."""


def valid_points(points_mm: Float32[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Return where there is a point; a point has three finite coordinates or none."""
    return np.asarray(np.isfinite(points_mm[..., 2]))


def remove(points_mm: Float32[np.ndarray, "h w 3"], kept: Kept) -> Bool[np.ndarray, "h w"]:
    """Set the points that a filter doesn't keep to NaN, in place; return where they were.

    They are few: writing to their places only costs a tenth of masking the whole cloud.
    """
    gone = np.asarray(valid_points(points_mm) & ~kept.keep)
    points_mm[np.nonzero(gone)] = np.nan
    return gone


def _kept(valid: Bool[np.ndarray, "h w"], good: Bool[np.ndarray, "h w"]) -> Kept:
    keep = valid & good
    return Kept(keep, int(np.count_nonzero(valid)) - int(np.count_nonzero(keep)))


def within_limits(
    points_mm: Float32[np.ndarray, "h w 3"],
    values: Float32[np.ndarray, "h w"],
    *,
    lowest: float = -np.inf,
    highest: float = np.inf,
) -> Kept:
    """Keep points whose value (residual, modulation, sigma, consistency) lies in a range, ends included.

    A NaN value is within every range: what isn't known removes nothing.
    """
    outside = (values < lowest) | (values > highest)
    return _kept(valid_points(points_mm), ~outside)


def within_box(
    points_mm: Float32[np.ndarray, "h w 3"],
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
    good = np.ones(points_mm.shape[:2], bool)
    for axis in range(3):
        if np.isfinite(low[axis]) or np.isfinite(high[axis]):
            values = points_mm[..., axis]
            good &= (values >= low[axis]) & (values <= high[axis])
    return _kept(valid_points(points_mm), good)


def without_outliers(
    points_mm: Float32[np.ndarray, "h w 3"],
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
    points_mm
        Organised cloud in [mm], NaN invalid.
    sigma_mm
        Standard deviation of each point in [mm]. None: the robust spread of all points about their
        medians stands for it.
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
    A tilted plane equals its median exactly. One `cv2.medianBlur` of the depth; missing
    neighbours count alternately as infinitely near and far (as a chessboard), which leaves the median of the others
    nearly where it is.
    """
    depth = points_mm[..., 2]
    valid = np.isfinite(depth)
    median = cv2.medianBlur(_balanced(depth, valid), 5)
    difference = np.abs(depth - median)
    known = valid & np.isfinite(median)
    if sigma_mm is None:
        near = difference[known]
        spread: float | Float32[np.ndarray, "h w"] = (
            1.4826 * float(np.median(near[:: max(near.size // 100_000, 1)])) if near.size else 0.0
        )
    else:
        spread = np.where(np.isfinite(sigma_mm), sigma_mm, np.float32(0.0))
    limit = np.float32(factor) * spread + np.float32(steepest * pixel_angle_rad) * median
    suspects = np.argwhere(known & (difference > limit))
    limits = np.broadcast_to(limit, depth.shape)[suspects[:, 0], suspects[:, 1]]
    lonely = np.zeros(depth.shape, bool)
    alone = np.empty(len(suspects), bool)
    _count_company(np.ascontiguousarray(depth), suspects, limits, company, alone)
    lonely[suspects[alone, 0], suspects[alone, 1]] = True
    return _kept(valid, ~lonely)


@kernel
def _count_company(depth: Any, suspects: Any, limits: Any, company: Any, alone: Any) -> None:
    height, width = depth.shape
    for n in numba.prange(alone.size):
        y, x = suspects[n, 0], suspects[n, 1]
        near = -1  # the point itself
        for j in range(max(y - 2, 0), min(y + 3, height)):
            for i in range(max(x - 2, 0), min(x + 3, width)):
                if abs(depth[j, i] - depth[y, x]) <= limits[n]:
                    near += 1
        alone[n] = near < company


def _balanced(
    depth: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Replace missing depths by minus and plus infinity in turn."""
    filled = np.where(valid, depth, np.float32(np.inf))
    for first in (0, 1):
        part = filled[first::2, first::2]
        part[np.isposinf(part)] = -np.inf
    return filled


def without_specks(
    points_mm: Float32[np.ndarray, "h w 3"],
    *,
    least_pixels: int,
    pixel_angle_rad: float,
    steepest: float = 6.0,
) -> Kept:
    """Remove connected patches of fewer pixels than `least_pixels`.

    Parameters
    ----------
    points_mm
        Organised cloud in [mm], NaN invalid.
    least_pixels
        Size of the smallest patch to keep. 0 and 1 keep all.
    pixel_angle_rad
        Angle between neighbouring pixels, 1 / focal length in px.
    steepest
        Neighbours are connected up to this tangent of the tilt at the cloud's median depth.

    Returns
    -------
    Kept points and the number removed.

    Notes
    -----
    One `cv2.filterSpeckles` on the depth in 16-bit steps, 4-connected. The whole depth range is mapped
    to 32000 steps: with a jump smaller than one step, neighbours connect up to one step.
    """
    depth = points_mm[..., 2]
    valid = np.isfinite(depth)
    if least_pixels <= 1 or not valid.any():
        return _kept(valid, valid)
    low, high = float(np.nanmin(depth)), float(np.nanmax(depth))
    middle = float(np.median(depth[valid][::97]))
    step_mm = max((high - low) / 32000, 1e-6)
    jump = max(steepest * pixel_angle_rad * middle / step_mm, 1.0)
    scaled = np.where(valid, (depth - low) * np.float32(1 / step_mm), np.float32(-2.0))
    steps = np.ascontiguousarray(scaled.astype(np.int16))
    steps, _ = cv2.filterSpeckles(steps, -2, least_pixels - 1, min(jump, 32000.0))  # type: ignore[assignment]  # stub: image only
    return _kept(valid, np.asarray(steps) != -2)


def pixel_angle(K: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle between neighbouring pixels of a camera in [rad]."""
    return float(2.0 / (K[0, 0] + K[1, 1]))
