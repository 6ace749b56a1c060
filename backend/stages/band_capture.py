"""Capture fringes again with part of the epipolar lines lit at a time, where second reflections spoilt the first ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int64

from backend.domain.checks import Check
from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Frames, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import Pattern
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import OneOf, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.epipolar_bands import Bands, EpipolarLines, bands_around, epipolar_lines
from backend.stages.base_exposure import BaseExposure
from backend.stages.cloud import Cloud
from backend.stages.exposures import Exposures
from backend.stages.fringe_phase import AbsolutePhase
from backend.stages.pixel_response import PixelResponse
from backend.stages.pre_exposure import ExposureGrid
from backend.stages.rig_geometry import pair_geometry

_NO_EXPOSURE = 255
_SAMPLE = 2000
_BRIGHTEST = 0.95
"""Quantile of the doubtful pixels' response that the exposure is made for."""
_FULL = 0.9
"""Share of the full scale that it reaches then."""


class BandCaptureParams(Params):
    """Whether and how finely the projector's lines are told apart."""

    run: Literal["auto", "yes", "no"] = setting("auto", title="Light bands")
    """Auto: if more pixels than allowed have a phase but no point."""
    enough: float = setting(0.01, title="Doubtful pixels allowed", ge=0, le=1)
    """Share of the pixels with a phase that may have no point before bands are lit."""
    bits: int = setting(5, title="Bits of the bands' numbers", ge=1, le=8)
    """2^bits bands; each bit takes two sets of fringes per camera, one with the bands whose bit is 1, one
    with the others. More bits separate reflections from nearer places."""
    budget_s: float = setting(30.0, title="Time budget", unit="s", gt=0, le=3600)
    """Light time of all fringes under bands."""
    exposures_ms: tuple[float, ...] | None = setting(
        None, title="Exposures", unit="ms", auto="exposures_ms", min_length=1, max_length=8
    )
    """Automatic: one at which the doubtful pixels are bright under full light, as their response tells (else the one of
    the first fringes that served most of them), as far as the time budget allows."""
    snap: bool = setting(True, title="Whole projector frames", advanced=True)
    """Use multiples of the projector's frame period, so that its modulation averages out."""
    gain_db: float = setting(0.0, title="Camera gain", unit="dB", ge=0, le=48)
    cameras: Literal["all", "reference"] = setting("all", title="Cameras", advanced=True)
    """Every camera has epipolar lines of its own, and so takes as many fringes again."""


@dataclass(frozen=True)
class BandSet:
    """Which lines of a camera were lit in one set of fringes."""

    camera: str
    bit: int
    inverse: bool
    first: int
    """Its first frame."""
    count: int


@dataclass(frozen=True)
class BandFrames:
    """Fringes under bands of epipolar lines, of one camera after the other."""

    frames: Annotated[tuple[Frame, ...], Frames("Fringes under bands")]
    sets: tuple[BandSet, ...]
    """Empty if bands weren't needed."""
    low_px: Mapping[str, float]
    """Per camera, where the first band begins, see `numerics.epipolar_bands`."""
    width_px: Mapping[str, float]
    bits: int
    exposures_ms: tuple[float, ...]
    frame_count: Annotated[int, Value("Frames")]
    exposure_time_s: Annotated[float, Value("Exposure time in all", unit="s")]
    """Of all frames: cameras take turns."""
    doubtful_share: Annotated[float, Value("Pixels with a phase but no point")]

    def bands(self, camera: str) -> Bands:
        """Return a camera's bands."""
        return Bands(self.low_px[camera], self.width_px[camera], self.bits)


def _complete(result: BandFrames, params: BandCaptureParams) -> Check:
    if not result.sets:
        sentence = f"no bands: {result.doubtful_share:.2%} of the pixels with a phase have no point"
    else:
        sentence = f"{result.frame_count} frames under {2**result.bits} bands captured"
    return Check("bands", Level.OK, sentence, float(result.frame_count))


