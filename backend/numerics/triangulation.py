"""Points from two cameras, or from a camera and the projector's planes, each with its uncertainty."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Float32

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    ray_lattice,
)
from backend.numerics.errors import CalibrationError
from backend.numerics.kernels import kernel, kernel_input, row_loop
from backend.numerics.lattice import Lattice, lattice_row
from backend.numerics.matching import Matches
from backend.numerics.rectification import Rectification


class Cloud(NamedTuple):
    """One point per pixel of the reference camera, in that camera's frame; NaN where there is none.

    Points lie on their pixels' rays, so that the depth says it all: a third of the memory of coordinates.
    """

    depth_mm: Float32[np.ndarray, "h w"]
    """z of the point."""
    sigma_mm: Float32[np.ndarray, "h w"]
    """Standard deviation of the point along its pixel's ray; NaN if the coordinate's noise isn't known."""
    rays: Lattice
    """Slopes (x/z, y/z) of the pixels' rays."""

    @property
    def points_mm(self) -> Float32[np.ndarray, "h w 3"]:
        """Coordinates of the points, made anew at each call."""
        points_mm = np.empty((*self.depth_mm.shape, 3), np.float32)
        _point_rows(self.depth_mm, self.rays.nodes, points_mm)
        return points_mm


_NEWTON_STEPS = 3
"""A lens that moves a point by 5 px is corrected to 0.003 px by the first step; a strong one (k1 = -0.25) needs all three."""


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
    Depths in [mm] in the reference camera's frame and the points' standard deviation along their
    pixels' rays in [mm], float32. Points behind the camera are NaN.

    Notes
    -----
    .. math:: Z = \frac{f b}{x_{ref} - x_{other}}, \quad \sigma_Z = \frac{Z^2}{f |b|} \sigma_d

    in the rectified frame, turned back into the camera's. Coefficients are float64, results float32.
    """
    cloud = _empty_cloud(matches.x_other_px.shape, rectification.rays_of_reference)
    _pair_rows(
        matches.x_other_px,
        matches.sigma_disparity_px,
        rectification.rectified_of_reference.nodes,
        np.ascontiguousarray(rectification.rectified_from_reference[:, 2]),
        rectification.focal_px,
        rectification.baseline_mm,
        cloud.depth_mm,
        cloud.sigma_mm,
    )
    return cloud


def _empty_cloud(shape: tuple[int, ...], rays: Lattice) -> Cloud:
    return Cloud(np.empty(shape, np.float32), np.empty(shape, np.float32), rays)


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
    Depths in [mm] in the camera's frame and the points' standard deviation along the ray in [mm],
    float32. NaN where the ray runs along the plane or meets it behind the camera or projector.

    Raises
    ------
    CalibrationError
        If a model or the pose can't be used or the map hasn't the camera's size.

    Notes
    -----
    With the ray r, X = R r, and the undistorted projector a plane's depth is

    .. math:: \lambda = \frac{(u - c) t_z - f t_x}{f X_x - (u - c) X_z}

    With projector distortion the plane is a curved surface; the depth is corrected by three
    Newton steps on the distorted projection, which for a real lens leaves less than 1e-6 px.
    sigma is :math:`\sigma_u |\partial \lambda / \partial u| |r|`.
    """
    _check_size(projector_px, camera)
    cloud = _empty_cloud(projector_px.shape, ray_lattice(camera))
    unknown = np.full((1, projector_px.shape[1]), np.nan, np.float32)
    _plane_rows(
        kernel_input(projector_px),
        unknown if sigma_projector_px is None else kernel_input(sigma_projector_px),
        cloud.rays.nodes,
        projector_planes(projector, projector_from_camera, rows=rows),
        cloud.depth_mm,
        cloud.sigma_mm,
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
    out = np.empty(projector_px.shape, np.float32)
    _residual_rows(
        kernel_input(points_mm),
        kernel_input(projector_px),
        projector_planes(projector, projector_from_points, rows=rows),
        out,
    )
    return out


def depth_consistency(
    cloud: Cloud,
    projector_px: Float32[np.ndarray, "h w"],
    projector: Pinhole,
    projector_from_camera: RigidTransform,
    *,
    rows: bool = False,
) -> Float32[np.ndarray, "h w"]:
    """Return what `projector_consistency` does, of points that are given by their depths."""
    out = np.empty(projector_px.shape, np.float32)
    _depth_residual_rows(
        cloud.depth_mm,
        cloud.rays.nodes,
        kernel_input(projector_px),
        projector_planes(projector, projector_from_camera, rows=rows),
        out,
    )
    return out


class ProjectorPlanes(NamedTuple):
    """The projector's columns (or rows) as kernels take them; `projector_planes` makes it."""

    plane: Any  # float64[2, 4]: rows of K [R | t] that give u times distance, and the distance
    R: Any  # float64[3, 3]
    t_mm: Any  # float64[3]
    lens: Any  # float64[15]: see `_coefficients`
    curved: bool  # the lens distorts


def projector_planes(
    projector: Pinhole, projector_from_points: RigidTransform, *, rows: bool = False
) -> ProjectorPlanes:
    """Prepare a projector for `plane_depths`.

    Raises
    ------
    CalibrationError
        If the model or the pose can't be used.
    """
    check_pinhole(projector, "the projector")
    check_transform(projector_from_points, "the projector")
    coefficients = _coefficients(projector, rows=rows)
    return ProjectorPlanes(
        _plane_coefficients(coefficients, projector_from_points),
        projector_from_points.R.astype(np.float64),
        projector_from_points.t_mm.astype(np.float64),
        coefficients,
        bool(np.any(projector.distortion)),
    )


def _check_size(projector_px: Float32[np.ndarray, "h w"], camera: Pinhole) -> None:
    if projector_px.shape != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the map is {projector_px.shape[1]}x{projector_px.shape[0]} px but the camera's calibration"
            f" is for {camera.width_px}x{camera.height_px} px; use the calibration of this size"
        )


