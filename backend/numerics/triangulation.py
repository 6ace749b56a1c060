"""Points from two cameras, or from a camera and the projector's planes, each with its uncertainty."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    ray_lattice,
)
from backend.numerics.errors import CalibrationError
from backend.numerics.kernels import kernel, row_loop
from backend.numerics.lattice import lattice_row
from backend.numerics.matching import Matches
from backend.numerics.rectification import Rectification


class Cloud(NamedTuple):
    """One point per pixel of the reference camera, in that camera's frame; NaN where there is none."""

    points_mm: Float32[np.ndarray, "h w 3"]
    sigma_mm: Float32[np.ndarray, "h w"]
    """Standard deviation of the point along its pixel's ray; NaN if the coordinate's noise isn't known."""


_NAN = np.float32(np.nan)
_NEWTON_STEPS = 4


def triangulate_pair(matches: Matches, rectification: Rectification) -> Cloud:
    r"""Triangulate partners of two cameras.

    Parameters
    ----------
    matches
        Partners from `match`.
    rectification
        Geometry of the pair.

    Returns
    -------
    Points in [mm] in the reference camera's frame, exactly on their pixels' rays, and their standard
    deviation along the ray in [mm], float32. Points behind the camera are NaN.

    Notes
    -----
    .. math:: Z = \frac{f b}{x_{ref} - x_{other}}, \quad \sigma_Z = \frac{Z^2}{f |b|} \sigma_d

    in the rectified frame, turned back into the camera's. Coefficients are float64, results float32.
    """
    height, width = matches.x_other_px.shape
    cloud = Cloud(np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32))
    _pair_rows(
        matches.x_other_px,
        matches.sigma_disparity_px,
        rectification.rectified_of_reference.nodes,
        np.ascontiguousarray(rectification.rectified_from_reference.T),
        rectification.focal_px,
        rectification.baseline_mm,
        *cloud,
    )
    return cloud


def triangulate_projector(
    projector_px: Float32[np.ndarray, "h w"],
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
    *,
    sigma_projector_px: Float32[np.ndarray, "h w"] | None = None,
    rows: bool = False,
) -> Cloud:
    r"""Intersect each pixel's ray with the plane of its projector column (or row).

    Parameters
    ----------
    projector_px
        Projector coordinate of each pixel in [px], float32, NaN invalid.
    camera, projector
        Models of both, lens distortion included.
    projector_from_camera
        Pose of the projector.
    sigma_projector_px
        Standard deviation of the coordinate in [px]. None means not known: sigma is NaN.
    rows
        True if the coordinate counts the projector's rows.

    Returns
    -------
    Points in [mm] in the camera's frame and their standard deviation along the ray in [mm],
    float32. NaN where the ray runs along the plane or meets it behind the camera or projector.

    Raises
    ------
    CalibrationError
        If a model or the pose can't be used or the map hasn't the camera's size.

    Notes
    -----
    With the ray r, X = R r, and the undistorted projector a plane's depth is

    .. math:: \lambda = \frac{(u - c) t_z - f t_x}{f X_x - (u - c) X_z}

    With projector distortion the plane is a curved surface; the depth is corrected by up to four
    Newton steps on the distorted projection, which converges to 1e-6 px.
    sigma is :math:`\sigma_u |\partial \lambda / \partial u| |r|`.
    """
    _check_projector_input(projector_px, camera, projector, projector_from_camera)
    lattice = ray_lattice(camera)
    cloud = Cloud(
        np.empty((*projector_px.shape, 3), np.float32), np.empty(projector_px.shape, np.float32)
    )
    unknown = np.full((1, 1), np.nan, np.float32)
    _plane_rows(
        projector_px,
        unknown if sigma_projector_px is None else sigma_projector_px,
        lattice.nodes,
        projector_from_camera.R.astype(np.float64),
        projector_from_camera.t_mm.astype(np.float64),
        _coefficients(projector),
        1 if rows else 0,
        bool(np.any(projector.distortion)),
        *cloud,
    )
    return cloud


