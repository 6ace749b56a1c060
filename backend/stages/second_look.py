"""A second look at pixels that see two places at once: with everything told already left dark, they see one."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from backend.domain.checks import Check
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Frames, Mask, Picture, Value
from backend.domain.params import setting
from backend.domain.patterns import WHITE, Pattern
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.code_certainty import PairGeometry, on_epipolar_line
from backend.numerics.second_look import claimed_places, possible_places, without_specks
from backend.numerics.triangulation import triangulate_projector
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_frames import CodeFrames, code_frames
from backend.stages.code_map import require_projector
from backend.stages.edges import Codes, EdgesParams, edges
from backend.stages.intensity_mask import IntensityMask
from backend.stages.pixel_response import saturation_gray
from backend.stages.rig_geometry import camera_geometry

_DEPTH_MARGIN_MM = 15.0
_SURE = 0.005
"""Share of the told pixels at either end of their depths that is left out of the range."""
_DIMMED = 0.5
_TOLD, _UNTOLD, _TOLD_NOW = 1, 2, 3
LABELS = {
    _UNTOLD: "no code that agrees with the calibration, or none at all",
    _TOLD_NOW: "told by the second look",
}


class SecondLookParams(EdgesParams):
    """When a second look is taken, and how."""

    run: Literal["auto", "yes", "no"] = setting("auto", title="Second look")
    """Auto: under a refined mask, if more lit pixels than allowed have no code that agrees with the calibration."""
    few: float = setting(0.001, title="Untold pixels allowed", ge=0, le=1)
    """Share of the lit pixels that may stay untold without a second look."""
    epipolar_px: float = setting(2.5, title="Row against epipolar line", unit="px", gt=0, le=1000)
    """A code that misses its epipolar line by more came by a second reflection."""
    trims: int = setting(4, title="Trims", ge=0, le=8, advanced=True)
    """So many times the light is halved where a pixel that matters saturates."""


@dataclass(frozen=True)
class SecondLook:
    """The same code once more, shown only where nobody looked so far."""

    factor: Annotated[Float32[np.ndarray, "h w"], Picture("Second mask", low=0.0, high=1.0)]
    """Light per projector pixel; 0 where the first look told everything."""
    untold: Annotated[Mapping[str, UInt8[np.ndarray, "_h _w"]], Mask("Untold pixels", LABELS)]
    untold_before: Annotated[float, Value("Lit pixels without a trusted code, before")]
    untold_after: Annotated[float, Value("After the second look")]
    codes: Codes | None = None
    """What the second look tells, everywhere; None: none was taken."""
    trusted: Mapping[str, Bool[np.ndarray, "_h _w"]] = field(default_factory=dict)
    """Pixels whose second code is to be used."""
    frames: Annotated[tuple[Frame, ...], Frames("Code of the second look")] = ()


def _told(result: SecondLook, params: SecondLookParams) -> Check:
    sentence = f"{result.untold_before:.2%} of the lit pixels had no trusted code"
    if result.codes is not None:
        sentence += f", {result.untold_after:.2%} after a second look"
    return Check("untold", Level.OK, sentence, result.untold_after, params.few)


@stage(title="Second look", version=1, review=Review.ON_WARNING, checks=(_told,))
def second_look(
    codes: Codes,
    frames: CodeFrames,
    mask: IntensityMask | None,
    base: BaseExposure,
    facts: RigFacts,
    calibration: RigCalibration | None,
    params: SecondLookParams,
    shoot: Shoot,
) -> SecondLook:
    """Show the code once more only where nobody looked: second reflections from bright places can't outshine it."""
    look = _Look(codes, frames, base, facts, calibration, params)
    return shoot(look.plan(_allowed(mask, params)))


def _allowed(mask: IntensityMask | None, params: SecondLookParams) -> bool:
    if params.run == "auto":
        return mask is not None and mask.round > 0
    return params.run == "yes"


def trusted_codes(
    codes: Codes, geometry: Mapping[str, PairGeometry], epipolar_px: float
) -> dict[str, Bool[np.ndarray, "_h _w"]]:
    """Tell, per camera, which codes are valid and agree with the calibration."""
    return {
        name: (codes.reasons[name] == 0)
        & on_epipolar_line(
            codes.projector_px[name], codes.projector_row_px[name], pair, tolerance_px=epipolar_px
        )
        for name, pair in geometry.items()
    }


