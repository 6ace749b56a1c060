"""How far a wrong height moves a camera pixel's place in the projector: what a flat guess of the scene may cost."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    inverse,
    project,
    rays,
)
from backend.numerics.code_points import triangulate_code
from backend.numerics.errors import CalibrationError

_GRID = 24
"""Pixels along each side of the picture that are looked at."""
_LEAST_POINTS = 4


class Plane(NamedTuple):
    """A plane in the camera's frame."""

    point_mm: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    """Unit length, towards the camera."""


class Deviation(NamedTuple):
    """What each error in height costs, in the order of the heights."""

    height_mm: Float64[np.ndarray, "n"]
    median_px: Float64[np.ndarray, "n"]
    """Median over the picture of the distance in the projector; NaN if no pixel stays in view."""
    largest_px: Float64[np.ndarray, "n"]
    """Largest of them."""


def height_deviation(
    heights_mm: Float[np.ndarray, "n"],
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
    plane: Plane,
) -> Deviation:
    r"""Tell by how many projector pixels a surface off the assumed plane misses its assumed place.

    Parameters
    ----------
    heights_mm
        Heights of the true surface above the plane (positive: towards the camera), in [mm].
    camera, projector
        Models of both, lens distortion included.
    projector_from_camera
        Pose of the projector.
    plane
        The assumed plane: the table.

    Raises
    ------
    CalibrationError
        If a model or the pose can't be used, or no camera pixel sees a lit place of the plane.

    Notes
    -----
    A camera pixel x looks along the ray r; the plane says that it sees :math:`Q = s r` with
    :math:`n \cdot (Q - p) = 0`, in truth it sees :math:`Q_h = s_h r` with :math:`n \cdot (Q_h - p) = h`. Its
    place in the projector moves by :math:`|\pi(Q_h) - \pi(Q)|`, for a parallel rig of base b and the
    projector's focal length f about :math:`f b h / (z (z - h))`. Looked at on 24 x 24 pixels of the picture, those
    that the projector lights on the plane.

    References
    ----------
    .. [1] C. Zhang et al., "A Robust Surface Coding Method for Optically Challenging Objects Using Structured
       Light", IEEE T-ASE 11(3), 775 (2014), doi:10.1109/TASE.2013.2293576: Table I and its figure 12.
    """
    slopes = _lit_rays(camera, projector, projector_from_camera, plane)
    assumed_px = project(_hits(slopes, plane, 0.0), projector, projector_from_camera)
    moved = [
        np.hypot(
            *(
                project(_hits(slopes, plane, height), projector, projector_from_camera) - assumed_px
            ).T
        )
        for height in heights_mm
    ]
    known = [values[np.isfinite(values)] for values in moved]
    nan = float("nan")
    return Deviation(
        np.asarray(heights_mm, np.float64),
        np.array([np.median(values) if values.size else nan for values in known]),
        np.array([np.max(values) if values.size else nan for values in known]),
    )


def dilation_px(
    height_range_mm: float,
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
    plane: Plane,
) -> int:
    """Return by how many projector pixels a flat guess has to be widened for surfaces up to a height.

    Parameters
    ----------
    height_range_mm
        Largest height above or below the plane that is expected, in [mm], >= 0.
    camera, projector, projector_from_camera, plane
        As for `height_deviation`.

    Returns
    -------
    Whole pixels, >= 1: the median deviation of the larger of both sides, rounded up.

    Raises
    ------
    CalibrationError
        As `height_deviation` does, and if surfaces at that height can't be seen.
    """
    heights = np.array([height_range_mm, -height_range_mm])
    found = height_deviation(heights, camera, projector, projector_from_camera, plane).median_px
    if np.isnan(found).any():
        raise CalibrationError(
            f"no pixel sees a surface {height_range_mm:g} mm off the table; expect a smaller range of heights"
        )
    return max(1, int(np.ceil(np.max(found) - 1e-9)))


