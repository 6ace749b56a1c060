"""Where camera pixels look if the scene is a table with parts up to some height on it."""

import numpy as np
from jaxtyping import Float, Float32, Float64

from backend.numerics.camera_model import Pinhole, RigidTransform, project, rays
from backend.numerics.errors import CalibrationError
from backend.numerics.height_deviation import plane_of_homography
from backend.numerics.homography import map_points

_GRID = 16


def plane_positions(
    matrix: Float[np.ndarray, "3 3"], *, width_px: int, height_px: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Map every camera pixel by a homography; NaN where it sends a pixel to infinity.

    Examples
    --------
    >>> columns, rows = plane_positions(np.diag([2.0, 3.0, 1.0]), width_px=2, height_px=2)
    >>> columns.tolist(), rows.tolist()
    ([[0.0, 2.0], [0.0, 2.0]], [[0.0, 0.0], [3.0, 3.0]])
    """
    y, x = np.mgrid[:height_px, :width_px]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    mapped = map_points(matrix, pixels).astype(np.float32).reshape(height_px, width_px, 2)
    return mapped[..., 0], mapped[..., 1]


def height_shifts(
    height_mm: float,
    matrix: Float[np.ndarray, "3 3"],
    camera: Pinhole,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
    *,
    step_px: float = 2.0,
) -> Float64[np.ndarray, "n 2"]:
    r"""Tell how a camera pixel's place in the projector wanders while the surface rises from the table.

    Parameters
    ----------
    height_mm
        Height of the highest part above the table, in [mm].
    matrix
        Homography of the table, from camera to projector pixels.
    camera, projector, projector_from_camera
        Models and pose.
    step_px
        Shifts are at most so far apart, in projector [px].

    Returns
    -------
    Shifts in projector [px], from (0, 0) to the one at full height: the mean over the picture.

    Raises
    ------
    CalibrationError
        If the homography and the calibration don't agree on a table, or no pixel sees the height.

    Notes
    -----
    The deviation of the paper's Table I has a direction: all of it lies along the epipolar line, on one side of
    the table's place. Sweeping the mask along it covers the heights expected with a fraction of the area that
    a disc of the same reach would darken.
    """
    plane = plane_of_homography(matrix, camera, projector, projector_from_camera)
    x, y = (np.linspace(0, n - 1, _GRID) for n in (camera.width_px, camera.height_px))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    slopes = np.column_stack([rays(pixels, camera), np.ones(len(pixels))])
    along = slopes @ plane.normal
    places = [
        project(
            slopes * ((plane.point_mm @ plane.normal + height) / along)[:, None],
            projector,
            projector_from_camera,
        )
        for height in (0.0, height_mm)
    ]
    moved = places[1] - places[0]
    moved = moved[np.isfinite(moved).all(axis=1)]
    if not len(moved):
        raise CalibrationError(
            f"no pixel sees a surface {height_mm:g} mm above the table: expect a smaller height"
        )
    shift = np.median(moved, axis=0)
    steps = 1 + int(np.ceil(np.hypot(*shift) / step_px))
    return np.asarray(np.linspace(0, 1, steps)[:, None] * shift)
