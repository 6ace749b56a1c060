"""A second camera beside camera and projector: it averages where both see, and fills in what the first can't read."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from backend.numerics.camera_model import Pinhole, RigidTransform, project, rays
from backend.numerics.kernels import kernel, kernel_input, row_loop
from backend.numerics.triangulation import _bent, _coefficients, _scalars

_STEP = 1e-4
"""Relative step for the derivative along the ray: 0.07 mm at 700 mm."""
_NEWTON_STEPS = 2
_LARGEST_STEP = 0.02
"""Of a Newton step, relative to the distance: 14 mm at 700 mm."""


class SecondOpinion(NamedTuple):
    """How far along its ray a second camera would put each point."""

    shift: Float32[np.ndarray, "h w"]
    """Relative to the distance: the point becomes (1 + shift) times itself. NaN where the camera has no opinion."""
    sigma: Float32[np.ndarray, "h w"]
    """Standard deviation of the shift from this camera alone, relative likewise."""


def second_opinion(
    points_mm: Float32[np.ndarray, "h w 3"],
    coordinate_px: Float32[np.ndarray, "h2 w2"],
    sigma_px: Float32[np.ndarray, "h2 w2"],
    other: Pinhole,
    other_from_camera: RigidTransform,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
    *,
    jump_px: float = 4.0,
) -> SecondOpinion:
    r"""Find the point on each point's ray whose projector column the second camera confirms.

    Parameters
    ----------
    points_mm
        Points of the first camera, in its frame, in [mm], NaN invalid; the second is asked near them.
    coordinate_px, sigma_px
        The second camera's map of projector columns and its standard deviation, NaN invalid.
    other, other_from_camera
        The second camera.
    projector, projector_from_camera
        The projector.
    jump_px
        Nothing is interpolated between neighbours whose columns differ by more.

    Notes
    -----
    Along the ray, :math:`f(s) = u_2(x_2(s P)) - U(s P)` is zero where the column that the second camera reads at the
    point's image is the one that the projector lights the point with; two Newton steps with a numerical derivative.
    With the projector between the cameras an error common to both readings (a step of the mask, say) moves
    the two opinions to opposite sides, and their mean not at all.
    """
    out = SecondOpinion(*(np.empty(points_mm.shape[:2], np.float32) for _ in range(2)))
    _opinion_rows(
        kernel_input(points_mm),
        kernel_input(coordinate_px),
        kernel_input(sigma_px),
        _view(other, other_from_camera),
        _view(projector, projector_from_camera),
        float(jump_px),
        *out,
    )
    return out


class _View(NamedTuple):
    """A device as the kernel takes it."""

    R: Any
    t_mm: Any
    columns: Any
    rows: Any


def _view(device: Pinhole, pose: RigidTransform) -> _View:
    return _View(
        pose.R.astype(np.float64),
        pose.t_mm.astype(np.float64),
        _coefficients(device, rows=False),
        _coefficients(device, rows=True),
    )


@row_loop
def _project(X: Any, Y: Any, Z: Any, view: Any) -> Any:
    """Return the picture position of a point; NaN behind the device."""
    R, t = view.R, view.t_mm
    distance = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
    scale = 1.0 / distance if distance > 0.0 else np.nan
    px = (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) * scale
    py = (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) * scale
    u, _, _ = _bent(px, py, _scalars(view.columns))
    v, _, _ = _bent(px, py, _scalars(view.rows))
    return u, v


@row_loop
def _sample(values: Any, x: Any, y: Any, jump: Any) -> Any:
    """Interpolate between four neighbours; NaN outside, if one is missing or they differ by more than a jump."""
    height, width = values.shape
    if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
        return np.nan
    i, j = min(int(x), width - 2), min(int(y), height - 2)
    a, b, c, d = values[j, i], values[j, i + 1], values[j + 1, i], values[j + 1, i + 1]
    # Not `min`: what it makes of NaN depends on the order.
    if not (abs(a - b) <= jump and abs(c - d) <= jump and abs(a - c) <= jump):
        return np.nan
    s, t = x - i, y - j
    return (a * (1.0 - s) + b * s) * (1.0 - t) + (c * (1.0 - s) + d * s) * t


@row_loop
def _averaging(place: Any) -> Any:
    """Return by which factor interpolation between two neighbours lowers their noise."""
    t = place - np.floor(place)
    return np.sqrt((1.0 - t) * (1.0 - t) + t * t)


@row_loop
def _disagreement(
    X: Any, Y: Any, Z: Any, coordinate: Any, other: Any, projector: Any, jump: Any
) -> Any:
    x, y = _project(X, Y, Z, other)
    u, _ = _project(X, Y, Z, projector)
    return _sample(coordinate, x, y, jump) - u


@row_loop
def _ask(
    X: Any, Y: Any, Z: Any, coordinate: Any, sigma: Any, other: Any, projector: Any, jump: Any
) -> Any:
    """Return shift and standard deviation of one point."""
    scale, slope = 1.0, np.nan
    for _ in range(_NEWTON_STEPS):
        ahead = scale * (1.0 + _STEP)
        here = _disagreement(X * scale, Y * scale, Z * scale, coordinate, other, projector, jump)
        there = _disagreement(X * ahead, Y * ahead, Z * ahead, coordinate, other, projector, jump)
        slope = (there - here) / (ahead - scale)
        step = here / slope
        if not abs(step) <= _LARGEST_STEP:
            return np.nan, np.nan
        scale -= step
    x, y = _project(X * scale, Y * scale, Z * scale, other)
    noise = _sample(sigma, x, y, np.inf) * _averaging(x) * _averaging(y) / abs(slope)
    return (scale - 1.0, noise) if noise == noise else (np.nan, np.nan)


@kernel
def _opinion_rows(
    points: Any,
    coordinate: Any,
    sigma: Any,
    other: Any,
    projector: Any,
    jump: Any,
    shift_out: Any,
    sigma_out: Any,
) -> None:
    for row in numba.prange(points.shape[0]):
        for i in range(points.shape[1]):
            X, Y = np.float64(points[row, i, 0]), np.float64(points[row, i, 1])
            Z = np.float64(points[row, i, 2])
            shift, noise = np.nan, np.nan
            if Z == Z:
                shift, noise = _ask(X, Y, Z, coordinate, sigma, other, projector, jump)
            shift_out[row, i] = shift
            sigma_out[row, i] = noise


class Splat(NamedTuple):
    """Points of another camera on the first camera's pixels."""

    pixel: Int64[np.ndarray, "m"]
    """Number of the pixel, row by row; each at most once."""
    points_mm: Float64[np.ndarray, "m 3"]
    """In the first camera's frame, on the pixel's ray."""
    source: Int64[np.ndarray, "m"]
    """Which of the points given."""