def projector_consistency(
    points_mm: Float32[np.ndarray, "h w 3"],
    projector_px: Float32[np.ndarray, "h w"],
    projector: Pinhole,
    projector_from_points: RigidTransform,
    *,
    rows: bool = False,
) -> Float32[np.ndarray, "h w"]:
    """Return how far each point's place in the projector is from the coordinate that was measured.

    Parameters
    ----------
    points_mm
        Points in [mm], NaN invalid.
    projector_px
        Measured projector coordinate of the same pixels in [px].
    projector
        Its model.
    projector_from_points
        Pose of the projector with respect to the points' frame.
    rows
        True if the coordinate counts the projector's rows. With a row code beside a column code this is the
        epipolar residual of camera and projector.

    Returns
    -------
    Projected minus measured coordinate in [px], float32; NaN where either is missing. A
    point from two cameras that both see a second reflection agrees with itself but not with the
    projector.

    Raises
    ------
    CalibrationError
        If the model or the pose can't be used.
    """
    check_pinhole(projector, "the projector")
    check_transform(projector_from_points, "the projector")
    out = np.empty(projector_px.shape, np.float32)
    _residual_rows(
        np.ascontiguousarray(points_mm),
        projector_px,
        projector_from_points.R.astype(np.float64),
        projector_from_points.t_mm.astype(np.float64),
        _coefficients(projector),
        1 if rows else 0,
        out,
    )
    return out


def _check_projector_input(
    projector_px: Float32[np.ndarray, "h w"],
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
) -> None:
    check_pinhole(projector, "the projector")
    check_transform(projector_from_camera, "the projector")
    if projector_px.shape != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the map is {projector_px.shape[1]}x{projector_px.shape[0]} px but the camera's calibration"
            f" is for {camera.width_px}x{camera.height_px} px; use the calibration of this size"
        )


def _coefficients(device: Pinhole) -> np.ndarray:
    """Return fx fy cx cy skew, then OpenCV's first twelve distortion coefficients."""
    distortion = np.zeros(14)
    distortion[: device.distortion.size] = device.distortion
    if distortion[12:].any():
        raise CalibrationError(
            f"the projector's model has a tilted sensor {distortion[12:].tolist()}, which isn't supported;"
            " calibrate it with at most twelve coefficients"
        )
    K = device.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], *distortion[:12]])


# ---------------------------------------------------------------- kernels


@row_loop
def _pair_row(
    x: Any,
    y: Any,
    x_other: Any,
    sigma_d: Any,
    turn: Any,
    focal: Any,
    baseline: Any,
    points: Any,
    sigma: Any,
) -> Any:
    scale = 1.0 / focal
    span = focal * baseline
    for i in range(x.size):
        depth = span / (x[i] - x_other[i])
        depth = depth if depth > 0.0 else np.nan
        a, b = x[i] * scale, y[i] * scale
        points[i, 0] = depth * (turn[0, 0] * a + turn[0, 1] * b + turn[0, 2])
        points[i, 1] = depth * (turn[1, 0] * a + turn[1, 1] * b + turn[1, 2])
        points[i, 2] = depth * (turn[2, 0] * a + turn[2, 1] * b + turn[2, 2])
        sigma[i] = depth * depth / abs(span) * sigma_d[i] * np.sqrt(a * a + b * b + 1.0)


@kernel
def _pair_rows(
    x_other: Any,
    sigma_d: Any,
    nodes: Any,
    turn: Any,
    focal: Any,
    baseline: Any,
    points: Any,
    sigma: Any,
) -> None:
    height, width = x_other.shape
    for row in numba.prange(height):
        x = np.empty(width, np.float64)
        y = np.empty(width, np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, y)
        _pair_row(x, y, x_other[row], sigma_d[row], turn, focal, baseline, points[row], sigma[row])


@row_loop
def _distorted(x: Any, y: Any, c: Any, axis: Any) -> Any:
    """Return the column (axis 0) or row (1) in [px] of an undistorted slope."""
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    top = 1.0 + r2 * (c[5] + r2 * (c[6] + r2 * c[9]))
    bottom = 1.0 + r2 * (c[10] + r2 * (c[11] + r2 * c[12]))
    radial = top / bottom
    xd = x * radial + 2.0 * c[7] * xy + c[8] * (r2 + 2.0 * xx) + r2 * (c[13] + r2 * c[14])
    yd = y * radial + c[7] * (r2 + 2.0 * yy) + 2.0 * c[8] * xy + r2 * (c[15] + r2 * c[16])
    if axis == 0:
        return c[0] * xd + c[4] * yd + c[2]
    return c[1] * yd + c[3]


