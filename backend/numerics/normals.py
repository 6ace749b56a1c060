"""Surface normals of an organised cloud, from each point's neighbours on its own surface."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Float32

from backend.numerics.camera_model import Pinhole, ray_lattice
from backend.numerics.errors import CalibrationError
from backend.numerics.kernels import kernel, row_loop
from backend.numerics.lattice import LATTICE_STEP, Lattice, lattice_row

_REACH = 2
"""Neighbours up to two pixels away: 25 points."""
_LEAST_NEIGHBOURS = np.float32(6.0)
_NAN = np.float32(np.nan)
# Rows are cut as rows[k, a:b] from contiguous arrays, see `sinusoid_rows`.
_TILE = 128
"""Pixels whose sums stay in the first-level cache, and among which a gap costs the others the fast way."""


def normals(
    points_mm: Float32[np.ndarray, "h w 3"], camera: Pinhole, *, steepest: float = 6.0
) -> Float32[np.ndarray, "h w 3"]:
    r"""Fit a plane to each point's 5x5 neighbourhood on the pixel grid.

    Parameters
    ----------
    points_mm
        One point per pixel in [mm] in the camera's frame, NaN invalid.
    camera
        Model of the camera whose pixels they are.
    steepest
        Neighbours belong to the same surface up to this tangent of the angle of view (6: 80 deg); beyond,
        the step is a jump and the neighbour isn't used.

    Returns
    -------
    Unit normals in the camera's frame, turned towards the camera, float32. NaN where the point
    is invalid or fewer than six neighbours (itself included) lie on its surface, or all on one line.

    Raises
    ------
    CalibrationError
        If the cloud hasn't the camera's size.

    Notes
    -----
    On a plane :math:`n \cdot X = d` the inverse depth is affine in the ray's slopes,
    :math:`1/Z = (n_x x + n_y y + n_z) / d`: an ordinary linear fit, exact for planes at any tilt, in
    which all neighbours have nearly the same noise. Nothing is smoothed but the normal. Where all 25 neighbours
    lie on the surface, the fit is three separable sums; elsewhere each neighbour is judged and added by itself.
    """
    height, width = points_mm.shape[:2]
    if (height, width) != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the cloud is {width}x{height} px but the camera's calibration is for"
            f" {camera.width_px}x{camera.height_px} px; use the calibration of this size"
        )
    out = np.empty((height, width, 3), np.float32)
    depth = np.ascontiguousarray(points_mm[..., 2])
    nodes = normal_nodes(ray_lattice(camera))
    _normal_rows(depth, nodes, normal_limit(camera, steepest), out)
    return out


def normal_nodes(rays: Lattice) -> Float[np.ndarray, "6 node_rows node_columns"]:
    """Prepare a camera's rays for `normal_row`.

    Returns
    -------
    At the lattice's nodes the slopes x and y, and the four elements, without their signs, of the inverse matrix of
    their derivatives by the pixel: dy/dj, dy/di, dx/di, dx/dj over the determinant, with i along the row.
    """
    by_row = [np.gradient(slopes, LATTICE_STEP, axis=0, edge_order=2) for slopes in rays.nodes]
    by_column = [np.gradient(slopes, LATTICE_STEP, axis=1, edge_order=2) for slopes in rays.nodes]
    xi, yi, xj, yj = *by_column, *by_row
    area = xi * yj - xj * yi
    return np.stack([*rays.nodes, yj / area, yi / area, xi / area, xj / area])


def normal_limit(camera: Pinhole, steepest: float = 6.0) -> float:
    """Return the relative difference of depth, per pixel, up to which neighbours are one surface."""
    return float(steepest / camera.K[0, 0])


@row_loop
def _invert(depth: Any, out: Any) -> Any:
    for i in range(depth.size):
        out[i] = np.float32(1.0) / depth[i]


@row_loop
def _sum_columns(rows: Any, begin: Any, end: Any, middle: Any, sums: Any) -> Any:
    """Sum the five rows above each other, plain and by their distance; note their range."""
    a, b, c = rows[0, begin:end], rows[1, begin:end], rows[2, begin:end]
    d, e = rows[3, begin:end], rows[4, begin:end]
    for n in range(a.size):
        # differences from one value of the surface: sums of the values themselves would lose digits
        p, q, r, s, t = a[n] - middle, b[n] - middle, c[n] - middle, d[n] - middle, e[n] - middle
        sums[0, n] = p + q + r + s + t
        sums[1, n] = np.float32(2.0) * (t - p) + (s - q)
        sums[2, n] = max(max(max(p, q), max(s, t)), r)
        sums[3, n] = min(min(min(p, q), min(s, t)), r)


@row_loop
def _fit_whole(own: Any, sums: Any, middle: Any, limit: Any, gradient: Any) -> Any:
    """Fit pixels all of whose neighbours lie on their surface; return how many these are.

    With all 25 offsets the fit falls apart into sums: each slope's is a weighted sum over 50.
    """
    whole = 0
    plain, tilted, high, low = sums[0], sums[1], sums[2], sums[3]
    for n in range(own.size):
        p, q, r, s, t = plain[n], plain[n + 1], plain[n + 2], plain[n + 3], plain[n + 4]
        total = p + q + r + s + t
        across = np.float32(2.0) * (t - p) + (s - q)
        down = tilted[n] + tilted[n + 1] + tilted[n + 2] + tilted[n + 3] + tilted[n + 4]
        highest = max(max(max(high[n], high[n + 1]), max(high[n + 3], high[n + 4])), high[n + 2])
        lowest = min(min(min(low[n], low[n + 1]), min(low[n + 3], low[n + 4])), low[n + 2])
        here = own[n] - middle
        most = limit * own[n]
        # a missing neighbour may escape the range but makes the sum NaN
        same = (highest - here <= most) & (here - lowest <= most) & (total == total)
        whole += 1 if same else 0
        gradient[0, n] = across * np.float32(1 / 50)
        gradient[1, n] = down * np.float32(1 / 50)
        gradient[2, n] = total * np.float32(1 / 25) - here
    return whole


@row_loop
def _add_neighbour(own: Any, neighbour: Any, limit: Any, di: Any, dj: Any, sums: Any) -> Any:
    """Add one neighbour of every pixel of a tile to the sums of the fit."""
    count, si, sj, sii, sij, sjj = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    sw, siw, sjw = sums[6], sums[7], sums[8]
    for n in range(own.size):
        difference = neighbour[n] - own[n]
        same = abs(difference) <= limit * own[n]  # False with NaN
        one = np.float32(1.0) if same else np.float32(0.0)
        value = difference if same else np.float32(0.0)
        count[n] += one
        si[n] += di * one
        sj[n] += dj * one
        sii[n] += di * di * one
        sij[n] += di * dj * one
        sjj[n] += dj * dj * one
        sw[n] += value
        siw[n] += di * value
        sjw[n] += dj * value


@row_loop
def _gradient(sums: Any, size: Any) -> Any:
    """Solve the fit: rows 0, 1, 2 become the slopes along i and j and the value at the pixel; NaN if too few."""
    for n in range(size):
        count = sums[0, n]
        scale = np.float32(1.0) / count
        mi, mj, mw = sums[1, n] * scale, sums[2, n] * scale, sums[6, n] * scale
        sii = sums[3, n] - sums[1, n] * mi
        sij = sums[4, n] - sums[1, n] * mj
        sjj = sums[5, n] - sums[2, n] * mj
        siw = sums[7, n] - sums[6, n] * mi
        sjw = sums[8, n] - sums[6, n] * mj
        determinant = sii * sjj - sij * sij
        # All in one line: the determinant of integer offsets is 0 up to rounding, otherwise above 1.
        good = (count >= _LEAST_NEIGHBOURS) & (determinant > np.float32(0.5))
        inverse = np.float32(1.0) / determinant if good else _NAN
        wi = (siw * sjj - sjw * sij) * inverse
        wj = (sjw * sii - siw * sij) * inverse
        sums[0, n] = wi
        sums[1, n] = wj
        sums[2, n] = mw - mi * wi - mj * wj


# The gradient over pixels, turned into one over ray slopes, is the normal's x and y; with the value that
# makes z. One loop per component: with three outputs in a loop LLVM can't rule out that they overlap its inputs.


@row_loop
def _combine(a: Any, b: Any, wa: Any, wb: Any, out: Any) -> Any:
    for n in range(out.size):
        out[n] = wa[n] * a[n] - wb[n] * b[n]


@row_loop
def _remaining(own: Any, offset: Any, nx: Any, ny: Any, x: Any, y: Any, out: Any) -> Any:
    for n in range(out.size):
        out[n] = own[n] + offset[n] - nx[n] * np.float32(x[n]) - ny[n] * np.float32(y[n])


@row_loop
def _inverse_length(nx: Any, ny: Any, nz: Any, out: Any) -> Any:
    for n in range(nx.size):
        # towards the camera
        out[n] = np.float32(-1.0) / np.sqrt(nx[n] * nx[n] + ny[n] * ny[n] + nz[n] * nz[n])


@row_loop
def _scale(factor: Any, row: Any) -> Any:
    for n in range(row.size):
        row[n] *= factor[n]


@row_loop
def _direction(
    own: Any, gradient: Any, rays: Any, turn: Any, begin: Any, end: Any, out: Any
) -> Any:
    along, down, offset = gradient[0], gradient[1], gradient[2]
    nx, ny, nz = out[0, begin:end], out[1, begin:end], out[2, begin:end]
    _combine(turn[0, begin:end], turn[1, begin:end], along, down, nx)
    _combine(turn[2, begin:end], turn[3, begin:end], down, along, ny)
    _remaining(own, offset, nx, ny, rays[0, begin:end], rays[1, begin:end], nz)
    _inverse_length(nx, ny, nz, offset)
    _scale(offset, nx)
    _scale(offset, ny)
    _scale(offset, nz)


@row_loop
def normal_row(depth: Any, row: Any, nodes: Any, limit: Any, work: Any, out: Any) -> Any:
    """Write the normals of one row of pixels into `out`, one component per row; NaN where there is none."""
    height, width = depth.shape
    rays, inverse, part = work.rays, work.inverse, work.sums
    for k in range(2):
        lattice_row(nodes[k], row, work.nodes, rays[k])
    for k in range(4):
        lattice_row(nodes[2 + k], row, work.nodes, work.turn[k])
    for k in range(2 * _REACH + 1):
        y = row + k - _REACH
        if 0 <= y < height:
            _invert(depth[y], inverse[k, _REACH : width + _REACH])
        else:
            inverse[k, :] = np.nan
    for begin in range(0, width, _TILE):
        end = min(begin + _TILE, width)
        size = end - begin
        own = inverse[_REACH, begin + _REACH : end + _REACH]
        middle = own[size // 2]
        _sum_columns(inverse, begin, end + 2 * _REACH, middle, work.columns)
        if _fit_whole(own, work.columns, middle, np.float32(limit), part) < size:
            part[:] = 0.0
            for dj in range(2 * _REACH + 1):
                for di in range(2 * _REACH + 1):
                    away = max(abs(di - _REACH), abs(dj - _REACH))
                    _add_neighbour(
                        own,
                        inverse[dj, begin + di : end + di],
                        np.float32(limit * away),
                        np.float32(di - _REACH),
                        np.float32(dj - _REACH),
                        part,
                    )
            _gradient(part, size)
        _direction(own, part, rays, work.turn, begin, end, out)


class NormalWork(NamedTuple):
    """One row's intermediate values; `new_normal_work` makes it."""

    rays: Any  # float64[2, width]: slopes of the pixels' rays
    turn: (
        Any  # float32[4, width]: from a gradient over pixels to one over slopes, see `normal_nodes`
    )
    nodes: Any  # float64[node columns]
    inverse: Any  # float32[5, width + 4]: inverse depths of five rows, NaN around
    sums: Any  # float32[9, tile]
    columns: Any  # float32[4, tile + 4]


@row_loop
def new_normal_work(width: Any, node_columns: Any) -> Any:
    """Allocate one row's intermediate values."""
    return NormalWork(
        np.empty((2, width), np.float64),
        np.empty((4, width), np.float32),
        np.empty(node_columns, np.float64),
        np.full((2 * _REACH + 1, width + 2 * _REACH), np.nan, np.float32),
        np.empty((9, _TILE), np.float32),
        np.empty((4, _TILE + 2 * _REACH), np.float32),
    )


@row_loop
def _interleave(planes: Any, out: Any) -> Any:
    for n in range(out.shape[0]):
        out[n, 0] = planes[0, n]
        out[n, 1] = planes[1, n]
        out[n, 2] = planes[2, n]


@kernel
def _normal_rows(depth: Any, nodes: Any, limit: Any, out: Any) -> None:
    height, width = depth.shape
    for row in numba.prange(height):
        work = new_normal_work(width, nodes.shape[2])
        found = np.empty((3, width), np.float32)
        normal_row(depth, np.int64(row), nodes, limit, work, found)
        _interleave(found, out[row])