def _coefficients(device: Pinhole, *, rows: bool) -> Float[np.ndarray, "15"]:
    """Return gx gy g0 of u = gx x + gy y + g0, then OpenCV's first twelve distortion coefficients."""
    distortion = np.zeros(14)
    distortion[: device.distortion.size] = device.distortion
    if distortion[12:].any():
        raise CalibrationError(
            f"the projector's model has a tilted sensor {distortion[12:].tolist()}, which isn't supported;"
            " calibrate it with at most twelve coefficients"
        )
    K = device.K
    last_row = [0.0, K[1, 1], K[1, 2]] if rows else [K[0, 0], K[0, 1], K[0, 2]]
    return np.array([*last_row, *distortion[:12]])


def _plane_coefficients(
    coefficients: Float[np.ndarray, "15"], projector_from_camera: RigidTransform
) -> Float[np.ndarray, "2 4"]:
    """Return the rows of K [R | t] that give u times distance, and the distance."""
    pose = np.column_stack([projector_from_camera.R, projector_from_camera.t_mm])
    return np.stack([coefficients[:3] @ pose, pose[2]])


# ---------------------------------------------------------------- kernels


@row_loop
def _pair_depth(
    x: Any, y: Any, x_other: Any, sigma_d: Any, focal: Any, span: Any, depth: Any, sigma: Any
) -> Any:
    scale = 1.0 / (focal * focal)
    per_span = 1.0 / abs(span)
    for i in range(x.size):
        z = span / (x[i] - x_other[i])
        z = z if z > 0.0 else np.nan
        depth[i] = z
        length = np.sqrt((x[i] * x[i] + y[i] * y[i]) * scale + 1.0)
        sigma[i] = z * z * per_span * length * sigma_d[i]


@row_loop
def _depth_along_axis(x: Any, y: Any, depth: Any, axis: Any, scale: Any, out: Any) -> Any:
    """Turn depths in the rectified frame into those along the camera's own axis."""
    a0, a1, a2 = axis[0] * scale, axis[1] * scale, axis[2]
    for i in range(x.size):
        out[i] = depth[i] * (a0 * x[i] + a1 * y[i] + a2)


