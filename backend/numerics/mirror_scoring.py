"""How far a measured mirror is from the truth, where the truth is known: slopes and heights."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from backend.numerics.errors import NumericsError
from backend.numerics.pinhole import RigidTransform, compose, inverse

DEFINITION = (
    "Base: pixels of the camera that lie wholly on the mirror and see the screen in it. "
    "Slope error: measured minus true slope of the same pixel, in the mirror's frame, rms over pixels and both "
    "directions. Height error: measured minus true height of the same pixel, less its mean, rms."
)
"""What the figures mean, for the report's help."""


@dataclass(frozen=True)
class MirrorTruth:
    """The true surface behind every pixel of the reference camera, in the mirror's frame."""

    points_mm: Float64[np.ndarray, "h w 3"]
    """Where the ray of the pixel's centre meets the mirror; NaN where it doesn't."""
    slopes: Float64[np.ndarray, "2 h w"]
    """dz/dx and dz/dy there."""
    seen: Bool[np.ndarray, "h w"]
    """The pixel lies wholly on the mirror and sees the screen in it."""
    mirror_from_camera: RigidTransform

    @property
    def normals(self) -> Float64[np.ndarray, "h w 3"]:
        """Unit normals in the mirror's frame, towards the viewer."""
        up = np.stack([-self.slopes[0], -self.slopes[1], np.ones(self.seen.shape)], axis=-1)
        return np.asarray(up / np.linalg.norm(up, axis=-1, keepdims=True))

    def in_frame(self, mirror_from_camera: RigidTransform) -> "MirrorTruth":
        """Return the same truth in another frame of the mirror, given by its pose."""
        turn = compose(mirror_from_camera, inverse(self.mirror_from_camera))
        normals = self.normals @ turn.R.T
        return MirrorTruth(
            points_mm=np.asarray(self.points_mm @ turn.R.T + turn.t_mm),
            slopes=np.asarray(np.moveaxis(-normals[..., :2] / normals[..., 2:], -1, 0)),
            seen=self.seen,
            mirror_from_camera=mirror_from_camera,
        )


class MirrorScore(NamedTuple):
    """Figures of one measured mirror; NaN where there is nothing to count."""

    base: int
    """Pixels on the mirror that see the screen."""
    measured: int
    """Of these, how many have slopes."""
    slope_rms_urad: float
    """Over both directions."""
    slope_x_rms_urad: float
    slope_y_rms_urad: float
    slope_x_mean_urad: float
    slope_y_mean_urad: float
    slope_ripple_urad: float
    """Slope error without its mean: what is left when the mirror's pose is known to tilt."""
    height_rms_um: float
    height_tilt_free_rms_um: float
    """The same less the best plane."""
    height_mean_um: float
    """What was taken away as mean."""
    height_worst_um: float
    """Largest height error, less the mean."""


def score_mirror(
    slopes: Float[np.ndarray, "2 h w"],
    heights_mm: Float[np.ndarray, "h w"],
    truth: MirrorTruth,
) -> MirrorScore:
    """Compare measured slopes and heights of every pixel with the true ones.

    Parameters
    ----------
    slopes
        dz/dx and dz/dy in the mirror's frame; NaN where there is no measurement.
    heights_mm
        z in the mirror's frame; NaN where there is no measurement. Their common offset doesn't count.
    truth
        The true surface.

    Raises
    ------
    NumericsError
        If the maps aren't of the truth's size.
    """
    if heights_mm.shape != truth.seen.shape or slopes.shape[1:] != truth.seen.shape:
        raise NumericsError(
            f"a mirror measured on {heights_mm.shape[::-1]} pixels can't be compared with one on"
            f" {truth.seen.shape[::-1]}: use the truth of the same camera"
        )
    found = truth.seen & np.isfinite(slopes).all(axis=0)
    error = 1e6 * (slopes[:, found].astype(np.float64) - truth.slopes[:, found])
    mean = error.mean(axis=1) if found.any() else np.full(2, np.nan)
    high = truth.seen & np.isfinite(heights_mm)
    height = 1e3 * (heights_mm[high].astype(np.float64) - truth.points_mm[high][:, 2])
    offset = float(height.mean()) if high.any() else float("nan")
    return MirrorScore(
        base=int(truth.seen.sum()),
        measured=int(found.sum()),
        slope_rms_urad=_rms(error),
        slope_x_rms_urad=_rms(error[0]),
        slope_y_rms_urad=_rms(error[1]),
        slope_x_mean_urad=float(mean[0]),
        slope_y_mean_urad=float(mean[1]),
        slope_ripple_urad=_rms(error - mean[:, None]),
        height_rms_um=_rms(height - offset),
        height_tilt_free_rms_um=_rms(_without_plane(height, truth.points_mm[high][:, :2])),
        height_mean_um=offset,
        height_worst_um=float(np.abs(height - offset).max()) if high.any() else float("nan"),
    )


def _without_plane(
    values: Float64[np.ndarray, "n"], places: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n"]:
    if values.size < 3:
        return np.full(values.shape, np.nan)
    design = np.column_stack([places, np.ones(len(places))])
    return np.asarray(values - design @ np.linalg.lstsq(design, values, rcond=None)[0])


def _rms(values: Float64[np.ndarray, "..."]) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
