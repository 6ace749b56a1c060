"""A second camera's word on points that were found without it."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from backend.numerics.camera_model import Pinhole, RigidTransform, project

SYSTEMATIC_PX = 0.3
"""Error of the calibration, in projector pixels, that is allowed beside the noise."""


def confirmed(
    points_mm: Float32[np.ndarray, "n 3"],
    coordinate_px: Float32[np.ndarray, "n"],
    other_px: Float32[np.ndarray, "h w"],
    other: Pinhole,
    other_from_points: RigidTransform,
    *,
    sigma_px: Float32[np.ndarray, "n"] | None = None,
    factor: float = 4.0,
) -> Bool[np.ndarray, "n"]:
    """Tell which points another camera sees with the same projector coordinate.

    Parameters
    ----------
    points_mm
        Points in [mm], e.g. from one camera and the projector.
    coordinate_px
        Projector coordinate that each point was made from, in [px].
    other_px
        The other camera's map of projector coordinates in [px], NaN invalid.
    other
        Model of the other camera.
    other_from_points
        Its pose with respect to the points' frame.
    sigma_px
        Standard deviation of the difference of both coordinates in [px]. None: only the systematic part counts.
    factor
        Number of standard deviations that are noise.

    Returns
    -------
    True where the other camera's coordinate at the point's place differs by no more than
    factor sigma + 0.3 px. False outside of its picture, where its coordinate is missing or belongs to another surface.
    """
    if points_mm.shape[0] == 0:
        return np.zeros(0, bool)
    place = project(points_mm, other, other_from_points).astype(np.float32)
    seen = _sample(other_px, place)
    limit = np.float32(SYSTEMATIC_PX) + (0.0 if sigma_px is None else factor * sigma_px)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(seen - coordinate_px) <= limit)


def _sample(
    values: Float32[np.ndarray, "h w"], place_px: Float32[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n"]:
    """Interpolate between the four neighbours; NaN if one of them is missing."""
    # cv2.remap takes pictures of fewer than 32768 columns: lay the positions out in rows.
    width = 4096
    rows = -(-place_px.shape[0] // width)
    x = np.full(rows * width, -10.0, np.float32)
    y = x.copy()
    x[: place_px.shape[0]], y[: place_px.shape[0]] = np.nan_to_num(place_px, nan=-10.0).T
    sampled = cv2.remap(
        values,
        x.reshape(rows, width),
        y.reshape(rows, width),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    return np.asarray(sampled.ravel()[: place_px.shape[0]])