def on_pixels(
    points_mm: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    camera: Pinhole,
    wanted: Bool[np.ndarray, "h w"],
) -> Splat:
    """Put points where a camera's pixels look: the nearest one of each wanted pixel, moved on its tangent plane.

    Parameters
    ----------
    points_mm, normals
        Points and unit normals in the camera's frame; a normal that isn't finite stands for one towards the camera.
    camera
        Its model.
    wanted
        Pixels that may take a point.

    Notes
    -----
    A point is moved by half a pixel at most; of several within one pixel the one nearest to the camera counts.
    """
    place = project(points_mm, camera)
    column, row = (np.floor(np.nan_to_num(p, nan=-1.0) + 0.5).astype(np.int64) for p in place.T)
    height, width = wanted.shape
    chosen = np.flatnonzero((column >= 0) & (row >= 0) & (column < width) & (row < height))
    chosen = chosen[wanted[row[chosen], column[chosen]]]
    pixel = row[chosen] * width + column[chosen]
    order = np.lexsort((points_mm[chosen, 2], pixel))
    pixel, first = np.unique(pixel[order], return_index=True)
    source = chosen[order][first]
    moved = _onto_rays(points_mm[source], normals[source], camera, pixel, width)
    return Splat(pixel, moved, source)


def _onto_rays(
    points_mm: Float64[np.ndarray, "m 3"],
    normals: Float64[np.ndarray, "m 3"],
    camera: Pinhole,
    pixel: Int64[np.ndarray, "m"],
    width_px: int,
) -> Float64[np.ndarray, "m 3"]:
    slopes = rays(np.column_stack([pixel % width_px, pixel // width_px]).astype(np.float64), camera)
    directions = np.column_stack([slopes, np.ones(len(slopes))])
    facing = np.isfinite(normals).all(axis=1, keepdims=True)
    n = np.where(facing, normals, points_mm / np.linalg.norm(points_mm, axis=1, keepdims=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (n * points_mm).sum(axis=1) / (n * directions).sum(axis=1)
        is_near = np.abs(depth / points_mm[:, 2] - 1) < _LARGEST_STEP
    # On a surface seen edge-on the tangent plane leads anywhere: there the depth is kept.
    depth = np.where(is_near, depth, points_mm[:, 2])
    return np.asarray(directions * depth[:, None])


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    device = Pinhole(np.array([[80.0, 0, 3.5], [0, 80.0, 3.5], [0, 0, 1]]), np.zeros(5), 8, 8)
    aside = RigidTransform(np.eye(3), np.array([-20.0, 0.0, 0.0]))
    points, flat = np.full((1, 1, 3), 100.0, np.float32), np.zeros((8, 8), np.float32)
    second_opinion(points, flat, flat, device, aside, device, aside)