@stage(title="Bands", version=1, review=Review.ON_WARNING, checks=(_complete,))
def band_capture(
    phase: AbsolutePhase,
    cloud: Cloud,
    exposures: Exposures,
    base: BaseExposure | None,
    response: PixelResponse | None,
    calibration: RigCalibration,
    facts: RigFacts,
    params: BandCaptureParams,
    shoot: Shoot,
) -> BandFrames:
    """Light part of the epipolar lines at a time where points contradict: reflections from other lines are dark."""
    doubtful = doubtful_pixels(phase, cloud)
    with_phase = int(np.count_nonzero(np.isfinite(_coordinate(phase, calibration.reference))))
    share = float(np.count_nonzero(doubtful)) / max(1, with_phase)
    if params.run == "no" or (params.run == "auto" and share <= params.enough):
        return _no_bands(params.bits, share)
    if facts.projector is None:
        raise StageFailedError("The rig has no projector: fringes need one.")
    if not doubtful.any():
        raise StageFailedError(
            "Every pixel with a phase has a point: there is nothing that bands could clear up."
        )
    masks = _masks(phase, doubtful, calibration, params)
    patterns = exposures.design.patterns(facts.projector)
    times_ms = tuple(sorted(params.exposures_ms or ()))
    if not times_ms:
        wanted_ms = _used_ms(phase, exposures, doubtful, facts.reference)
        if base is not None and response is not None:
            wanted_ms = _bright_ms(base, response, doubtful, facts)
        frames = 2 * params.bits * len(masks.bands) * len(patterns)
        affordable_ms = 1000.0 * params.budget_s / frames
        grid = ExposureGrid.of(facts, snap=params.snap)
        times_ms = (grid.ms(grid.index(min(wanted_ms, affordable_ms))),)
    return shoot(capture_plan(patterns, times_ms, masks, params, share))


def doubtful_pixels(phase: AbsolutePhase, cloud: Cloud) -> Bool[np.ndarray, "h w"]:
    """Mark the reference camera's pixels that have a phase but no point."""
    name = cloud.cameras[0] if cloud.cameras else next(iter(cloud.depth_mm))
    return np.asarray(np.isfinite(_coordinate(phase, name)) & ~np.isfinite(cloud.depth_mm[name]))


def lines(calibration: RigCalibration, camera: str) -> EpipolarLines:
    """Return the epipolar lines of a camera and the projector, or say what isn't calibrated."""
    pair = pair_geometry(calibration, camera)
    if pair is None:
        raise StageFailedError(
            "The projector isn't calibrated: bands follow its epipolar lines; calibrate it or go on without bands."
        )
    return epipolar_lines(*pair)


@dataclass(frozen=True)
class _Masks:
    """What the projector shows of its lines."""

    lines: Mapping[str, EpipolarLines]
    bands: Mapping[str, Bands]

    def of(self, camera: str, bit: int, *, inverse: bool) -> InMemory:
        """Return full light with the other bands dark.

        Not the intensity mask: it dims what receives second reflections as well, and time is short here.
        """
        lit = self.bands[camera].lit(self.lines[camera].projector_px, bit, inverse=inverse)
        return InMemory(lit.astype(np.float32))


def _masks(
    phase: AbsolutePhase,
    doubtful: Bool[np.ndarray, "h w"],
    calibration: RigCalibration,
    params: BandCaptureParams,
) -> _Masks:
    """Spread the bands of every camera over the lines that the doubtful pixels' light comes from."""
    reference = calibration.reference
    others = [n for n in phase.projector_px if n != reference and params.cameras == "all"]
    all_lines = {name: lines(calibration, name) for name in (reference, *others)}
    places = _places(phase, doubtful, all_lines[reference], reference)
    numbers_px = {name: all_lines[name].projector_px[places] for name in others}
    numbers_px[reference] = all_lines[reference].camera_px[doubtful]
    bands = {name: bands_around(numbers_px[name], params.bits) for name in all_lines}
    return _Masks(all_lines, bands)