class _Look:
    """Everything that the plan of a second look needs."""

    def __init__(
        self,
        codes: Codes,
        frames: CodeFrames,
        base: BaseExposure,
        facts: RigFacts,
        calibration: RigCalibration | None,
        params: SecondLookParams,
    ) -> None:
        self.codes, self.frames, self.base, self.facts = codes, frames, base, facts
        self.params = params
        self.projector = require_projector(facts)
        self.cameras = tuple(n for n in codes.projector_px if n in codes.projector_row_px)
        self.geometry = camera_geometry(calibration, self.cameras)
        self.trusted = trusted_codes(codes, self.geometry, params.epipolar_px)
        self.untold = {n: base.lit[n] & ~told for n, told in self.trusted.items()}

    def plan(self, allowed: bool) -> Plan[SecondLook]:
        """Light what nobody claimed, dim it where it dazzles, and capture the code."""
        places = self._places() if allowed and self._share(self.untold) > self.params.few else None
        if places is None or not places.any():
            return self._nothing()
        factor = places.astype(np.float32)
        for _ in range(self.params.trims):
            (white,) = yield (self._shot(WHITE, factor),)
            dazzled = {
                n: untold & (white[n].gray >= saturation_gray(self.facts, n))
                for n, untold in self.untold.items()
            }
            if not any(d.any() for d in dazzled.values()):
                break
            factor = np.where(self._possible(dazzled), factor * np.float32(_DIMMED), factor)
        exposed = yield tuple(self._shot(p, factor) for p in self._patterns())
        found = code_frames(tuple(frame for shot in exposed for frame in shot.values()))
        return self._result(factor, found)

    def _nothing(self) -> SecondLook:
        share = self._share(self.untold)
        return SecondLook(
            np.zeros((self.projector.height_px, self.projector.width_px), np.float32),
            {n: np.where(u, np.uint8(_UNTOLD), np.uint8(0)) for n, u in self.untold.items()},
            share,
            share,
        )

    def _shot(self, pattern: Pattern, factor: Float32[np.ndarray, "h w"]) -> Shot:
        return Shot(
            pattern,
            self.base.exposure_ms,
            self.base.gain_db,
            self.cameras,
            role="second look",
            mask=InMemory(factor),
        )

    def _patterns(self) -> tuple[Pattern, ...]:
        """Return the patterns of the first look in their order."""
        first = self.frames.frames[0].camera
        return tuple(f.pattern for f in self.frames.frames if f.camera == first)

    def _places(self) -> Bool[np.ndarray, "h w"]:
        """Mark what is possible for an untold pixel and claimed by no told one."""
        claimed = np.zeros((self.projector.height_px, self.projector.width_px), bool)
        nan = np.float32(np.nan)
        for name, told in self.trusted.items():
            claimed |= claimed_places(
                np.where(told, self.codes.projector_px[name], nan),
                np.where(told, self.codes.projector_row_px[name], nan),
                width_px=self.projector.width_px,
                height_px=self.projector.height_px,
            )
        return without_specks(self._possible(self.untold) & ~claimed)

    def _possible(self, pixels: Mapping[str, Bool[np.ndarray, "_h _w"]]) -> Bool[np.ndarray, "h w"]:
        places = np.zeros((self.projector.height_px, self.projector.width_px), bool)
        for name, wanted in pixels.items():
            near_mm, far_mm = self._depths_mm(name)
            if near_mm < far_mm:
                places |= possible_places(
                    wanted, self.geometry[name], near_mm=near_mm, far_mm=far_mm
                )
        return places

    def _depths_mm(self, name: str) -> tuple[float, float]:
        """Return between which depths surfaces are: those of the pixels told, and a little more."""
        pair = self.geometry[name]
        points_mm = triangulate_projector(self.codes.projector_px[name], *pair).points_mm
        depth_mm = points_mm[self.trusted[name], 2]
        if not depth_mm.size:
            return 0.0, 0.0
        near, far = np.quantile(depth_mm[:: max(1, depth_mm.size // 100_000)], [_SURE, 1 - _SURE])
        return max(1.0, float(near) - _DEPTH_MARGIN_MM), float(far) + _DEPTH_MARGIN_MM

    def _share(self, pixels: Mapping[str, Bool[np.ndarray, "_h _w"]]) -> float:
        lit = sum(int(np.count_nonzero(self.base.lit[n])) for n in pixels)
        return sum(int(np.count_nonzero(p)) for p in pixels.values()) / max(1, lit)

    def _result(self, factor: Float32[np.ndarray, "h w"], found: CodeFrames) -> SecondLook:
        codes = edges(found, IntensityMask(factor), self.facts, self.params, _silent)
        again = trusted_codes(codes, self.geometry, self.params.epipolar_px)
        trusted = {n: again[n] & self.untold[n] & _lit_places(codes, n, factor) for n in again}
        left = {n: u & ~trusted[n] for n, u in self.untold.items()}
        return SecondLook(
            factor,
            {
                n: np.where(
                    trusted[n], np.uint8(_TOLD_NOW), np.where(u, np.uint8(_UNTOLD), np.uint8(0))
                )
                for n, u in left.items()
            },
            self._share(self.untold),
            self._share(left),
            codes,
            trusted,
            found.frames,
        )


def _lit_places(
    codes: Codes, name: str, factor: Float32[np.ndarray, "hp wp"]
) -> Bool[np.ndarray, "h w"]:
    """Tell which pixels' codes are places that were lit at all: others are read from scattered light."""
    columns, rows = (
        np.nan_to_num(m[name] + np.float32(0.5)).astype(np.intp)
        for m in (codes.projector_px, codes.projector_row_px)
    )
    height, width = factor.shape
    return np.asarray(factor[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] > 0)


def _silent(done: float, text: str = "") -> None:
    """Report to nobody: the shots have told how far the stage is."""
