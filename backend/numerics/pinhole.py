"""What a camera and a pose are, and their checks. Light: nothing here needs a compiled kernel."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from backend.numerics.errors import CalibrationError

DISTORTION_SIZES = (0, 4, 5, 8, 12, 14)
"""Coefficients in OpenCV's models."""


class Pinhole(NamedTuple):
    """A camera, or a projector as an inverse camera; pixel centres at integers."""

    K: Float[np.ndarray, "3 3"]
    """Intrinsic matrix in [px]."""
    distortion: Float[np.ndarray, "_n"]
    """k1 k2 p1 p2 k3 ... in OpenCV's order, 0, 4, 5, 8, 12 or 14 of them."""
    width_px: int
    height_px: int


class RigidTransform(NamedTuple):
    """x_to = R x_from + t."""

    R: Float[np.ndarray, "3 3"]
    t_mm: Float[np.ndarray, "3"]


def check_pinhole(camera: Pinhole, name: str) -> None:
    """Refuse a camera model that can't be used.

    Raises
    ------
    CalibrationError
        If a number isn't finite, the matrix is singular or no intrinsic matrix, the picture
        is empty, or the number of distortion coefficients is none of OpenCV's.
    """
    if not (np.isfinite(camera.K).all() and np.isfinite(camera.distortion).all()):
        raise CalibrationError(
            f"the calibration of {name} holds numbers that aren't finite; calibrate again"
        )
    upper = camera.K[2, 0] == camera.K[2, 1] == camera.K[1, 0] == 0 and camera.K[2, 2] == 1
    if not (upper and camera.K[0, 0] > 0 and camera.K[1, 1] > 0):
        raise CalibrationError(
            f"the intrinsic matrix of {name} is {camera.K.tolist()}; it needs positive focal lengths"
            " and the last row 0 0 1"
        )
    if camera.distortion.size not in DISTORTION_SIZES:
        raise CalibrationError(
            f"{name} has {camera.distortion.size} distortion coefficients; OpenCV's models have"
            f" {', '.join(map(str, DISTORTION_SIZES))}"
        )
    if camera.width_px < 2 or camera.height_px < 2:
        raise CalibrationError(
            f"{name} is {camera.width_px}x{camera.height_px} px; give the size of its pictures"
        )


def check_transform(transform: RigidTransform, name: str) -> None:
    """Refuse a pose whose matrix isn't a rotation or that isn't finite.

    Raises
    ------
    CalibrationError
        If so; orthogonality is checked to 1e-4, as calibration files are rounded.
    """
    finite = np.isfinite(transform.R).all() and np.isfinite(transform.t_mm).all()
    if not finite or not np.allclose(transform.R @ transform.R.T, np.eye(3), atol=1e-4):
        raise CalibrationError(
            f"the pose of {name} isn't a rotation with a finite translation; calibrate again"
        )
    if np.linalg.det(transform.R) < 0:
        raise CalibrationError(f"the pose of {name} mirrors (determinant -1); check its axes")


def inverse(transform: RigidTransform) -> RigidTransform:
    """Return a_from_b for b_from_a."""
    return RigidTransform(transform.R.T, -transform.R.T @ transform.t_mm)


def compose(c_from_b: RigidTransform, b_from_a: RigidTransform) -> RigidTransform:
    """Return c_from_a."""
    return RigidTransform(c_from_b.R @ b_from_a.R, c_from_b.R @ b_from_a.t_mm + c_from_b.t_mm)