def capture_plan(
    patterns: tuple[Pattern, ...],
    exposures_ms: tuple[float, ...],
    masks: _Masks,
    params: BandCaptureParams,
    doubtful_share: float,
) -> Plan[BandFrames]:
    """Take a burst for every camera, bit and half of the bands."""
    frames: list[Frame] = []
    sets: list[BandSet] = []
    count = sum(2 * bands.bits for bands in masks.bands.values())
    for camera, bands in masks.bands.items():
        for bit in range(bands.bits):
            for is_inverse in (False, True):
                pixels = masks.of(camera, bit, inverse=is_inverse)
                burst = tuple(
                    Shot(p, t, params.gain_db, (camera,), role="bands", mask=pixels)
                    for t in exposures_ms
                    for p in patterns
                )
                exposed = yield OneOf(burst, len(sets), count, "bands")
                sets.append(BandSet(camera, bit, is_inverse, len(frames), len(burst)))
                frames += [shot[camera] for shot in exposed]
    return BandFrames(
        frames=tuple(frames),
        sets=tuple(sets),
        low_px={name: bands.low_px for name, bands in masks.bands.items()},
        width_px={name: bands.width_px for name, bands in masks.bands.items()},
        bits=params.bits,
        exposures_ms=exposures_ms,
        frame_count=len(frames),
        exposure_time_s=sum(f.exposure_ms or 0.0 for f in frames) / 1000.0,
        doubtful_share=doubtful_share,
    )


def _no_bands(bits: int, doubtful_share: float) -> BandFrames:
    return BandFrames(
        frames=(),
        sets=(),
        low_px={},
        width_px={},
        bits=bits,
        exposures_ms=(),
        frame_count=0,
        exposure_time_s=0.0,
        doubtful_share=doubtful_share,
    )


def _coordinate(phase: AbsolutePhase, camera: str) -> Float32[np.ndarray, "h w"]:
    if camera not in phase.projector_px:
        raise StageFailedError(
            f"Camera {camera!r} has no columns: bands clear up columns, so code them (directions x or xy)."
        )
    return phase.projector_px[camera]


def _used_ms(
    phase: AbsolutePhase, exposures: Exposures, doubtful: Bool[np.ndarray, "h w"], camera: str
) -> float:
    """Return the exposure that served most of the doubtful pixels."""
    used = phase.exposure_index[camera][doubtful]
    counts = np.bincount(used[used != _NO_EXPOSURE], minlength=len(exposures.exposures_ms))
    return exposures.exposures_ms[int(np.argmax(counts[: len(exposures.exposures_ms)]))]


def _bright_ms(
    base: BaseExposure, response: PixelResponse, doubtful: Bool[np.ndarray, "h w"], facts: RigFacts
) -> float:
    """Return the exposure at which the doubtful pixels are bright, but hardly any saturates under full light."""
    camera = facts.cameras[facts.reference]
    gain = response.gain[facts.reference][doubtful]
    gain = gain[np.isfinite(gain)]
    if gain.size == 0:
        return base.exposure_ms
    brightest = 255.0 * float(np.quantile(gain, _BRIGHTEST)) + camera.black_level_gray
    return base.exposure_ms * _FULL * camera.full_scale_gray / max(brightest, 1.0)


class _Places(NamedTuple):
    """Projector pixels, as an index into its pictures."""

    row: Int64[np.ndarray, "n"]
    column: Int64[np.ndarray, "n"]


def _places(
    phase: AbsolutePhase, doubtful: Bool[np.ndarray, "h w"], own: EpipolarLines, camera: str
) -> _Places:
    """Tell about where the doubtful pixels' light comes from: their lines, and the columns measured however wrongly."""
    some = np.flatnonzero(doubtful)[:: max(1, np.count_nonzero(doubtful) // _SAMPLE)]
    height_px, width_px = own.projector_px.shape
    columns = np.rint(phase.projector_px[camera].reshape(-1)[some])
    columns = np.clip(columns, 0, width_px - 1).astype(np.int64)
    numbers_px = own.camera_px.reshape(-1)[some]
    rows = [
        np.interp(number, own.projector_px[:, column], np.arange(height_px))
        for number, column in zip(numbers_px, columns, strict=True)
    ]
    return _Places(np.rint(rows).astype(np.int64), columns)
