"""Refine the mask: find where each pixel really looks, under the mask so far, and make the mask anew there."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float32, Integer, UInt8

from backend.domain.arrays import LoadArray
from backend.domain.checks import Check, at_least, at_most
from backend.domain.frames import InMemory
from backend.domain.params import setting
from backend.domain.patterns import WHITE, Pattern, Stripe
from backend.domain.rig import ProjectorFacts, RigCalibration, RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.intensity_mask import Need, light_at
from backend.numerics.unqualified import count_shares, judge_pixels
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_map import (
    CodeMap,
    CodeShots,
    code_map_plan,
    code_patterns,
    least_contrast_gray,
    require_projector,
    shorter_ms,
)
from backend.stages.intensity_mask import IntensityMask, MaskRound
from backend.stages.mask_making import (
    MaskParams,
    View,
    gather,
    least_light,
    not_too_dark,
    pixel_need,
    served_cameras,
    shown_factor,
    touched_up,
)
from backend.stages.pixel_response import PixelResponse, saturation_gray
from backend.stages.rig_geometry import camera_geometry

_STRIPE_PX = 8
"""Period of the stripes that tell whether a pixel has contrast enough to be decoded."""
_TOO_BRIGHT = 0.6
"""A pixel that saturates under the mask gets so much of its light next: how far it is over isn't known."""
_BRIGHT_ENOUGH = 0.15
"""A pixel that reaches this share of its target needs no more light."""
_A_LITTLE_OVER = 1.08
_MOST_RAISE = 1.5
"""No trim raises a pixel's light by more."""
_SHORTER = 8.0
"""Where much saturates the code is captured again, so many times shorter."""
_FEW = 2e-3


class RefineParams(MaskParams):
    """When the mask is refined, and how."""

    run: Literal["auto", "yes", "no"] = setting("auto", title="Refine")
    """Auto: if more pixels than allowed are unqualified under the mask so far, or nobody has tried it yet."""
    enough: float = setting(0.005, title="Unqualified pixels allowed", ge=0, le=1)
    """Share of the lit pixels that may be over- or under-exposed before the mask is refined."""
    dilation_px: float = setting(1.5, title="Dark regions widened by", unit="px", ge=0, le=50)
    """Places are known to a pixel or so."""
    trims: int = setting(2, title="Trims", ge=0, le=8)
    """So many times the new mask is shown with a white field and corrected by what comes back: dimmed
    highlights no longer brighten their neighbours, and blur dims what is beside them."""
    shorter: int = setting(2, title="Shorter exposures at most", ge=0, le=4, advanced=True)
    """Where much saturates under the mask so far (always without a table), the code is captured again at
    exposures that are 8, 64 ... times shorter."""
    min_contrast_gray: float | None = setting(
        None, title="Least contrast", unit="gray", ge=0, le=65535, advanced=True
    )
    """Stripes that differ by less are under-exposed. Automatic: five standard deviations of dark noise."""


def _served(result: IntensityMask, params: RefineParams) -> Check:
    if not np.isfinite(result.unqualified_share):
        return at_most("unqualified", 0.0, warning=1, failure=1, sentence="the mask wasn't tried")
    return at_most(
        "unqualified", result.unqualified_share, warning=max(0.02, params.enough), failure=0.5,
        sentence=f"{result.unqualified_share:.2%} of the lit pixels are over- or under-exposed",
    )  # fmt: skip


def _placed(result: IntensityMask, params: RefineParams) -> Check:
    if not np.isfinite(result.known_share):
        return at_least("places known", 1.0, warning=0, failure=0, sentence="no place was measured")
    return at_least(
        "places known", result.known_share, warning=0.8, failure=0.02,
        sentence=f"the place of {result.known_share:.1%} of the lit pixels is known",
        remedy="allow shorter exposures, or lengthen the base exposure if they are too dark",
    )  # fmt: skip


@stage(
    title="Refinement",
    version=1,
    review=Review.ON_WARNING,
    checks=(_served, _placed, not_too_dark),
)
def refine(
    mask: IntensityMask,
    response: PixelResponse,
    base: BaseExposure,
    facts: RigFacts,
    calibration: RigCalibration | None,
    params: RefineParams,
    shoot: Shoot,
    load: LoadArray,
) -> IntensityMask:
    """Decode where every pixel looks under the mask so far, make the mask anew there, and try it."""
    work = _Refinement(mask, response, base, facts, calibration, params, load)
    if _wanted(mask, params):
        return shoot(work.plan())
    factor = touched_up(mask.factor, params, load)
    return mask if np.array_equal(factor, mask.factor) else shoot(work.touch_up_plan(factor))


def _wanted(mask: IntensityMask, params: RefineParams) -> bool:
    if params.run != "auto":
        return params.run == "yes"
    return not mask.unqualified_share <= params.enough


@dataclass(frozen=True)
class _Trial:
    """How the scene looks under a mask."""

    white: Mapping[str, Integer[np.ndarray, "_h _w"]]
    contrast_gray: Mapping[str, Float32[np.ndarray, "_h _w"]]
    """Difference of bright and dark stripes."""


