"""How well a mirror was measured, where the rig knows what it looks at: slopes and heights against the truth."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from backend.devices.protocols import KnowsMirrorTruth, Rig
from backend.numerics.mirror_scoring import (
    DEFINITION,
    MirrorScore,
    MirrorTruth,
    score_mirror,
)
from backend.numerics.pinhole import RigidTransform
from backend.stages.slopes import Slopes
from backend.stages.surface import Surface


@dataclass(frozen=True)
class MeasuredMirror:
    """What a scan says of a mirror, in the frame that it found for it."""

    camera: str
    slopes: Float64[np.ndarray, "2 h w"]
    heights_mm: Float[np.ndarray, "h w"]
    mirror_from_camera: RigidTransform


def measured_mirror(slopes: Slopes | None, surface: Surface | None) -> MeasuredMirror | None:
    """Collect what a scan found; None where it measured no slopes. Without a surface all heights are unknown."""
    if slopes is None:
        return None
    name = slopes.camera
    both = np.stack([slopes.slope_x_mrad[name], slopes.slope_y_mrad[name]]).astype(np.float64)
    heights = np.full(both.shape[1:], np.nan) if surface is None else surface.height_mm[name]
    pose = slopes.mirror_from_camera
    return MeasuredMirror(name, 1e-3 * both, heights, RigidTransform(pose.R, pose.t_mm))


def known_mirror(rig: Rig, camera: str) -> MirrorTruth | None:
    """Return what the rig knows of its mirror; None if it knows nothing."""
    return rig.mirror_truth(camera) if isinstance(rig, KnowsMirrorTruth) else None


def compare_mirror(measured: MeasuredMirror, truth: MirrorTruth) -> MirrorScore:
    """Score a mirror in the frame that it was measured in: a pose that was found counts with its error."""
    return score_mirror(
        measured.slopes, measured.heights_mm, truth.in_frame(measured.mirror_from_camera)
    )


def mirror_document(score: MirrorScore | None) -> dict[str, Any]:
    """Write a score as `mirror`; nothing where there is none."""
    if score is None:
        return {}
    figures = {
        name: (value if isinstance(value, int) else round(value, 4))
        if math.isfinite(value)
        else None
        for name, value in score._asdict().items()
    }
    return {"mirror": figures | {"definition": DEFINITION}}