def facing_plane(
    camera: Pinhole, projector: Pinhole, projector_from_camera: RigidTransform
) -> Plane:
    """Guess the table where none was measured: across the camera's axis, where the projector's axis comes nearest.

    Raises
    ------
    CalibrationError
        If the axes don't come near each other before both devices.
    """
    check_pinhole(camera, "the camera")
    check_pinhole(projector, "the projector")
    check_transform(projector_from_camera, "the projector")
    own, other = _axis(camera), _axis(projector)
    back = inverse(projector_from_camera)
    other = back.R @ other
    base = back.t_mm
    # Nearest points of two lines: along `own` from 0, along `other` from the projector's centre.
    system = np.array([[own @ own, -own @ other], [own @ other, -other @ other]])
    if abs(np.linalg.det(system)) > 1e-9:
        along, along_other = np.linalg.solve(system, [own @ base, other @ base])
        if along > 0 and along_other > 0:
            return Plane(along * own, np.array([0.0, 0.0, -1.0]))
    raise CalibrationError(
        "the axes of camera and projector don't meet before them; measure the table instead of guessing its place"
    )


def plane_of_homography(
    projector_from_camera_px: Float[np.ndarray, "3 3"],
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
) -> Plane:
    """Find the table that a homography from camera to projector pixels stands for.

    Parameters
    ----------
    projector_from_camera_px
        Maps homogeneous camera pixels to projector pixels, pixel centres at integers.
    camera, projector, projector_from_camera
        Models and pose.

    Raises
    ------
    CalibrationError
        If its rays meet in too few places to tell a plane.
    """
    pixels = _grid(camera)
    mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ projector_from_camera_px.T
    with np.errstate(divide="ignore", invalid="ignore"):
        places = mapped[:, :2] / mapped[:, 2:]
    lit = _within(places, projector)
    found = triangulate_code(pixels[lit], places[lit], camera, projector, projector_from_camera)
    points = found.points_mm[np.isfinite(found.points_mm).all(axis=1)]
    if len(points) < _LEAST_POINTS:
        raise CalibrationError(
            f"the homography puts {len(points)} of {len(pixels)} camera pixels onto a lit plane; calibrate the table again"
        )
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    return Plane(middle, normal if normal @ middle < 0 else -normal)


def _axis(device: Pinhole) -> Float64[np.ndarray, "3"]:
    """Return the ray through the middle of the picture, of length 1."""
    middle = np.array([[(device.width_px - 1) / 2, (device.height_px - 1) / 2]])
    ray = np.append(rays(middle, device)[0], 1.0)
    return np.asarray(ray / np.linalg.norm(ray))


def _grid(device: Pinhole) -> Float64[np.ndarray, "n 2"]:
    x, y = (np.linspace(0, size - 1, _GRID) for size in (device.width_px, device.height_px))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _lit_rays(
    camera: Pinhole, projector: Pinhole, projector_from_camera: RigidTransform, plane: Plane
) -> Float64[np.ndarray, "n 3"]:
    check_pinhole(camera, "the camera")
    check_pinhole(projector, "the projector")
    check_transform(projector_from_camera, "the projector")
    pixels = _grid(camera)
    slopes = np.column_stack([rays(pixels, camera), np.ones(len(pixels))])
    places = project(_hits(slopes, plane, 0.0), projector, projector_from_camera)
    lit = _within(places, projector)
    if not lit.any():
        raise CalibrationError(
            "no pixel of the camera sees a place of the table that the projector lights; check the table's pose"
        )
    return np.asarray(slopes[lit])


def _within(places: Float64[np.ndarray, "n 2"], device: Pinhole) -> Bool[np.ndarray, "n"]:
    size = np.array([device.width_px, device.height_px])
    return np.asarray(((places >= -0.5) & (places <= size - 0.5)).all(axis=1))


def _hits(
    slopes: Float64[np.ndarray, "n 3"], plane: Plane, height_mm: float
) -> Float64[np.ndarray, "n 3"]:
    """Intersect rays with the plane moved by a height; NaN where it lies behind the camera."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (plane.point_mm @ plane.normal + height_mm) / (slopes @ plane.normal)
    return slopes * np.where(along > 0, along, np.nan)[:, None]
