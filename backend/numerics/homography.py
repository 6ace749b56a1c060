"""The homography of a plane: from camera pixels to projector pixels, fitted robustly."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64

from backend.numerics.errors import CalibrationError

_LEAST_POINTS = 4
_FLAT = 1e-3
"""Points whose cloud is this much thinner than long lie on a line."""


class PlaneFit(NamedTuple):
    """A homography and how well it fits."""

    matrix: Float64[np.ndarray, "3 3"]
    """Maps homogeneous camera pixels to projector pixels; its last element is 1."""
    rms_px: float
    """Root mean square residual of the inliers, in projector [px]."""
    inlier_share: float


def fit_homography(
    camera_px: Float[np.ndarray, "n 2"],
    projector_px: Float[np.ndarray, "n 2"],
    *,
    tolerance_px: float = 3.0,
) -> PlaneFit:
    """Fit a homography to correspondences some of which may be wrong.

    Parameters
    ----------
    camera_px, projector_px
        Corresponding positions in [px], pixel centres at integers.
    tolerance_px
        A correspondence within this distance belongs to the plane, in projector [px].

    Raises
    ------
    CalibrationError
        If there are fewer than four points, they lie on one line, or no four of them agree.

    Notes
    -----
    Random samples of four with a score that falls off with the residual (OpenCV's USAC_MAGSAC, seeded: the same
    points give the same matrix), then least squares over the inliers. Lens distortion isn't part of the model
    and shows in `rms_px`.

    References
    ----------
    .. [1] C. Zhang et al., "A Robust Surface Coding Method for Optically Challenging Objects Using Structured
       Light", IEEE T-ASE 11(3), 775 (2014), doi:10.1109/TASE.2013.2293576: equation 10.

    Examples
    --------
    >>> square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10], [5, 3]])
    >>> fit = fit_homography(square, 2 * square + 1)
    >>> np.round(map_points(fit.matrix, np.array([[4.0, 7.0]])), 6) + 0.0
    array([[ 9., 15.]])
    """
    _check_points(camera_px, "camera")
    _check_points(projector_px, "projector")
    source, target = (np.ascontiguousarray(p, np.float64) for p in (camera_px, projector_px))
    matrix, inliers = cv2.findHomography(source, target, cv2.USAC_MAGSAC, tolerance_px)
    if matrix is None or not np.isfinite(matrix).all():
        raise CalibrationError(
            f"no plane agrees with the {len(camera_px)} points: clear the table and capture it again"
        )
    kept = inliers.ravel() > 0
    if np.count_nonzero(kept) >= _LEAST_POINTS:
        refined, _ = cv2.findHomography(source[kept], target[kept], 0)
        matrix = matrix if refined is None else refined
    off = map_points(matrix, source) - target
    distance = np.hypot(off[:, 0], off[:, 1])
    kept = distance <= tolerance_px
    rms = float(np.sqrt(np.mean(distance[kept] ** 2))) if kept.any() else float("nan")
    return PlaneFit(np.asarray(matrix, np.float64), rms, float(kept.mean()))


def map_points(
    matrix: Float[np.ndarray, "3 3"], points_px: Float[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2"]:
    """Apply a homography; NaN for points that it sends to infinity or behind."""
    mapped = np.column_stack([points_px, np.ones(len(points_px))]) @ matrix.T
    scale = mapped[:, 2:]
    # The sign that the points share is the front; a homography is known up to a factor.
    front = scale * np.sign(np.median(scale)) > 1e-12
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(front, mapped[:, :2] / scale, np.nan))


def _check_points(points_px: Float[np.ndarray, "n 2"], where: str) -> None:
    if len(points_px) < _LEAST_POINTS:
        raise CalibrationError(
            f"a homography needs 4 points, {len(points_px)} were found in the {where}'s picture: "
            "bring more of the table into view"
        )
    if not np.isfinite(points_px).all():
        raise CalibrationError(
            f"some of the {len(points_px)} points of the {where} aren't finite: leave them out"
        )
    spread = np.linalg.svd(points_px - points_px.mean(axis=0), compute_uv=False)
    if spread[1] <= _FLAT * max(spread[0], 1e-12):
        raise CalibrationError(
            f"the {len(points_px)} points of the {where} lie on one line, which fits no homography: "
            "bring more of the table into view"
        )