@row_loop
def _plane_row(x: Any, y: Any, u: Any, sigma_u: Any, n: Any, points: Any, sigma: Any) -> Any:
    """Closed form: depth = (u t_z' - t_u) / (r . (a - u b)), both affine in the pixel's ray."""
    known = sigma_u.size == u.size
    for i in range(x.size):
        along = n[0, 0] * x[i] + n[0, 1] * y[i] + n[0, 2]
        forward = n[1, 0] * x[i] + n[1, 1] * y[i] + n[1, 2]
        scale = 1.0 / (along - u[i] * forward)
        depth = (u[i] * n[1, 3] - n[0, 3]) * scale
        # u = (depth along + t_u) / (depth forward + t_z)
        distance = depth * forward + n[1, 3]
        depth = depth if (depth > 0.0) & (distance > 0.0) else np.nan
        points[i, 0] = depth * x[i]
        points[i, 1] = depth * y[i]
        points[i, 2] = depth
        per_px = distance * scale
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1.0)
        sigma[i] = sigma_u[i if known else 0] * abs(per_px) * length + 0.0 * np.float32(depth)


@row_loop
def _curved_row(
    x: Any,
    y: Any,
    u: Any,
    sigma_u: Any,
    n: Any,
    R: Any,
    t: Any,
    c: Any,
    axis: Any,
    points: Any,
    sigma: Any,
) -> Any:
    """Correct the closed form's depth by Newton's method on the distorted projection."""
    known = sigma_u.size == u.size
    for i in range(x.size):
        depth = np.float64(points[i, 2])
        along = n[0, 0] * x[i] + n[0, 1] * y[i] + n[0, 2]
        forward = n[1, 0] * x[i] + n[1, 1] * y[i] + n[1, 2]
        rx = R[0, 0] * x[i] + R[0, 1] * y[i] + R[0, 2]
        ry = R[1, 0] * x[i] + R[1, 1] * y[i] + R[1, 2]
        per_mm = np.nan
        if not np.isnan(depth):
            before, missing_before = 0.0, 0.0
            for step in range(_NEWTON_STEPS):
                distance = depth * forward + t[2]
                px = (depth * rx + t[0]) / distance
                py = (depth * ry + t[1]) / distance
                missing = u[i] - _distorted(px, py, c, axis)
                linear = (along - (depth * along + n[0, 3]) / distance * forward) / distance
                # first the undistorted slope, then the secant, which knows the distortion
                per_mm = linear if step == 0 else (missing_before - missing) / (depth - before)
                if not abs(per_mm) > 0.0 or abs(missing) < 1e-7:
                    per_mm = linear if step == 0 else per_mm
                    break
                before, missing_before = depth, missing
                depth = depth + missing / per_mm
            depth = depth if depth > 0.0 else np.nan
        points[i, 0] = depth * x[i]
        points[i, 1] = depth * y[i]
        points[i, 2] = depth
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1.0)
        sigma[i] = sigma_u[i if known else 0] / abs(per_mm) * length


@kernel
def _plane_rows(
    projector_px: Any,
    sigma_px: Any,
    nodes: Any,
    R: Any,
    t: Any,
    c: Any,
    axis: Any,
    curved: Any,
    points: Any,
    sigma: Any,
) -> None:
    height, width = projector_px.shape
    # rows of K [R | t] that give u (or v) and the distance from the projector
    n = np.empty((2, 4), np.float64)
    for k in range(3):
        n[1, k] = R[2, k]
        if axis == 0:
            n[0, k] = c[0] * R[0, k] + c[4] * R[1, k] + c[2] * R[2, k]
        else:
            n[0, k] = c[1] * R[1, k] + c[3] * R[2, k]
    n[1, 3] = t[2]
    n[0, 3] = c[0] * t[0] + c[4] * t[1] + c[2] * t[2] if axis == 0 else c[1] * t[1] + c[3] * t[2]
    known = np.int64(1 if sigma_px.shape[0] == height else 0)
    for row in numba.prange(height):
        x = np.empty(width, np.float64)
        y = np.empty(width, np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, y)
        sigma_row = sigma_px[np.int64(row) * known]
        _plane_row(x, y, projector_px[row], sigma_row, n, points[row], sigma[row])
        if curved:
            _curved_row(
                x, y, projector_px[row], sigma_row, n, R, t, c, axis, points[row], sigma[row]
            )


@row_loop
def _residual_row(points: Any, u: Any, R: Any, t: Any, c: Any, axis: Any, out: Any) -> Any:
    for i in range(u.size):
        X, Y, Z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        px = (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) / distance
        py = (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) / distance
        residual = _distorted(px, py, c, axis) - u[i]
        out[i] = residual if distance > 0.0 else _NAN


@kernel
def _residual_rows(points: Any, u: Any, R: Any, t: Any, c: Any, axis: Any, out: Any) -> None:
    for row in numba.prange(u.shape[0]):
        _residual_row(points[row], u[row], R, t, c, axis, out[row])
