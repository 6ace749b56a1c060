"""Surface normals of an organised cloud, from each point's neighbours on its own surface."""

from typing import Any

import numba
import numpy as np
from jaxtyping import Float32

from backend.numerics.camera_model import Pinhole, ray_lattice
from backend.numerics.errors import CalibrationError
from backend.numerics.kernels import kernel, row_loop
from backend.numerics.lattice import lattice_row

_REACH = 2
"""Neighbours up to two pixels away: 25 points."""
_LEAST_NEIGHBOURS = np.float32(6.0)
_NAN = np.float32(np.nan)
_TILE = 512
"""Pixels whose sums stay in the first-level cache."""


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
    which all neighbours have nearly the same noise. Nothing is smoothed but the normal.
    """
    height, width = points_mm.shape[:2]
    if (height, width) != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the cloud is {width}x{height} px but the camera's calibration is for"
            f" {camera.width_px}x{camera.height_px} px; use the calibration of this size"
        )
    out = np.empty((height, width, 3), np.float32)
    inverse_depth = np.empty((height, width), np.float32)
    _invert(np.ascontiguousarray(points_mm), inverse_depth)
    _normal_rows(inverse_depth, ray_lattice(camera).nodes, steepest / camera.K[0, 0], out)
    return out


@kernel
def _invert(points: Any, out: Any) -> None:
    for row in numba.prange(out.shape[0]):
        for i in range(out.shape[1]):
            out[row, i] = np.float32(1.0) / points[row, i, 2]


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
def _gradient(sums: Any) -> Any:
    """Solve the fit: rows 0, 1, 2 become the slopes along i and j and the value at the pixel; NaN if too few."""
    for n in range(sums.shape[1]):
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


@row_loop
def _direction(own: Any, gradient: Any, rays: Any, shift: Any, below: Any, out: Any) -> Any:
    """Turn the gradient over pixels into one over ray slopes: with the value, that is the normal."""
    for n in range(own.size):
        wi, wj = gradient[0, n], gradient[1, n]
        x, y = rays[0, n], rays[1, n]
        xi, yi = shift[0, n] - x, shift[1, n] - y
        xj, yj = below[0, n] - x, below[1, n] - y
        area = 1.0 / (xi * yj - xj * yi)
        nx = (wi * yj - wj * yi) * area
        ny = (wj * xi - wi * xj) * area
        nz = own[n] + gradient[2, n] - nx * x - ny * y
        length = -1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)  # towards the camera
        out[0, n] = nx * length
        out[1, n] = ny * length
        out[2, n] = nz * length


@row_loop
def _interleave(planes: Any, out: Any) -> Any:
    for n in range(out.shape[0]):
        out[n, 0] = planes[0, n]
        out[n, 1] = planes[1, n]
        out[n, 2] = planes[2, n]


@kernel
def _normal_rows(inverse_depth: Any, nodes: Any, limit: Any, out: Any) -> None:
    height, width = inverse_depth.shape
    for row in numba.prange(height):
        # one pixel beyond the right edge, one row below: differences of the ray slopes
        rays = np.empty((4, width + 1), np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, rays[0])
        lattice_row(nodes[1], row, work, rays[1])
        lattice_row(nodes[0], row + 1, work, rays[2])
        lattice_row(nodes[1], row + 1, work, rays[3])
        padded = np.full((2 * _REACH + 1, width + 2 * _REACH), np.nan, np.float32)
        for k in range(max(_REACH - row, 0), min(2 * _REACH + 1, height + _REACH - row)):
            padded[k, _REACH : width + _REACH] = inverse_depth[row + k - _REACH]
        sums = np.empty((9, _TILE), np.float32)
        for begin in range(0, width, _TILE):
            end = min(begin + _TILE, width)
            part = sums[:, : end - begin]
            part[:] = 0.0
            for dj in range(2 * _REACH + 1):
                for di in range(2 * _REACH + 1):
                    away = max(abs(di - _REACH), abs(dj - _REACH))
                    _add_neighbour(
                        inverse_depth[row, begin:end],
                        padded[dj, begin + di : end + di],
                        np.float32(limit * away),
                        np.float32(di - _REACH),
                        np.float32(dj - _REACH),
                        part,
                    )
            _gradient(part)
            _direction(
                inverse_depth[row, begin:end],
                part,
                rays[:2, begin:end],
                rays[:2, begin + 1 : end + 1],
                rays[2:, begin:end],
                part[3:6],
            )
            _interleave(part[3:6], out[row, begin:end])
