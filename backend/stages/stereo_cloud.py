"""From absolute phase to points: matching two cameras (or camera and projector), triangulation, filters."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float32, UInt16

from backend.domain.errors import StageFailedError
from backend.domain.params import Params, setting
from backend.domain.rig import RigCalibration
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics import filters
from backend.numerics.camera_model import Pinhole, RigidTransform
from backend.numerics.confirmation import settle
from backend.numerics.drift import take_off_drift
from backend.numerics.filters import Kept
from backend.numerics.gathering import gather
from backend.numerics.matching import MatchSettings, match
from backend.numerics.normals import normal_limit
from backend.numerics.reasons import Reason
from backend.numerics.rectification import Rectification, rectify
from backend.numerics.triangulation import (
    Cloud as OrganisedCloud,
)
from backend.numerics.triangulation import (
    depth_consistency,
    triangulate_pair,
    triangulate_projector,
)
from backend.stages.cloud import Cloud, FilterRow, colour_of, enough_points, precise_enough
from backend.stages.fringe_phase import AbsolutePhase
from backend.stages.pre_exposure import Preview
from backend.stages.rig_geometry import (
    from_reference,
    pinhole,
    projector_from_reference,
    require_camera,
)

Geometry = Literal["stereo", "projector"]
Box = Annotated[tuple[float, float, float, float, float, float], "x, y, z from; x, y, z to"]


NOISE_SIGMAS = 5.0
"""What phase noise explains of a contradiction with the projector."""

SPREADS = 4.0
LEAST_SPREAD_PX = 0.06
"""Contradiction that is always allowed, and that of the scene itself: what calibration leaves after its drift."""


RESIDUAL_MAX_CYCLES = 0.015
"""Disagreement of the frequencies that noise rarely reaches and a second reflection usually exceeds."""

PIXELS_PER_SPECK = 20_000
"""A patch of fewer than this part of all pixels is chance, not surface."""


class StereoCloudParams(Params):
    """How points are made and which are kept."""

    geometry: Geometry | None = setting(None, title="Points from", auto=None)
    """stereo: two cameras; projector: reference camera and calibrated projector. Automatic: two cameras where
    there are two."""
    agreement_px: float = setting(2.0, title="Left-right agreement", unit="px", gt=0, le=50)
    """A partner has to lead back to within this distance."""
    jump_px: float | None = setting(
        None, title="Jump between neighbours", unit="px", gt=0, le=500, advanced=True
    )
    """Neighbours whose projector coordinate differs by more are not one surface. Automatic: 5 median steps."""
    settle_by_projector: bool = setting(True, title="Settle doubts by the projector")
    """Where the match is ambiguous and the projector is calibrated, take the place that all three agree on."""
    check_by_projector: bool = setting(True, title="Check by the projector")
    """Remove points whose place in the calibrated projector contradicts the measured coordinate: second
    reflections and mixed pixels. A smooth drift of the projector's calibration is taken off first."""
    consistency_px: float | None = setting(
        None,
        title="Contradiction allowed",
        unit="px",
        gt=0,
        le=100,
        auto="consistency_px",
        advanced=True,
    )
    """Beyond 5 sigma of noise. Automatic: 4 times the scene's own spread, at least 0.06 px."""
    residual_max_cycles: float | None = setting(
        None,
        title="Contradiction of the frequencies",
        unit="cycles",
        gt=0,
        le=0.5,
        auto="residual_max_cycles",
    )
    """Points whose frequencies disagree by more are second reflections. Automatic: 0.015 where no projector
    can check them, else no limit here."""
    outlier_sigmas: float = setting(6.0, title="Outliers beyond", unit="sigma", ge=0, le=100)
    """Points so far from the median of their 5x5 neighbourhood, and alone there, are removed; 0 = off."""
    speck_px: int | None = setting(
        None, title="Smallest patch", unit="px", ge=0, le=100_000, auto="speck_px"
    )
    """Connected patches of fewer pixels are removed; 0 = off. Automatic: one in 20 000 of the picture's pixels."""
    sigma_max_mm: float | None = setting(
        None, title="Largest uncertainty", unit="mm", gt=0, le=1000
    )
    box_mm: Box | None = setting(None, title="Clipping box", unit="mm")
    """x, y, z from, then to, in the reference camera's frame; empty: everything."""


@stage(title="Cloud", version=2, review=Review.ALWAYS, checks=(enough_points, precise_enough))
def stereo_cloud(
    phase: AbsolutePhase,
    calibration: RigCalibration,
    preview: Preview | None,
    params: StereoCloudParams,
    progress: Progress,
) -> Cloud:
    """Match the cameras along epipolar lines, triangulate, and filter: one point per pixel of the reference."""
    scene = _Scene.of(phase, calibration, params)
    progress(0.1, "matching")
    raw = scene.stereo() if scene.other is not None else scene.from_projector()
    progress(0.6, "filters")
    rows = [scene.apply(*step, raw) for step in scene.filters(raw)]
    progress(0.8, "normals")
    brightness = None if preview is None else preview.rate_gray_per_ms.get(calibration.reference)
    return scene.cloud(raw, tuple(rows), brightness)


