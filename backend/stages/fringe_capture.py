"""Capture the fringes at every exposure: exposures outside, patterns inside, all cameras at once."""

from dataclasses import dataclass
from typing import Annotated

from backend.domain.checks import Check
from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Frames, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import Pattern
from backend.domain.rig import RigFacts
from backend.domain.shots import Burst, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.stages.exposures import Exposures
from backend.stages.fringe_sets import fringe_sets
from backend.stages.intensity_mask import IntensityMask


class FringeCaptureParams(Params):
    """How the fringes are captured."""

    gain_db: float = setting(0.0, title="Camera gain", unit="dB", ge=0, le=48)
    """Analog gain of all cameras. More gain is more noise: lengthen exposures first."""


@dataclass(frozen=True)
class FringeFrames:
    """The captured fringes of all cameras and exposures."""

    frames: Annotated[tuple[Frame, ...], Frames("Captured fringes")]
    frame_count: Annotated[int, Value("Frames")]
    exposure_time_s: Annotated[float, Value("Exposure time in all", unit="s")]
    """Light time of one camera's frames; 0 where a folder doesn't tell."""


def _complete(result: FringeFrames, params: FringeCaptureParams) -> Check:
    return Check(
        "frames", Level.OK, f"{result.frame_count} frames captured", float(result.frame_count)
    )


@stage(title="Fringes", version=1, review=Review.ON_WARNING, checks=(_complete,))
def fringe_capture(
    exposures: Exposures,
    mask: IntensityMask | None,
    facts: RigFacts,
    params: FringeCaptureParams,
    shoot: Shoot,
) -> FringeFrames:
    """Project the fringes and capture them at every exposure with all cameras at once."""
    if facts.projector is None:
        raise StageFailedError("The rig has no projector: fringes need one.")
    patterns = exposures.design.patterns(facts.projector)
    return shoot(capture_plan(patterns, exposures.exposures_ms, params, mask))


def capture_plan(
    patterns: tuple[Pattern, ...],
    exposures_ms: tuple[float, ...],
    params: FringeCaptureParams,
    mask: IntensityMask | None = None,
) -> Plan[FringeFrames]:
    """Take everything as one burst, longest exposure last: nothing depends on a frame, so the time left is known."""
    exposed = yield tuple(
        shot for t in sorted(exposures_ms) for shot in _shots(patterns, t, params, mask)
    )
    return fringe_frames(tuple(frame for shot in exposed for frame in shot.values()))


def fringe_frames(frames: tuple[Frame, ...]) -> FringeFrames:
    """Describe captured (or imported) fringes."""
    cameras = max(1, len({f.camera for f in frames}))
    light_ms = sum(f.exposure_ms or 0.0 for f in frames) / cameras
    return FringeFrames(frames, len(frames), light_ms / 1000.0)


def import_fringes(frames: tuple[Frame, ...]) -> FringeFrames:
    """Make the result of imported frames; refuses incomplete sets, passes over other patterns."""
    fringe_sets(frames)
    return fringe_frames(frames)


def _shots(
    patterns: tuple[Pattern, ...],
    exposure_ms: float,
    params: FringeCaptureParams,
    mask: IntensityMask | None,
) -> Burst:
    pixels = InMemory(mask.factor) if mask is not None else None
    return tuple(
        Shot(pattern, exposure_ms, gain_db=params.gain_db, role="fringe", mask=pixels)
        for pattern in patterns
    )