@kernel
def _pair_rows(
    x_other: Any,
    sigma_d: Any,
    nodes: Any,
    axis: Any,
    focal: Any,
    baseline: Any,
    out: Any,
    sigma: Any,
) -> None:
    height, width = x_other.shape
    for row in numba.prange(height):
        rows = np.empty((3, width), np.float64)
        x, y, depth = rows[0], rows[1], rows[2]
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, y)
        _pair_depth(x, y, x_other[row], sigma_d[row], focal, focal * baseline, depth, sigma[row])
        _depth_along_axis(x, y, depth, axis, 1.0 / focal, out[row])


@row_loop
def _on_rays(x: Any, y: Any, depth: Any, points: Any) -> Any:
    for i in range(x.size):
        points[i, 0] = depth[i] * x[i]
        points[i, 1] = depth[i] * y[i]
        points[i, 2] = depth[i]


@kernel
def _point_rows(depth: Any, nodes: Any, points: Any) -> None:
    height, width = depth.shape
    for row in numba.prange(height):
        rays = np.empty((2, width), np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, rays[0])
        lattice_row(nodes[1], row, work, rays[1])
        _on_rays(rays[0], rays[1], depth[row], points[row])


@row_loop
def _plane_depth(x: Any, y: Any, u: Any, n: Any, depth: Any, per_px: Any) -> Any:
    """Solve u (forward depth + n_13) = along depth + n_03; both factors are affine in the pixel's ray."""
    a0, a1, a2, a3 = n[0, 0], n[0, 1], n[0, 2], n[0, 3]
    b0, b1, b2, b3 = n[1, 0], n[1, 1], n[1, 2], n[1, 3]
    for i in range(x.size):
        along = a0 * x[i] + a1 * y[i] + a2
        forward = b0 * x[i] + b1 * y[i] + b2
        scale = 1.0 / (along - u[i] * forward)
        z = (u[i] * b3 - a3) * scale
        distance = z * forward + b3
        valid = (z > 0.0) & (distance > 0.0)
        depth[i] = z if valid else np.nan
        per_px[i] = distance * scale


@row_loop
def _bent(px: Any, py: Any, c: Any) -> Any:
    """Return the distorted coordinate of an undistorted slope, and its two derivatives."""
    xx, yy, xy = px * px, py * py, px * py
    r2 = xx + yy
    bottom = 1.0 / (1.0 + r2 * (c[8] + r2 * (c[9] + r2 * c[10])))
    radial = (1.0 + r2 * (c[3] + r2 * (c[4] + r2 * c[7]))) * bottom
    bottom_slope = c[8] + r2 * (2.0 * c[9] + r2 * 3.0 * c[10])
    radial_slope = (c[3] + r2 * (2.0 * c[4] + r2 * 3.0 * c[7]) - radial * bottom_slope) * bottom
    prism_x, prism_y = c[11] + r2 * c[12], c[13] + r2 * c[14]
    slope_x = 2.0 * (px * radial_slope + c[11] + 2.0 * r2 * c[12])
    slope_y = 2.0 * (py * radial_slope + c[13] + 2.0 * r2 * c[14])
    xd = px * radial + 2.0 * c[5] * xy + c[6] * (r2 + 2.0 * xx) + r2 * prism_x
    yd = py * radial + c[5] * (r2 + 2.0 * yy) + 2.0 * c[6] * xy + r2 * prism_y
    tangential = 2.0 * (c[5] * px + c[6] * py)
    xd_x = radial + px * slope_x + 2.0 * c[5] * py + 6.0 * c[6] * px
    xd_y = py * slope_x + tangential
    yd_x = px * slope_y + tangential
    yd_y = radial + py * slope_y + 6.0 * c[5] * py + 2.0 * c[6] * px
    return (
        c[0] * xd + c[1] * yd + c[2],
        c[0] * xd_x + c[1] * yd_x,
        c[0] * xd_y + c[1] * yd_y,
    )


@row_loop
def _scalars(c: Any) -> Any:
    return (
        c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11], c[12], c[13], c[14],
    )  # fmt: skip


