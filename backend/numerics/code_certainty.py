"""Whether a pixel's Gray code can be trusted, and what stands in for it where it can't."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt16

from backend.numerics.camera_model import Pinhole, RigidTransform
from backend.numerics.triangulation import projector_consistency, triangulate_projector


class PairGeometry(NamedTuple):
    """A camera against the projector."""

    camera: Pinhole
    projector: Pinhole
    projector_from_camera: RigidTransform


def second_contrast(
    patterns: Sequence[Shaped[np.ndarray, "h w"]], inverses: Sequence[Shaped[np.ndarray, "h w"]]
) -> UInt16[np.ndarray, "h w"]:
    """Return the second smallest |pattern - inverse| over the bits of each pixel, in [gray].

    Notes
    -----
    On the border between two codes exactly one bit of a Gray code changes: there its contrast is 0 and either
    value is right to half a code. So one weak bit is no reason to doubt; two are. With one bit it is
    that bit's contrast. Cost: a few passes over each pair.

    Examples
    --------
    >>> patterns = [np.uint8([[90]]), np.uint8([[50]]), np.uint8([[80]])]
    >>> inverses = [np.uint8([[10]]), np.uint8([[50]]), np.uint8([[20]])]
    >>> second_contrast(patterns, inverses).item()
    60
    """
    weakest = np.full(patterns[0].shape, 0xFFFF, np.uint16)
    second = weakest.copy()
    for pattern, inverse in zip(patterns, inverses, strict=True):
        contrast = (np.maximum(pattern, inverse) - np.minimum(pattern, inverse)).astype(np.uint16)
        np.minimum(second, np.maximum(weakest, contrast), out=second)
        np.minimum(weakest, contrast, out=weakest)
    return weakest if len(patterns) == 1 else second


def on_epipolar_line(
    projector_px: Float32[np.ndarray, "h w"],
    projector_row_px: Float32[np.ndarray, "h w"],
    geometry: PairGeometry,
    *,
    tolerance_px: float,
) -> Bool[np.ndarray, "h w"]:
    """Tell which pixels' row code lies where the column code and the calibration say, within a tolerance.

    False also where a code is missing. Light that came by a second reflection misses its line, unless the
    reflection happens to run along it.
    """
    points_mm = triangulate_projector(projector_px, *geometry).points_mm
    residual_px = projector_consistency(
        points_mm, projector_row_px, geometry.projector, geometry.projector_from_camera, rows=True
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(residual_px) <= tolerance_px)


def agreeing(
    projector_px: Float32[np.ndarray, "h w"],
    projector_row_px: Float32[np.ndarray, "h w"],
    *,
    tolerance_px: float,
) -> Bool[np.ndarray, "h w"]:
    """Tell which pixels look where most of their 3 x 3 neighbourhood does; a lone wrong code would dim a stranger.

    At least three of the eight neighbours, within the tolerance in both directions.
    """
    count = np.zeros(projector_px.shape, np.uint8)
    u, v = (np.pad(m, 1, constant_values=np.nan) for m in (projector_px, projector_row_px))
    height, width = projector_px.shape
    for dy in range(3):
        for dx in range(3):
            if (dy, dx) == (1, 1):
                continue
            near = (slice(dy, dy + height), slice(dx, dx + width))
            with np.errstate(invalid="ignore"):
                count += (np.abs(u[near] - projector_px) <= tolerance_px) & (
                    np.abs(v[near] - projector_row_px) <= tolerance_px
                )
    return np.asarray(count >= 3)


def fill_runs(
    position_px: Float32[np.ndarray, "h w"],
    fillable: Bool[np.ndarray, "h w"],
    *,
    longest_px: int,
    steepest: float = 4.0,
) -> Float32[np.ndarray, "h w"]:
    """Fill runs of unknown positions along rows with the straight line between the known ends.

    Parameters
    ----------
    position_px
        Projector position per camera pixel; NaN unknown.
    fillable
        Unknown pixels that may be filled, e.g. the saturated ones.
    longest_px
        Runs longer than this stay unknown.
    steepest
        So do runs whose ends differ by more than this many projector pixels per camera pixel: another surface.

    Examples
    --------
    >>> row = np.float32([[2, np.nan, np.nan, 5]])
    >>> fill_runs(row, np.isnan(row), longest_px=3)
    array([[2., 3., 4., 5.]], dtype=float32)
    """
    width = position_px.shape[1]
    known = ~np.isnan(position_px)
    x = np.broadcast_to(np.arange(width), position_px.shape)
    left = np.maximum.accumulate(np.where(known, x, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, x, width)[:, ::-1], axis=1)[:, ::-1]
    use = fillable & ~known & (left >= 0) & (right < width) & (right - left - 1 <= longest_px)
    rows, columns = np.nonzero(use)
    start, end = left[rows, columns], right[rows, columns]
    first, last = position_px[rows, start], position_px[rows, end]
    slope = (last - first) / (end - start).astype(np.float32)
    steady = np.abs(slope) <= steepest
    filled = position_px.copy()
    value = first + slope * (columns - start).astype(np.float32)
    filled[rows[steady], columns[steady]] = value[steady]
    return filled
