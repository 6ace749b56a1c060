"""Decode fringes under bands of epipolar lines, and put them where the first fringes were spoilt."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from backend.domain.params import Params, setting
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.epipolar_bands import Best, nothing_yet, take_in
from backend.stages.band_capture import BandFrames, BandSet, lines
from backend.stages.fringe_capture import fringe_frames
from backend.stages.fringe_phase import AbsolutePhase, FringePhaseParams, fringe_phase
from backend.stages.fusion import FusionParams, fusion

_OTHER_EXPOSURE = 255
"""None of the first fringes' exposures."""


class BandPhaseParams(Params):
    """Where fringes under bands replace the first ones."""

    margin_px: float = setting(3.0, title="Distance from dark bands", unit="px", ge=0, le=50)
    """A pixel counts as lit if its line is farther from any dark band, in projector pixels: blur makes soft borders."""
    beyond_sigmas: float = setting(5.0, title="Replace beyond", unit="sigma", ge=0, le=100)
    """A first measurement is replaced if it differs by more of its noise; else it stays: it has more light."""
    beyond_px: float = setting(0.05, title="and at least", unit="px", ge=0, le=10, advanced=True)
    modulation_min_gray: float = setting(4.0, title="Least modulation", unit="gray", ge=0, le=1000)
    """Amplitude of the fringes under bands, in gray levels of the exposure used."""


@stage(title="Phase under bands", version=1, review=Review.ON_WARNING)
def band_phase(
    bands: BandFrames,
    phase: AbsolutePhase,
    calibration: RigCalibration,
    facts: RigFacts,
    params: BandPhaseParams,
    progress: Progress,
) -> AbsolutePhase:
    """Take each pixel's column from the fringes with the least light by other ways, where the first ones differ."""
    if not bands.sets:
        return phase
    found: dict[str, _Found] = {}
    for number, one in enumerate(bands.sets):
        progress(number / len(bands.sets), f"camera {one.camera}, bit {one.bit}")
        decoded = _decode(one, bands, facts, params)
        if one.camera not in found:
            found[one.camera] = _Found.nothing(decoded, lines(calibration, one.camera).camera_px)
        found[one.camera].take(decoded, one, bands, params)
    return _merged(phase, found, bands, params)


@dataclass(frozen=True)
class _Decoded:
    """One set of fringes, decoded."""

    phase: AbsolutePhase
    brightness: Float32[np.ndarray, "h w"]
    """In [gray/ms]."""


@dataclass
class _Found:
    """What the fringes under bands say of one camera so far."""

    lines_px: Float32[np.ndarray, "h w"]
    best: Best
    residual_cycles: Float32[np.ndarray, "h w"]
    modulation_gray: Float32[np.ndarray, "h w"]
    wrapped_rad: Float32[np.ndarray, "h w"]

    @classmethod
    def nothing(cls, decoded: _Decoded, lines_px: Float32[np.ndarray, "h w"]) -> "_Found":
        """Begin with maps of the decoded ones' size."""
        shape = decoded.brightness.shape
        return cls(
            lines_px,
            nothing_yet(shape),
            residual_cycles=np.full(shape, np.nan, np.float32),
            modulation_gray=np.full(shape, np.nan, np.float32),
            wrapped_rad=np.full(shape, np.nan, np.float32),
        )

    def take(
        self, decoded: _Decoded, one: BandSet, bands: BandFrames, params: BandPhaseParams
    ) -> None:
        """Take in one set of fringes."""
        phase, name = decoded.phase, one.camera
        lit = bands.bands(name).well_lit(
            self.lines_px, one.bit, inverse=one.inverse, margin_px=params.margin_px
        )
        replaced = take_in(
            self.best,
            phase.projector_px[name],
            phase.sigma_px[name],
            decoded.brightness,
            lit & (phase.reasons[name] == 0),
        )
        for target, source in (
            (self.residual_cycles, phase.residual_cycles),
            (self.modulation_gray, phase.modulation_gray),
            (self.wrapped_rad, phase.wrapped_rad),
        ):
            target[replaced] = source[name][replaced]


def _decode(one: BandSet, bands: BandFrames, facts: RigFacts, params: BandPhaseParams) -> _Decoded:
    frames = fringe_frames(bands.frames[one.first : one.first + one.count])
    fused = fusion(frames, None, None, facts, FusionParams(), _silent)
    limits = FringePhaseParams(modulation_min_gray=params.modulation_min_gray)
    return _Decoded(fringe_phase(fused, facts, limits, _silent), fused.fused[one.camera])


def _silent(done: float, text: str = "") -> None:
    """Report nothing: the stage tells which set it is at."""


def _merged(
    phase: AbsolutePhase, found: dict[str, _Found], bands: BandFrames, params: BandPhaseParams
) -> AbsolutePhase:
    """Replace what the fringes under bands contradict or complete."""
    where = {name: _spoilt(phase, name, f.best, params) for name, f in found.items()}

    def mixed(
        first: Callable[[str], np.ndarray[tuple[int, ...], np.dtype[np.generic]]],
        second: Callable[[_Found], np.ndarray[tuple[int, ...], np.dtype[np.generic]]],
    ) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]]:
        return {
            name: np.where(where[name], second(found[name]), first(name))
            if name in found
            else first(name)
            for name in phase.projector_px
        }

    sigma_px = mixed(lambda n: phase.sigma_px[n], lambda f: f.best.sigma_px)
    reasons = mixed(lambda n: phase.reasons[n], lambda f: np.zeros(f.lines_px.shape, np.uint16))
    known = np.concatenate([s[np.isfinite(s)][::7] for s in sigma_px.values()])
    return replace(
        phase,
        projector_px=mixed(lambda n: phase.projector_px[n], lambda f: f.best.projector_px),
        sigma_px=sigma_px,
        residual_cycles=mixed(lambda n: phase.residual_cycles[n], lambda f: f.residual_cycles),
        modulation_gray=mixed(lambda n: phase.modulation_gray[n], lambda f: f.modulation_gray),
        wrapped_rad=mixed(lambda n: phase.wrapped_rad[n], lambda f: f.wrapped_rad),
        exposure_index=mixed(
            lambda n: phase.exposure_index[n],
            lambda f: np.full(f.lines_px.shape, _OTHER_EXPOSURE, np.uint8),
        ),
        reasons=reasons,
        valid_share=float(np.mean([np.mean(r == 0) for r in reasons.values()])),
        median_sigma_px=float(np.median(known)) if known.size else float("nan"),
    )


def _spoilt(
    phase: AbsolutePhase, name: str, best: Best, params: BandPhaseParams
) -> Bool[np.ndarray, "h w"]:
    """Mark where the first measurement is missing or differs by more than noise."""
    first_px = phase.projector_px[name]
    allowed = params.beyond_px + params.beyond_sigmas * np.hypot(
        best.sigma_px, phase.sigma_px[name]
    )
    with np.errstate(invalid="ignore"):
        agrees = np.abs(best.projector_px - first_px) <= allowed
    return np.asarray(np.isfinite(best.projector_px) & ~agrees)
