"""From an organised cloud to a list of points with normals, in one pass."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, UInt8

from backend.numerics.kernels import kernel, kernel_input, row_loop
from backend.numerics.lattice import Lattice
from backend.numerics.normals import new_normal_work, normal_nodes, normal_row
from backend.numerics.triangulation import Cloud


class PointList(NamedTuple):
    """The points that there are, row by row of the picture."""

    points_mm: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    """Unit length, towards the camera; 0 where the neighbourhood is too small, see `normals.normals`."""
    sigma_mm: Float32[np.ndarray, "n"]
    pixel_x: Float32[np.ndarray, "n"]
    pixel_y: Float32[np.ndarray, "n"]
    exposure_index: UInt8[np.ndarray, "n"]
    brightness: Float32[np.ndarray, "n"]


def gather(
    cloud: Cloud,
    exposure_index: UInt8[np.ndarray, "h w"],
    brightness: Float32[np.ndarray, "h w"] | None = None,
    *,
    normal_limit: float,
) -> PointList:
    """Collect the valid points of an organised cloud with what belongs to them; uses up the cloud's noise.

    Parameters
    ----------
    cloud
        One depth per pixel in [mm], NaN where there is none, its noise and the pixels' rays. The list of noise
        takes the place of the map.
    exposure_index, brightness
        Maps of the same size; brightness may be missing.
    normal_limit
        Relative difference of depth, per pixel, up to which neighbours are one surface, see
        `normals.normal_limit`.

    Returns
    -------
    Arrays of the points' number, in the maps' types; brightness is empty if it was missing.

    Notes
    -----
    Every map is read once and every list written once; neither the organised coordinates nor the organised
    normals, three maps each, ever exist.
    """
    depth = kernel_input(cloud.depth_mm)
    counts = np.empty(depth.shape[0], np.int64)
    _count(depth, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    n = int(starts[-1])
    out = PointList(
        np.empty((n, 3), np.float32),
        np.empty((n, 3), np.float32),
        cloud.sigma_mm.reshape(-1)[:n],
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.uint8),
        np.empty(n if brightness is not None else 0, np.float32),
    )
    light = np.zeros((1, 1), np.float32) if brightness is None else brightness
    maps = Maps(
        depth, cloud.sigma_mm.reshape(-1), kernel_input(exposure_index), kernel_input(light)
    )
    nodes = normal_nodes(cloud.rays)
    _fill(maps, brightness is not None, nodes, float(normal_limit), starts, out)
    return out


class Maps(NamedTuple):
    """What is gathered."""

    depth: Any  # float32[h, w]
    sigma: Any  # float32[h w]: becomes the list
    exposure: Any  # uint8[h, w]
    light: Any  # float32[h, w], or [1, 1] without


@kernel
def _count(depth: Any, counts: Any) -> None:
    for row in numba.prange(counts.size):
        number = 0
        for i in range(depth.shape[1]):
            number += 0 if np.isnan(depth[row, i]) else 1
        counts[row] = number


@row_loop
def _move_up(depth: Any, values: Any) -> Any:
    """Move the values of the points that there are to the beginning, in place."""
    n = 0
    for i in range(depth.size):
        values[n] = values[i]
        n += 1 if depth[i] == depth[i] else 0  # NaN doesn't equal itself


@row_loop
def _run_end(depth: Any, begin: Any) -> Any:
    """Return where the points that follow each other from `begin` on end."""
    end = begin
    while end < depth.size and depth[end] == depth[end]:  # NaN doesn't equal itself
        end += 1
    return end


@row_loop
def _copy(row: Any, out: Any) -> Any:
    for i in range(out.size):
        out[i] = row[i]


@row_loop
def _fill_points(z: Any, x: Any, y: Any, out: Any) -> Any:
    for i in range(z.size):
        out[i, 0] = z[i] * x[i]
        out[i, 1] = z[i] * y[i]
        out[i, 2] = z[i]


@row_loop
def _fill_normals(x: Any, y: Any, z: Any, out: Any) -> Any:
    for i in range(z.size):
        known = z[i] == z[i]
        out[i, 0] = x[i] if known else np.float32(0.0)
        out[i, 1] = y[i] if known else np.float32(0.0)
        out[i, 2] = z[i] if known else np.float32(0.0)


@row_loop
def _fill_place(first: Any, row: Any, x: Any, y: Any) -> Any:
    for i in range(x.size):
        x[i] = np.float32(first + i)
        y[i] = np.float32(row)


@row_loop
def _fill_run(
    maps: Any, with_light: Any, rays: Any, normals: Any, row: Any, i: Any, j: Any, n: Any, out: Any
) -> Any:
    """Write the points of pixels i to j of a row, which have no gap, from place n on."""
    depth, m = maps.depth[row, i:j], n + j - i
    _fill_points(depth, rays[0, i:j], rays[1, i:j], out.points_mm[n:m])
    _fill_normals(normals[0, i:j], normals[1, i:j], normals[2, i:j], out.normals[n:m])
    _fill_place(i, row, out.pixel_x[n:m], out.pixel_y[n:m])
    _copy(maps.exposure[row, i:j], out.exposure_index[n:m])
    if with_light:
        _copy(maps.light[row, i:j], out.brightness[n:m])


@kernel
def _fill(maps: Any, with_light: Any, nodes: Any, limit: Any, starts: Any, out: Any) -> None:
    height, width = maps.depth.shape
    for row in numba.prange(height):
        n = starts[row]
        if starts[row + 1] > n:
            work = new_normal_work(width, nodes.shape[2])
            found = np.empty((3, width), np.float32)
            normal_row(maps.depth, np.int64(row), nodes, limit, work, found)
            begin = np.int64(0)
            while begin < width:
                end = _run_end(maps.depth[row], begin)
                if end > begin:
                    _fill_run(maps, with_light, work.rays, found, np.int64(row), begin, end, n, out)
                    n += end - begin
                begin = end + 1
    _move_up(maps.depth.reshape(-1), maps.sigma)


def warm_up_kernels() -> None:
    """Compile (or load) the kernels on a cloud of one point."""
    depth = np.full((8, 8), np.nan, np.float32)
    depth[3, 3] = 1.0
    cloud = Cloud(
        depth, depth, Lattice(np.stack(np.meshgrid([0.0, 1, 2, 3], [0.0, 1, 2, 3])), 8, 8)
    )
    exposure = np.zeros((8, 8), np.uint8)
    gather(cloud, exposure, normal_limit=0.01)
    gather(cloud, exposure, depth.copy(), normal_limit=0.01)
