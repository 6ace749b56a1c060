"""Points from scattered correspondences between a camera and a projector, with the row as a check."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    project,
    rays,
)


class CodePoints(NamedTuple):
    """One point per correspondence, in the camera's frame."""

    points_mm: Float64[np.ndarray, "n 3"]
    """On the camera's ray and in the plane of the projector's column; NaN where they don't meet in front of both."""
    row_residual_px: Float64[np.ndarray, "n"]
    """Row where the point projects to, minus the row that was measured, in [px]."""
    sigma_per_px_mm: Float64[np.ndarray, "n"]
    """How far the point moves along its ray per projector pixel, in [mm]."""


def triangulate_code(
    camera_px: Float[np.ndarray, "n 2"],
    projector_px: Float[np.ndarray, "n 2"],
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
) -> CodePoints:
    r"""Intersect camera rays with the planes of projector columns; positions need not be whole pixels.

    Parameters
    ----------
    camera_px, projector_px
        Corresponding positions x, y in [px] in both (distorted) pictures.
    camera, projector
        Models of both, lens distortion included.
    projector_from_camera
        Pose of the projector.

    Raises
    ------
    CalibrationError
        If a model or the pose can't be used.

    Notes
    -----
    With the camera's ray r, X = R r, and q the undistorted slope x/z of the projector's position,

    .. math:: \lambda = \frac{q t_z - t_x}{X_x - q X_z}, \quad
       \left|\frac{\partial\lambda}{\partial u}\right| = \frac{\lambda X_z + t_z}{f |X_x - q X_z|}

    A distorted column is a curve; its plane is taken at the measured row, so a wrong row by some pixels
    changes nothing that counts. The row isn't used otherwise: along it the base line gives no depth, but what
    is left over tells light that came by a second reflection.
    """
    check_pinhole(camera, "the camera")
    check_pinhole(projector, "the projector")
    check_transform(projector_from_camera, "the projector")
    R, t_mm = projector_from_camera
    own = _homogeneous(rays(camera_px.astype(np.float64), camera))
    turned = own @ R.T
    slope = rays(projector_px.astype(np.float64), projector)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = turned[:, 0] - slope * turned[:, 2]
        depth_mm = (slope * t_mm[2] - t_mm[0]) / along
        distance_mm = depth_mm * turned[:, 2] + t_mm[2]
        is_seen = (depth_mm > 0) & (distance_mm > 0)
        depth_mm = np.where(is_seen, depth_mm, np.nan)
        per_px = np.abs(distance_mm / (projector.K[0, 0] * along)) * np.linalg.norm(own, axis=1)
    points_mm = own * depth_mm[:, None]
    residual_px = project(points_mm, projector, projector_from_camera)[:, 1] - projector_px[:, 1]
    return CodePoints(points_mm, residual_px, np.where(is_seen, per_px, np.nan))


def _homogeneous(slopes: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    return np.column_stack([slopes, np.ones(len(slopes))])