@row_loop
def _newton(x: Any, y: Any, u: Any, R: Any, t: Any, c: Any, depth: Any, per_px: Any) -> Any:
    """Move each depth by one Newton step of the distorted projection."""
    # Read before the loop: an array that might overlap the written one keeps the loop scalar.
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    lens = _scalars(c)
    for i in range(x.size):
        rx = r00 * x[i] + r01 * y[i] + r02
        ry = r10 * x[i] + r11 * y[i] + r12
        rz = r20 * x[i] + r21 * y[i] + r22
        scale = 1.0 / (depth[i] * rz + t2)
        px = (depth[i] * rx + t0) * scale
        py = (depth[i] * ry + t1) * scale
        value, du_dx, du_dy = _bent(px, py, lens)
        per_mm = (du_dx * (rx - px * rz) + du_dy * (ry - py * rz)) * scale
        inverse = 1.0 / per_mm
        z = depth[i] + (u[i] - value) * inverse
        depth[i] = z if z > 0.0 else np.nan
        per_px[i] = inverse


@row_loop
def plane_depths(x: Any, y: Any, u: Any, planes: Any, depth: Any, per_px: Any) -> Any:
    """Intersect rays with their planes: depth, and its change per px of the coordinate."""
    _plane_depth(x, y, u, planes.plane, depth, per_px)
    if planes.curved:
        for _ in range(_NEWTON_STEPS):
            _newton(x, y, u, planes.R, planes.t_mm, planes.lens, depth, per_px)


@row_loop
def along_ray(x: Any, y: Any, depth: Any, per_px: Any, sigma_px: Any, sigma: Any) -> Any:
    """Turn the coordinate's noise into that of the point along its ray."""
    for i in range(x.size):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1.0)
        sigma[i] = sigma_px[i] * abs(per_px[i]) * length if depth[i] > 0.0 else np.nan


@kernel
def _plane_rows(
    projector_px: Any, sigma_px: Any, nodes: Any, planes: Any, out: Any, sigma: Any
) -> None:
    height, width = projector_px.shape
    known = np.int64(1 if sigma_px.shape[0] == height else 0)
    for row in numba.prange(height):
        rows = np.empty((4, width), np.float64)
        x, y, depth, per_px = rows[0], rows[1], rows[2], rows[3]
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, x)
        lattice_row(nodes[1], row, work, y)
        plane_depths(x, y, projector_px[row], planes, depth, per_px)
        out[row] = depth
        along_ray(x, y, depth, per_px, sigma_px[np.int64(row) * known], sigma[row])


@row_loop
def _residual_row(X: Any, Y: Any, Z: Any, u: Any, R: Any, t: Any, c: Any, out: Any) -> Any:
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    lens = _scalars(c)
    for i in range(u.size):
        distance = r20 * X[i] + r21 * Y[i] + r22 * Z[i] + t2
        scale = 1.0 / distance
        px = (r00 * X[i] + r01 * Y[i] + r02 * Z[i] + t0) * scale
        py = (r10 * X[i] + r11 * Y[i] + r12 * Z[i] + t1) * scale
        value, _, _ = _bent(px, py, lens)
        out[i] = value - u[i] if distance > 0.0 else np.nan


@row_loop
def _split(points: Any, X: Any, Y: Any, Z: Any) -> Any:
    for i in range(X.size):
        X[i], Y[i], Z[i] = points[i, 0], points[i, 1], points[i, 2]


@kernel
def _residual_rows(points: Any, u: Any, planes: Any, out: Any) -> None:
    for row in numba.prange(u.shape[0]):
        rows = np.empty((3, u.shape[1]), np.float64)
        _split(points[row], rows[0], rows[1], rows[2])
        _residual_row(
            rows[0], rows[1], rows[2], u[row], planes.R, planes.t_mm, planes.lens, out[row]
        )


@row_loop
def _scale_rays(x: Any, y: Any, depth: Any, Z: Any) -> Any:
    for i in range(x.size):
        Z[i] = depth[i]
        x[i] *= Z[i]
        y[i] *= Z[i]


@kernel
def _depth_residual_rows(depth: Any, nodes: Any, u: Any, planes: Any, out: Any) -> None:
    for row in numba.prange(u.shape[0]):
        rows = np.empty((3, u.shape[1]), np.float64)
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], row, work, rows[0])
        lattice_row(nodes[1], row, work, rows[1])
        _scale_rays(rows[0], rows[1], depth[row], rows[2])
        _residual_row(
            rows[0], rows[1], rows[2], u[row], planes.R, planes.t_mm, planes.lens, out[row]
        )
