"""From an organised cloud to a list of points, in one pass."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, UInt8

from backend.numerics.kernels import kernel, kernel_input


class PointList(NamedTuple):
    """The points that there are, row by row of the picture."""

    points_mm: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    """0 where the organised normal is NaN."""
    sigma_mm: Float32[np.ndarray, "n"]
    pixel_x: Float32[np.ndarray, "n"]
    pixel_y: Float32[np.ndarray, "n"]
    exposure_index: UInt8[np.ndarray, "n"]
    brightness: Float32[np.ndarray, "n"]


def gather(
    points_mm: Float32[np.ndarray, "h w 3"],
    normals: Float32[np.ndarray, "h w 3"],
    sigma_mm: Float32[np.ndarray, "h w"],
    exposure_index: UInt8[np.ndarray, "h w"],
    brightness: Float32[np.ndarray, "h w"] | None = None,
) -> PointList:
    """Collect the valid points of an organised cloud with what belongs to them.

    Parameters
    ----------
    points_mm
        One point per pixel in [mm], NaN where there is none.
    normals, sigma_mm, exposure_index, brightness
        Maps of the same size; brightness may be missing.

    Returns
    -------
    Arrays of the points' number, in the maps' types; brightness is empty if it was missing.

    Notes
    -----
    Every map is read once and every list written once: boolean indexing would do so twice per map, on one core.
    """
    height = points_mm.shape[0]
    counts = np.empty(height, np.int64)
    _count(kernel_input(points_mm), counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    n = int(starts[-1])
    out = PointList(
        np.empty((n, 3), np.float32),
        np.empty((n, 3), np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.uint8),
        np.empty(n if brightness is not None else 0, np.float32),
    )
    light = np.zeros((1, 1), np.float32) if brightness is None else brightness
    maps = [kernel_input(m) for m in (points_mm, normals, sigma_mm, exposure_index, light)]
    _fill(*maps, brightness is not None, starts, *out)  # type: ignore[call-arg]  # two starred lists can't be counted
    return out


@kernel
def _count(points: Any, counts: Any) -> None:
    for row in numba.prange(counts.size):
        number = 0
        for i in range(points.shape[1]):
            if not np.isnan(points[row, i, 2]):
                number += 1
        counts[row] = number


@kernel
def _fill(
    points: Any,
    normals: Any,
    sigma: Any,
    exposure: Any,
    light: Any,
    with_light: Any,
    starts: Any,
    out_points: Any,
    out_normals: Any,
    out_sigma: Any,
    out_x: Any,
    out_y: Any,
    out_exposure: Any,
    out_light: Any,
) -> None:
    for row in numba.prange(points.shape[0]):
        n = starts[row]
        for i in range(points.shape[1]):
            if np.isnan(points[row, i, 2]):
                continue
            for k in range(3):
                out_points[n, k] = points[row, i, k]
                normal = normals[row, i, k]
                out_normals[n, k] = np.float32(0.0) if np.isnan(normal) else normal
            out_sigma[n] = sigma[row, i]
            out_x[n] = i
            out_y[n] = row
            out_exposure[n] = exposure[row, i]
            if with_light:
                out_light[n] = light[row, i]
            n += 1


def warm_up_kernels() -> None:
    """Compile (or load) the kernels on a cloud of one point."""
    points = np.full((2, 2, 3), np.nan, np.float32)
    points[0, 0] = 1.0
    exposure = np.zeros((2, 2), np.uint8)
    gather(points, points, points[..., 0].copy(), exposure, None)
    gather(points, points, points[..., 0].copy(), exposure, points[..., 1].copy())
