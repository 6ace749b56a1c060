"""Which projector pixels nobody has claimed yet, where pixels that weren't told may look: lit alone, they can be told."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from backend.numerics.camera_model import project, rays
from backend.numerics.code_certainty import PairGeometry
from backend.numerics.intensity_mask import scatter

_MOST_PIXELS = 8000
_STEP_PX = 1.5


def claimed_places(
    projector_px: Float32[np.ndarray, "h w"],
    projector_row_px: Float32[np.ndarray, "h w"],
    *,
    width_px: int,
    height_px: int,
    reach_px: int = 1,
) -> Bool[np.ndarray, "hp wp"]:
    """Mark the projector pixels that a camera's trusted codes claim, and those between them.

    Parameters
    ----------
    projector_px, projector_row_px
        Trusted codes; NaN elsewhere.
    width_px, height_px
        Size of the projector.
    reach_px
        Gaps between claimed pixels up to twice this are closed: a camera samples a steep surface thinly.

    Examples
    --------
    >>> places = claimed_places(np.float32([[2, 4]]), np.float32([[0, 0]]), width_px=8, height_px=1)
    >>> places.astype(int)
    array([[0, 0, 1, 1, 1, 0, 0, 0]])
    """
    free = np.ones((height_px, width_px), np.float32)
    scatter(np.zeros_like(projector_px), projector_px, projector_row_px, into=free)
    side = 2 * reach_px + 1
    box = np.ones((side, side), np.uint8)
    claimed = cv2.morphologyEx(
        (free == 0).astype(np.uint8), cv2.MORPH_CLOSE, box, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(claimed > 0)


def possible_places(
    pixels: Bool[np.ndarray, "h w"],
    geometry: PairGeometry,
    *,
    near_mm: float,
    far_mm: float,
) -> Bool[np.ndarray, "hp wp"]:
    """Mark the projector pixels that some camera pixels may look at: their epipolar lines between two depths.

    Parameters
    ----------
    pixels
        The camera pixels asked about. Of very many, evenly spread ones stand for the others.
    geometry
        Camera and projector.
    near_mm, far_mm
        Depths between which surfaces are expected, along the camera's axis, in [mm].
    """
    projector = geometry.projector
    places = np.zeros((projector.height_px, projector.width_px), np.uint8)
    y, x = np.nonzero(pixels)
    if not y.size:
        return places > 0
    step = max(1, y.size // _MOST_PIXELS)
    slopes = rays(np.column_stack([x, y])[::step].astype(np.float64), geometry.camera)
    along = np.column_stack([slopes, np.ones(len(slopes))])
    pose = geometry.projector_from_camera
    ends = [project(along * depth, projector, pose) for depth in (near_mm, far_mm)]
    length_px = float(np.nanmax(np.hypot(*(ends[1] - ends[0]).T)))
    # Even steps in 1/z are even steps along the line.
    for inverse_depth in np.linspace(1 / near_mm, 1 / far_mm, 2 + int(length_px / _STEP_PX)):
        at = project(along / inverse_depth, projector, pose)
        at = np.round(at[np.isfinite(at).all(axis=1)]).astype(np.int64)
        inside = (at >= 0).all(axis=1) & (at[:, 0] < projector.width_px)
        at = at[inside & (at[:, 1] < projector.height_px)]
        places[at[:, 1], at[:, 0]] = 1
    return np.asarray(cv2.dilate(places, np.ones((5, 5), np.uint8)) > 0)


def without_specks(places: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Drop places narrower than two pixels: gaps of the sampling, no surface that stayed unseen.

    Examples
    --------
    >>> places = np.zeros((4, 6), bool)
    >>> places[:, 1], places[1:3, 3:5] = True, True
    >>> without_specks(places).sum().item()
    4
    """
    opened = cv2.morphologyEx(places.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return np.asarray(opened > 0)
