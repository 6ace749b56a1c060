"""What a scan is worth: points, times, and against the truth where the rig knows it."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32

from backend.devices.protocols import KnowsTruth, Rig
from backend.domain.errors import UnglareError
from backend.jobs.loading import NO_RIG, LoadedScan, document_of, load_scan
from backend.numerics.mirror_scoring import MirrorScore
from backend.numerics.reasons import Reason
from backend.numerics.scoring import DEFINITION, Score, Scores, Truth, point_errors, score
from backend.services.context import Context
from backend.services.mirror_report import (
    MeasuredMirror,
    compare_mirror,
    known_mirror,
    measured_mirror,
    mirror_document,
)
from backend.stages.cloud import Cloud
from backend.stages.slopes import Slopes
from backend.stages.surface import Surface
from backend.storage.codec import decode
from backend.storage.repositories import Repositories

log = logging.getLogger(__name__)

T = TypeVar("T")

DEFINITION_OF_FIGURES = DEFINITION
"""How completeness and error are counted, for the help of whatever shows them."""


@dataclass(frozen=True)
class ScanReport:
    """Figures of one scan."""

    points: int | None
    """None: the scan has no cloud (yet)."""
    median_sigma_mm: float | None
    """Predicted uncertainty that half of the points stay below."""
    duration_s: float
    """All present results together."""
    waited_s: float
    """Of these, what was spent waiting for the rig: its exposures, or its computing where it is simulated."""
    light_s: float | None
    """Exposure time of one camera's frames, if a stage tells."""
    scores: Scores | None
    """None: nobody knows the truth."""
    mirror: MirrorScore | None = None
    """None: no mirror was measured, or nobody knows its truth."""

    @property
    def computing_s(self) -> float:
        """Own computing and storing, without waiting for the rig."""
        return max(0.0, self.duration_s - self.waited_s)

    def document(self) -> dict[str, Any]:
        """Write the figures as JSON values; what can't be said is None."""
        return {
            "points": self.points,
            "median_sigma_mm": _number(self.median_sigma_mm),
            "duration_s": round(self.duration_s, 3),
            "computing_s": round(self.computing_s, 3),
            "rig_s": round(self.waited_s, 3),
            "light_s": _number(self.light_s),
            **truth_document(self.scores),
            **mirror_document(self.mirror),
        }


def truth_document(scores: Scores | None) -> dict[str, Any]:
    """Write scores as `truth` and `parts`; nothing where nobody knows the truth."""
    if scores is None:
        return {}
    total = _score_document(scores.total) | {
        "edge_base": scores.edge_base,
        "edge_accepted": scores.edge_accepted,
        "stray": scores.stray,
        "definition": DEFINITION,
    }
    return {
        "truth": total,
        "parts": {name: _score_document(part) for name, part in scores.parts.items()},
    }


def _score_document(figures: Score) -> dict[str, Any]:
    return {name: _number(value) for name, value in figures._asdict().items()}


def _number(value: float | None) -> float | int | None:
    if value is None or not math.isfinite(value):
        return None
    return value if isinstance(value, int) else round(value, 6)


def report(context: Context, scan: str) -> ScanReport:
    """Collect the figures of a scan's present results; asks the rig for the truth if it knows it."""
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        cloud = load_cloud(context, repositories, loaded)
        mirror = measured_mirror(
            _last(context, repositories, loaded, Slopes),
            _last(context, repositories, loaded, Surface),
        )
        light_s = _light_s(repositories, loaded)
    runs = [planned.run for planned in loaded.plan.stages if planned.run]
    return ScanReport(
        points=cloud.point_count if cloud else None,
        median_sigma_mm=cloud.median_sigma_mm if cloud else None,
        duration_s=sum(run.duration_s or 0.0 for run in runs),
        waited_s=sum(run.device.get("rig", {}).get("waited_s", 0.0) for run in runs),
        light_s=light_s,
        scores=_scores(context, loaded, cloud) if cloud else None,
        mirror=_mirror_score(context, loaded, mirror) if mirror else None,
    )


