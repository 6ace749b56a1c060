"""The pinhole camera with lens distortion, as OpenCV models it: pixels to rays and back."""

import cv2
import numpy as np
from jaxtyping import Float

from backend.numerics.errors import CalibrationError
from backend.numerics.lattice import Lattice, lattice_positions
from backend.numerics.pinhole import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    compose,
    inverse,
)

__all__ = [
    "Pinhole",
    "RigidTransform",
    "check_pinhole",
    "check_transform",
    "compose",
    "inverse",
    "project",
    "ray_lattice",
    "rays",
]

_UNDISTORT_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
_ROUND_TRIP_PX = 0.01


def rays(points_px: Float[np.ndarray, "n 2"], camera: Pinhole) -> Float[np.ndarray, "n 2"]:
    """Return the undistorted ray (x/z, y/z) of each pixel position.

    Parameters
    ----------
    points_px
        Positions in the (distorted) picture in [px].
    camera
        Camera model.

    Returns
    -------
    Ray slopes, float64; `project` of any point on the ray returns the position to 1e-9 px,
    unless the distortion can't be inverted there.
    """
    if points_px.shape[0] == 0:
        return np.empty((0, 2))
    undistorted = cv2.undistortPointsIter(
        np.ascontiguousarray(points_px, np.float64)[:, None, :],
        camera.K,
        camera.distortion,
        np.eye(3),
        np.eye(3),
        _UNDISTORT_STOP,
    )
    return np.asarray(undistorted[:, 0, :], np.float64)


def project(
    points_mm: Float[np.ndarray, "n 3"],
    camera: Pinhole,
    camera_from_points: RigidTransform | None = None,
) -> Float[np.ndarray, "n 2"]:
    """Project points into the (distorted) picture.

    Parameters
    ----------
    points_mm
        Points in [mm], in the camera's frame or in the frame that `camera_from_points` maps from.
    camera
        Camera model.
    camera_from_points
        Pose; None means that the points are in the camera's frame.

    Returns
    -------
    Positions in [px], float64. NaN for points that aren't in front of the camera.
    """
    if points_mm.shape[0] == 0:
        return np.empty((0, 2))
    points = points_mm.astype(np.float64)
    if camera_from_points is not None:
        points = points @ camera_from_points.R.T + camera_from_points.t_mm
    pixels, _ = cv2.projectPoints(
        np.ascontiguousarray(points)[:, None, :],
        np.zeros(3),
        np.zeros(3),
        camera.K,
        camera.distortion,
    )
    behind = ~(points[:, 2] > 0)
    return np.where(behind[:, None], np.nan, np.asarray(pixels, np.float64)[:, 0, :])


def ray_lattice(camera: Pinhole, name: str = "camera") -> Lattice:
    """Sample the rays of a camera's pixels on a coarse lattice, for kernels and `Lattice.map`.

    Returns
    -------
    Lattice of (x/z, y/z); interpolation is good to 1e-4 px at focal lengths above
    500 px (rounding of float32 maps included).

    Raises
    ------
    CalibrationError
        If the model can't be used or its distortion can't be inverted within the picture.
    """
    check_pinhole(camera, name)
    x, y = lattice_positions(camera.width_px, camera.height_px)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    slopes = rays(pixels, camera)
    back = project(np.column_stack([slopes, np.ones(len(slopes))]), camera)
    error = np.hypot(*(back - pixels).T)
    if not np.max(error) < _ROUND_TRIP_PX:
        raise CalibrationError(
            f"the distortion of {name} can't be inverted over the whole picture (off by"
            f" {np.max(error):.3g} px); calibrate again with corners near the picture's edges"
        )
    nodes = slopes.T.reshape(2, y.size, x.size)
    return Lattice(np.ascontiguousarray(nodes), camera.width_px, camera.height_px)