class _Refinement:
    """One refinement: everything that its plan needs."""

    def __init__(
        self,
        mask: IntensityMask,
        response: PixelResponse,
        base: BaseExposure,
        facts: RigFacts,
        calibration: RigCalibration | None,
        params: RefineParams,
        load: LoadArray,
    ) -> None:
        self.mask, self.response, self.base, self.facts = mask, response, base, facts
        self.params, self.load = params, load
        self.projector = require_projector(facts)
        self.cameras = served_cameras(facts, params)
        self.geometry = camera_geometry(calibration, self.cameras)

    def plan(self) -> Plan[IntensityMask]:
        """Try the mask so far, decode under it, make it anew, correct it by what comes back, try it."""
        rounds = list(self.mask.rounds)
        before = yield from self._try(self.mask.factor)
        needs = self._response_needs()
        response_most = _most(needs)
        if not rounds:
            frames = 1 + len(_stripes(self.projector))
            rounds.append(self._round(_name(self.mask), before, response_most, frames))
        exposures_ms = yield from self._exposures(before)
        maps = yield from code_map_plan(self.facts, self._code_shots(exposures_ms))
        factor = self._gather(needs, maps)
        for _ in range(self.params.trims):
            (white,) = yield (self._shot(WHITE, factor),)
            seen = {name: white[name].gray for name in self.cameras}
            needs = {
                name: self._trimmed(name, needs[name], seen[name], factor, maps[name])
                for name in self.cameras
            }
            factor = self._gather(needs, maps)
        factor = touched_up(factor, self.params, self.load)
        after = yield from self._try(factor)
        codes = len(exposures_ms) * len(code_patterns(self.projector))
        frames = codes + self.params.trims + 1 + len(_stripes(self.projector))
        name = f"refinement {self.mask.round + 1}"
        rounds.append(self._round(name, after, response_most, frames))
        return self._result(factor, after, maps, _most(needs), tuple(rounds))

    def touch_up_plan(self, factor: Float32[np.ndarray, "h w"]) -> Plan[IntensityMask]:
        """Only try what the operator changed."""
        trial = yield from self._try(factor)
        most = _most(self._response_needs())
        row = self._round("by hand", trial, most, 1 + len(_stripes(self.projector)))
        return replace(
            self.mask,
            factor=factor,
            unqualified_share=row.unqualified_share,
            rounds=(*self.mask.rounds, row),
            white=trial.white,
            unqualified=self._labels(trial, None),
            mean_factor=float(factor.mean()),
        )

    # what is captured

    def _shot(
        self, pattern: Pattern, factor: Float32[np.ndarray, "h w"], times: float = 1.0
    ) -> Shot:
        exposure_ms = (
            shorter_ms(self.base.exposure_ms, times, self.facts)
            if times > 1
            else self.base.exposure_ms
        )
        return Shot(
            pattern,
            exposure_ms,
            self.base.gain_db,
            self.cameras,
            role="mask",
            mask=InMemory(factor),
        )

    def _code_shots(self, exposures_ms: tuple[float, ...]) -> CodeShots:
        return CodeShots(
            exposures_ms,
            self.base.gain_db,
            self.cameras,
            InMemory(self.mask.factor),
            self.params.min_contrast_gray,
            self.base.lit,
            self.geometry,
        )

    def _try(self, factor: Float32[np.ndarray, "h w"]) -> Plan[_Trial]:
        stripes = _stripes(self.projector)
        white, *striped = yield tuple(self._shot(p, factor) for p in (WHITE, *stripes))
        contrast = {}
        for name in self.cameras:
            pictures = [shot[name].gray.astype(np.float32) for shot in striped]
            pairs = [np.abs(a - b) for a, b in zip(pictures[::2], pictures[1::2], strict=True)]
            contrast[name] = np.asarray(np.maximum.reduce(pairs))
        return _Trial({name: white[name].gray for name in self.cameras}, contrast)

    def _exposures(self, before: _Trial) -> Plan[tuple[float, ...]]:
        """List the exposures of the code: shorter and shorter, until hardly a pixel saturates."""
        exposures_ms = [self.base.exposure_ms]
        seen = before.white
        for number in range(1, self.params.shorter + 1):
            shot = self._shot(WHITE, self.mask.factor, _SHORTER**number)
            if self._saturated_share(seen) <= _FEW or shot.exposure_ms >= exposures_ms[-1]:
                break
            exposures_ms.append(shot.exposure_ms)
            (white,) = yield (shot,)
            seen = {name: white[name].gray for name in self.cameras}
        return tuple(exposures_ms)

    def _saturated_share(self, white: Mapping[str, Integer[np.ndarray, "_h _w"]]) -> float:
        shares = [
            float(np.mean(gray[self.base.lit[name]] >= saturation_gray(self.facts, name)))
            for name, gray in white.items()
            if self.base.lit[name].any()
        ]
        return max(shares, default=0.0)

    # what is made of it

    def _response_needs(self) -> dict[str, Need]:
        return {
            name: pixel_need(
                name,
                self.response,
                self.base,
                self.facts.cameras[name],
                self.projector,
                self.params,
            )
            for name in self.cameras
        }

    def _gather(
        self, needs: Mapping[str, Need], maps: Mapping[str, CodeMap]
    ) -> Float32[np.ndarray, "h w"]:
        return gather(
            [View(needs[name], maps[name]) for name in self.cameras],
            self.projector,
            dilation_px=self.params.dilation_px,
            smoothing_px=self.params.smoothing_px,
        )

    def _trimmed(
        self,
        name: str,
        need: Need,
        white: Integer[np.ndarray, "h w"],
        factor: Float32[np.ndarray, "hp wp"],
        places: CodeMap,
    ) -> Need:
        """Correct what a pixel can take by what it returned under the mask: I - b = k M P with a new k."""
        camera = self.facts.cameras[name]
        given = light_at(
            shown_factor(factor, self.projector), places.projector_px, places.projector_row_px
        )
        black = self.base.black[name].astype(np.float32)
        signal = np.maximum(white - black, np.float32(1))
        room = np.float32(self.params.target * camera.full_scale_gray) - black
        saturated = white >= saturation_gray(self.facts, name)
        change = np.where(saturated, np.float32(_TOO_BRIGHT), room / signal)
        # Within the range nothing changes: corrections of what will do are only noise, and two places that
        # light each other would take turns at outshining the other.
        dim = signal < np.float32(_BRIGHT_ENOUGH) * room
        change = np.where(
            dim, np.minimum(change * np.float32(_BRIGHT_ENOUGH), np.float32(_MOST_RAISE)), change
        )
        fits = ~saturated & ~dim & (signal <= room * np.float32(_A_LITTLE_OVER))
        low = np.float32(least_light(self.projector, self.params))
        most = np.where(places.known & ~fits, np.clip(given * change, low, 1), need.most)
        # Never far above what the unmasked scene said: that light is needed for one pixel and blinds others.
        most = np.minimum(most, need.most * np.float32(_MOST_RAISE))
        return Need(np.asarray(most, np.float32), need.least)

    # what is told

    def _labels(
        self, trial: _Trial, maps: Mapping[str, CodeMap] | None
    ) -> dict[str, UInt8[np.ndarray, "_h _w"]]:
        return {
            name: judge_pixels(
                trial.white[name],
                trial.contrast_gray[name],
                self.base.lit[name],
                maps[name].known if maps else None,
                saturation_gray=saturation_gray(self.facts, name),
                min_contrast_gray=self.params.min_contrast_gray
                or least_contrast_gray(self.facts.cameras[name]),
            )
            for name in self.cameras
        }

    def _round(
        self,
        name: str,
        trial: _Trial,
        most: Mapping[str, Float32[np.ndarray, "_h _w"]],
        frames: int,
    ) -> MaskRound:
        shares = count_shares(self._labels(trial, None), self.base.lit, most)
        return MaskRound(name, *shares, frames=frames)

    def _result(
        self,
        factor: Float32[np.ndarray, "h w"],
        trial: _Trial,
        maps: Mapping[str, CodeMap],
        most: Mapping[str, Float32[np.ndarray, "_h _w"]],
        rounds: tuple[MaskRound, ...],
    ) -> IntensityMask:
        lit = sum(int(np.count_nonzero(self.base.lit[n])) for n in self.cameras)
        known = sum(int(np.count_nonzero(self.base.lit[n] & maps[n].known)) for n in self.cameras)
        return IntensityMask(
            factor=factor,
            round=self.mask.round + 1,
            unqualified_share=rounds[-1].unqualified_share,
            rounds=rounds,
            white=trial.white,
            unqualified=self._labels(trial, maps),
            proper=most,
            projector_px={name: m.projector_px for name, m in maps.items()},
            projector_row_px={name: m.projector_row_px for name, m in maps.items()},
            known_share=known / max(1, lit),
            dilation_px=self.params.dilation_px,
            mean_factor=float(factor.mean()),
        )


def _most(needs: Mapping[str, Need]) -> dict[str, Float32[np.ndarray, "_h _w"]]:
    return {name: need.most for name, need in needs.items()}


def _name(mask: IntensityMask) -> str:
    """Name the mask that came in."""
    if mask.round:
        return f"refinement {mask.round}"
    return "no mask" if float(mask.factor.min()) == 1.0 else "first mask"


def _stripes(projector: ProjectorFacts) -> tuple[Pattern, ...]:
    """Return stripes and their inverse, twice, a quarter of a period apart: each pixel is well inside one of them."""
    periods = projector.width_px / _STRIPE_PX
    return tuple(
        Stripe(periods=periods, shift_periods=shift, inverse=inverse)
        for shift in (0.0, 0.25)
        for inverse in (False, True)
    )
