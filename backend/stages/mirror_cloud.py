"""The measured mirror as a cloud in the reference camera's frame."""

import numpy as np

from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.reasons import Reason
from backend.stages.cloud import Cloud, colour_of, enough_points
from backend.stages.screen_phase import ScreenPhase
from backend.stages.slopes import Slopes
from backend.stages.surface import Surface

_EXPOSURE_UNKNOWN = 255


@stage(title="Cloud", version=1, review=Review.ON_WARNING, checks=(enough_points,))
def mirror_cloud(phase: ScreenPhase, slopes: Slopes, surface: Surface) -> Cloud:
    """Put the surface where it stands before the camera: one point per pixel, with its normal."""
    name = slopes.camera
    height = surface.height_mm[name]
    known = np.isfinite(height)
    y, x = np.nonzero(known)
    points = slopes.points_mm[name][known].astype(np.float64)
    points[:, 2] = height[known]
    pose = slopes.mirror_from_camera
    points = (points - pose.t_mm) @ pose.R
    normals = np.stack(
        [
            -1e-3 * slopes.slope_x_mrad[name][known],
            -1e-3 * slopes.slope_y_mrad[name][known],
            np.ones(x.size),
        ],
        axis=1,
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth = np.full(known.shape, np.nan, np.float32)
    depth[known] = points[:, 2]
    reasons = phase.reasons[name].copy()
    reasons[~known & (reasons == 0)] = np.uint16(Reason.NO_MATCH)
    decoded = int(np.count_nonzero(phase.reasons[name] == 0))
    sigma_mm = 1e-3 * surface.misfit_um
    return Cloud(
        points_mm=points.astype(np.float32),
        normals=(normals @ pose.R).astype(np.float32),
        colour=colour_of(phase.modulation_gray[name][known], x.size),
        # Integration sums up noise slowly: over the mirror it is about that of one step.
        sigma_mm=np.full(x.size, sigma_mm, np.float32),
        pixel_x=x.astype(np.float32),
        pixel_y=y.astype(np.float32),
        exposure_index=np.full(x.size, _EXPOSURE_UNKNOWN, np.uint8),
        depth_mm={name: depth},
        reasons={name: reasons},
        removed=(),
        point_count=int(x.size),
        median_sigma_mm=sigma_mm,
        kept_share=x.size / max(decoded, 1),
        cameras=(name,),
    )