@dataclass
class _Raw:
    """The organised cloud while filters work on it."""

    points: OrganisedCloud
    reasons: UInt16[np.ndarray, "h w"]
    consistency_px: float = float("nan")
    """Contradiction with the projector that was allowed; NaN if it wasn't checked."""

    @property
    def depth_mm(self) -> Float32[np.ndarray, "h w"]:
        """Depth of each pixel's point; NaN where there is none."""
        return self.points.depth_mm


_Filter = Callable[[_Raw], Kept]


@dataclass(frozen=True)
class _Scene:
    """The maps and devices that take part."""

    phase: AbsolutePhase
    calibration: RigCalibration
    params: StereoCloudParams
    name: str
    camera: Pinhole
    other: str | None
    """Name of the second camera; None: the projector takes its part."""
    projector: Pinhole | None
    projector_from_camera: RigidTransform | None

    @classmethod
    def of(
        cls, phase: AbsolutePhase, calibration: RigCalibration, params: StereoCloudParams
    ) -> "_Scene":
        """Choose the geometry, or say what is missing for it."""
        name = calibration.reference
        maps = phase.projector_px or phase.projector_row_px
        if name not in maps:
            raise StageFailedError(
                f"The reference camera {name!r} has no phase (there is one of: {', '.join(maps)}): capture it too."
            )
        others = [n for n in phase.projector_px if n != name and n in calibration.cameras]
        projector_pose = projector_from_reference(calibration)
        geometry = params.geometry or ("stereo" if others else "projector")
        if geometry == "stereo" and not others:
            raise StageFailedError(
                "Stereo needs a second calibrated camera: choose points from the projector."
            )
        if geometry == "projector" and projector_pose is None:
            raise StageFailedError(
                "Points from one camera need a calibrated projector: calibrate it or capture with two cameras."
            )
        projector = (
            None
            if projector_pose is None or calibration.projector is None
            else pinhole(calibration.projector)
        )
        return cls(
            phase=phase,
            calibration=calibration,
            params=params,
            name=name,
            camera=require_camera(calibration, name),
            other=others[0] if geometry == "stereo" else None,
            projector=projector,
            projector_from_camera=projector_pose,
        )

    def stereo(self) -> _Raw:
        """Match and triangulate two cameras; settle doubtful matches by the projector."""
        assert self.other is not None, "stereo was chosen because there is one"
        other = require_camera(self.calibration, self.other)
        pose = from_reference(self.calibration, self.calibration.camera_from_world[self.other])
        rectification = rectify(self.camera, other, pose)
        matches = match(
            self.phase.projector_px[self.name],
            self.phase.projector_px[self.other],
            rectification,
            sigma_reference_px=self.phase.sigma_px[self.name],
            sigma_other_px=self.phase.sigma_px[self.other],
            settings=MatchSettings(self.params.jump_px, self.params.agreement_px),
        )
        points = triangulate_pair(matches, rectification)
        raw = _Raw(points, self.phase.reasons[self.name] | matches.reasons)
        if self.params.settle_by_projector:
            self._settle(raw, rectification)
        return raw

    def from_projector(self) -> _Raw:
        """Intersect the reference camera's rays with the planes of the projector's columns (or rows)."""
        rows = self.name not in self.phase.projector_px
        assert self.projector is not None
        assert self.projector_from_camera is not None
        maps = self.phase.projector_row_px if rows else self.phase.projector_px
        sigma = self.phase.sigma_row_px if rows else self.phase.sigma_px
        points = triangulate_projector(
            maps[self.name],
            self.camera,
            self.projector,
            self.projector_from_camera,
            sigma_projector_px=sigma[self.name],
            rows=rows,
        )
        reasons = self.phase.reasons[self.name].copy()
        missing = (reasons == 0) & ~filters.valid_points(points.depth_mm)
        reasons[missing] |= np.uint16(Reason.NO_MATCH)
        return _Raw(points, reasons)

    def _settle(self, raw: _Raw, rectification: Rectification) -> None:
        """Take the projector's word for pixels without a clear partner, where the other camera confirms it."""
        if self.projector is None or self.projector_from_camera is None or self.other is None:
            return
        settle(
            raw.points,
            raw.reasons,
            self.phase.projector_px[self.name],
            self.phase.sigma_px[self.name],
            self.phase.projector_px[self.other],
            rectification,
            self.projector,
            self.projector_from_camera,
        )

    def filters(self, raw: _Raw) -> list[tuple[str, Reason, _Filter]]:
        """List the filters that are switched on, in the order of their application."""
        p = self.params
        angle = filters.pixel_angle(self.camera.K)
        steps: list[tuple[str, Reason, _Filter]] = []
        if p.check_by_projector and self._checks_projector():
            steps.append(("contradicts the projector", Reason.EPIPOLAR, self._consistent))
        if np.isfinite(self.residual_max_cycles):
            steps.append(("contradicting frequencies", Reason.ORDER_RESIDUAL, self._undisputed))
        if p.sigma_max_mm is not None:
            limit = p.sigma_max_mm
            steps.append(
                (
                    "too uncertain",
                    Reason.OUTLIER,
                    lambda r: filters.within_limits(r.depth_mm, r.points.sigma_mm, highest=limit),
                )
            )
        if p.box_mm is not None:
            box = p.box_mm
            steps.append(
                (
                    "outside the box",
                    Reason.CLIPPED,
                    lambda r: filters.within_box(r.depth_mm, r.points.rays, box[:3], box[3:]),
                )
            )
        if p.outlier_sigmas > 0:
            steps.append(
                (
                    "outliers",
                    Reason.OUTLIER,
                    lambda r: filters.without_outliers(
                        r.depth_mm,
                        sigma_mm=r.points.sigma_mm,
                        pixel_angle_rad=angle,
                        factor=p.outlier_sigmas,
                    ),
                )
            )
        least_pixels = self.speck_px
        if least_pixels > 1:
            steps.append(
                (
                    "specks",
                    Reason.OUTLIER,
                    lambda r: filters.without_specks(
                        r.depth_mm, least_pixels=least_pixels, pixel_angle_rad=angle
                    ),
                )
            )
        return steps

    @property
    def speck_px(self) -> int:
        """Smallest patch that is kept."""
        if self.params.speck_px is not None:
            return self.params.speck_px
        return int(self.camera.width_px * self.camera.height_px / PIXELS_PER_SPECK)

    def _checks_projector(self) -> bool:
        """Tell whether the projector has something to add to what the points were made from."""
        return self.projector is not None and (
            self.other is not None or bool(self.phase.projector_row_px)
        )

    @property
    def residual_max_cycles(self) -> float:
        """Largest disagreement of the frequencies; infinite if that isn't judged here."""
        if self.params.residual_max_cycles is not None:
            return self.params.residual_max_cycles
        checked = self.params.check_by_projector and self._checks_projector()
        return float("inf") if checked else RESIDUAL_MAX_CYCLES

    def _undisputed(self, raw: _Raw) -> Kept:
        residual = self.phase.residual_cycles[self.name]
        return filters.within_limits(raw.depth_mm, residual, highest=self.residual_max_cycles)

    def _consistent(self, raw: _Raw) -> Kept:
        assert self.projector is not None
        assert self.projector_from_camera is not None
        rows = self.other is None
        maps = self.phase.projector_row_px if rows else self.phase.projector_px
        sigma = (self.phase.sigma_row_px if rows else self.phase.sigma_px)[self.name]
        contradiction = depth_consistency(
            raw.points, maps[self.name], self.projector, self.projector_from_camera, rows=rows
        )
        take_off_drift(contradiction)
        limit_px = raw.consistency_px = self.params.consistency_px or _usual_spread(contradiction)
        return filters.within_limits(
            raw.depth_mm,
            contradiction,
            lowest=-limit_px,
            highest=limit_px,
            sigma=sigma,
            sigmas=NOISE_SIGMAS,
        )

    def apply(self, title: str, reason: Reason, keep: _Filter, raw: _Raw) -> FilterRow:
        """Apply one filter: remove its points and note why."""
        kept = keep(raw)
        if kept.removed:
            raw.reasons[filters.remove(raw.depth_mm, kept)] |= np.uint16(reason)
        return FilterRow(title, kept.removed)

    def cloud(
        self, raw: _Raw, rows: tuple[FilterRow, ...], brightness: Float32[np.ndarray, "h w"] | None
    ) -> Cloud:
        """Gather the points that are left."""
        points = gather(
            raw.points,
            self.phase.exposure_index[self.name],
            brightness,
            normal_limit=normal_limit(self.camera),
        )
        count = len(points.points_mm)
        if count == 0:
            raise StageFailedError(
                "No point is left: look at why pixels are missing, and loosen the filter or limit that removes most."
            )
        decoded = int(np.count_nonzero(self.phase.reasons[self.name] == 0))
        return Cloud(
            points_mm=points.points_mm,
            normals=points.normals,
            colour=colour_of(points.brightness, count),
            sigma_mm=points.sigma_mm,
            pixel_x=points.pixel_x,
            pixel_y=points.pixel_y,
            exposure_index=points.exposure_index,
            depth_mm={self.name: raw.depth_mm},
            reasons={self.name: raw.reasons},
            removed=rows,
            point_count=count,
            median_sigma_mm=float(np.median(points.sigma_mm[:: max(1, count // 100_000)])),
            kept_share=count / max(decoded, 1),
            cameras=(self.name,) if self.other is None else (self.name, self.other),
            consistency_px=raw.consistency_px,
            speck_px=self.speck_px,
            residual_max_cycles=self.residual_max_cycles,
        )


def _usual_spread(contradiction_px: Float32[np.ndarray, "h w"]) -> float:
    some = contradiction_px.ravel()[:: max(1, contradiction_px.size // 100_000)]
    known = np.abs(some[np.isfinite(some)])
    spread_px = 1.4826 * float(np.median(known)) if known.size else 0.0
    return max(SPREADS * spread_px, LEAST_SPREAD_PX)