def load_cloud(context: Context, repositories: Repositories, loaded: LoadedScan) -> Cloud | None:
    """Return the last cloud of a scan, mapped; None if there is none."""
    return _last(context, repositories, loaded, Cloud)


def _last(
    context: Context, repositories: Repositories, loaded: LoadedScan, kind: type[T]
) -> T | None:
    """Return the result of the last stage that makes a type, its arrays mapped; None if there is none."""
    makers = [planned for planned in loaded.plan.stages if planned.stage.output is kind]
    if not makers or makers[-1].result is None:
        return None
    found: T = decode(document_of(repositories, makers[-1].result), kind, context.store)
    return found


def compare_with_truth(cloud: Cloud, truth: Truth) -> Scores | None:
    """Score a cloud; None if its reference camera isn't the one that the truth is known for."""
    reference = reference_camera(cloud)
    reasons = cloud.reasons.get(reference)
    if cloud.depth_mm[reference].shape != truth.part.shape:
        return None
    given_up = None if reasons is None else (reasons & np.uint16(Reason.SATURATED)) != 0
    return score(cloud.points_mm, cloud.pixel_x, cloud.pixel_y, truth, over_exposed=given_up)


def error_map(cloud: Cloud, truth: Truth) -> Float32[np.ndarray, "h w"]:
    """Return the signed distance of the points behind the true surface, at their nearest pixels; NaN without one."""
    found = np.full(truth.part.size, np.nan, np.float32)
    home, error_mm = point_errors(cloud.points_mm, cloud.pixel_x, cloud.pixel_y, truth)
    found[home] = error_mm
    return found.reshape(truth.part.shape)


def reference_camera(cloud: Cloud) -> str:
    """Return the camera whose pixels the points belong to."""
    return cloud.cameras[0] if cloud.cameras else next(iter(cloud.depth_mm))


def rig_truth(
    context: Context, loaded: LoadedScan, reference: str, cameras: tuple[str, ...]
) -> Truth | None:
    """Ask the scan's rig for the truth; None if the rig didn't know it when it captured, or can't be asked now."""

    def ask(rig: Rig) -> Truth | None:
        return rig.truth(reference, cameras or None) if isinstance(rig, KnowsTruth) else None

    return _ask_rig(context, loaded, ask)


def _ask_rig(context: Context, loaded: LoadedScan, ask: Callable[[Rig], T | None]) -> T | None:
    """Ask the scan's rig something of the truth.

    Hardware is never opened for it: an old scan can be exported where its rig is long gone.
    """
    if loaded.row.rig == NO_RIG or not _knew_truth(loaded):
        return None
    try:
        return context.rigs.use(loaded.row.rig, loaded.row.rig_options, ask)
    except UnglareError as error:
        log.warning("No truth for scan %s: %s", loaded.row.id, error.sentence)
        return None


def _knew_truth(loaded: LoadedScan) -> bool:
    """Tell by what was noted of the rig when it captured."""
    told = [p.run.device.get("rig", {}) for p in loaded.plan.stages if p.run]
    return any(info.get("knows_truth", False) for info in told)


def _scores(context: Context, loaded: LoadedScan, cloud: Cloud) -> Scores | None:
    truth = rig_truth(context, loaded, reference_camera(cloud), cloud.cameras)
    return compare_with_truth(cloud, truth) if truth else None


def _mirror_score(
    context: Context, loaded: LoadedScan, mirror: MeasuredMirror
) -> MirrorScore | None:
    truth = _ask_rig(context, loaded, lambda rig: known_mirror(rig, mirror.camera))
    return compare_mirror(mirror, truth) if truth else None


def _light_s(repositories: Repositories, loaded: LoadedScan) -> float | None:
    """Sum the exposures of one camera's frames, from the journal of the present takes."""
    takes = {(p.name, p.take) for p in loaded.plan.stages if p.stage.captures}
    frames = [f for f in repositories.frames.of_scan(loaded.row.id) if (f.stage, f.take) in takes]
    if not frames:
        return None
    cameras = {f.camera for f in frames}
    return sum(float(f.metadata["exposure_us"]) for f in frames) / 1e6 / len(cameras)
