"""Show fringes on the screen and capture them in the mirror: x and y, coarse to fine, and the mask's fields."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from backend.domain.checks import Check
from backend.domain.errors import InvalidSettingError, StageFailedError, sentence_of
from backend.domain.frames import Frame
from backend.domain.hints import Frames, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import BLACK, WHITE, Axis, Codes, Pattern, Sine
from backend.domain.rig import RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.errors import FrequencyError
from backend.numerics.screen_phase import check_periods
from backend.stages.linearise import Linear
from backend.stages.reflect_sets import axis_sets

AXES: tuple[Axis, ...] = ("x", "y")
DEFAULT_STEPS = 4


class ReflectCaptureParams(Params):
    """Which fringes are shown and how they are captured."""

    periods_x: tuple[float, ...] = setting(
        (0.9, 4.0, 16.0, 64.0), title="Periods over the width", min_length=1, max_length=8
    )
    """Coarse to fine, whole numbers or not. The coarsest, at most 1, says where on the screen; the finest how exactly."""
    periods_y: tuple[float, ...] = setting(
        (0.9, 4.0, 16.0, 64.0), title="Periods over the height", min_length=1, max_length=8
    )
    steps: int | None = setting(None, title="Phase steps", ge=3, le=32, auto="steps")
    """Frames per period count. Automatic: as many as the linearisation was chosen for, else 4."""
    exposure_ms: float | None = setting(
        None, title="Exposure", unit="ms", gt=0, le=60_000, auto="exposure_ms"
    )
    """Automatic: the one that the response was linearised at."""
    gain_db: float = setting(0.0, title="Camera gain", unit="dB", ge=0, le=48)
    fields: bool = setting(True, title="Light and dark field")
    """Also capture a white and a black screen: what changes between them is mirror."""


@dataclass(frozen=True)
class ReflectFrames:
    """The captured fringes of a reflection."""

    frames: Annotated[tuple[Frame, ...], Frames("Captured fringes")]
    """Fringes and, where captured, the light and the dark field."""
    frame_count: Annotated[int, Value("Frames")]
    steps: Annotated[int, Value("Phase steps")]
    exposure_ms: Annotated[float | None, Value("Exposure", unit="ms")]
    """None where an imported file doesn't tell."""


def _complete(result: ReflectFrames, params: ReflectCaptureParams) -> Check:
    return Check(
        "frames", Level.OK, f"{result.frame_count} frames captured", float(result.frame_count)
    )


@stage(title="Fringes", version=1, review=Review.ON_WARNING, checks=(_complete,))
def reflect_capture(
    linear: Linear | None, facts: RigFacts, params: ReflectCaptureParams, shoot: Shoot
) -> ReflectFrames:
    """Show fringes between the chosen control values and capture what the mirror makes of them."""
    if facts.projector is None:
        raise StageFailedError("The rig has no screen: fringes need one.")
    exposure_ms = params.exposure_ms or (None if linear is None else linear.exposure_ms)
    if exposure_ms is None:
        raise InvalidSettingError(
            "Nothing says how long to expose the fringes: set the exposure, or run the linearisation before."
        )
    for periods in (params.periods_x, params.periods_y):
        try:
            check_periods(sorted(periods))
        except FrequencyError as error:
            raise InvalidSettingError(sentence_of(error)) from error
    return shoot(capture_plan(reflect_patterns(params, linear), exposure_ms, params))


def reflect_patterns(params: ReflectCaptureParams, linear: Linear | None) -> tuple[Sine, ...]:
    """List the fringes in the order in which they are shown."""
    steps = params.steps or (DEFAULT_STEPS if linear is None else linear.steps)
    low, high = (-1.0, 1.0) if linear is None else (linear.control_low, linear.control_high)
    codes: Codes | None = None
    if linear is not None and linear.codes is not None:
        codes = tuple(float(c) for c in np.clip(linear.codes, 0.0, 255.0))
    return tuple(
        Sine(
            axis=axis,
            periods=periods,
            shift_rad=2 * np.pi * step / steps,
            low_gray=float(np.clip(127.5 * (low + 1), 0, 255)),
            high_gray=float(np.clip(127.5 * (high + 1), 0, 255)),
            codes=codes,
        )
        for axis in AXES
        for periods in sorted(params.periods_x if axis == "x" else params.periods_y)
        for step in range(steps)
    )


def capture_plan(
    fringes: tuple[Sine, ...], exposure_ms: float, params: ReflectCaptureParams
) -> Plan[ReflectFrames]:
    """Take everything as one burst: nothing depends on a frame."""
    shown: list[tuple[Pattern, str]] = [(pattern, "fringe") for pattern in fringes]
    if params.fields:
        shown += [(WHITE, "light"), (BLACK, "dark")]
    exposed = yield tuple(
        Shot(pattern, exposure_ms, gain_db=params.gain_db, role=role) for pattern, role in shown
    )
    return reflect_frames(tuple(frame for shot in exposed for frame in shot.values()))


def reflect_frames(frames: tuple[Frame, ...]) -> ReflectFrames:
    """Describe captured (or imported) fringes; refuses incomplete ones."""
    sets = axis_sets(frames)
    return ReflectFrames(
        frames=frames,
        frame_count=len(frames),
        steps=max(len(of_one.equal) for one in sets for of_one in one.sets),
        exposure_ms=next((f.exposure_ms for f in frames if f.exposure_ms is not None), None),
    )
