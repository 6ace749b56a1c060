"""Capture the final code: Gray code and shifted stripes, each beside its inverse, under the intensity mask."""

from typing import Literal

from backend.domain.checks import Check
from backend.domain.errors import StageFailedError
from backend.domain.frames import InMemory
from backend.domain.params import Params, setting
from backend.domain.patterns import Axis, Gray, Pattern, Stripe, gray_code
from backend.domain.rig import ProjectorFacts, RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.line_shift import LEAST_SHIFTS
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_frames import CodeFrames, code_frames
from backend.stages.intensity_mask import IntensityMask


class CodeCaptureParams(Params):
    """Which code is projected."""

    rows: bool = setting(True, title="Code the rows, too")
    """Gray code of the projector's rows beside that of the columns: tells second reflections from the surface."""
    stripes: Literal["columns", "both", "none"] = setting("columns", title="Shifted stripes")
    """Find the place within a pixel for columns, for columns and rows, or not at all: then the Gray code
    goes down to single pixels, and one point is made of each projector pixel."""
    stripe_period_px: int = setting(16, title="Period of the stripes", unit="px", ge=8, le=128)
    """A white and a black stripe together, in projector pixels. Wider stripes stand less scattered light and
    more blur, but take more frames."""
    stripe_step_px: int = setting(1, title="Shift of the stripes", unit="px", ge=1, le=16)
    """From one frame to the next; half the period has to be a whole number of steps. 1: each column's border is an
    edge once; 2: half as many frames, and a ripple of 0.07 px in sharp pictures."""
    finest_column_px: int | None = setting(
        None, title="Finest stripe, columns", unit="px", ge=1, le=64, advanced=True
    )
    """Width of a stripe of the column code. Automatic: a quarter of the stripes' period, 1 without them."""
    finest_row_px: int | None = setting(
        None, title="Finest stripe, rows", unit="px", ge=1, le=64, advanced=True
    )
    """Width of a stripe of the row code. Automatic: 2 beside shifted stripes, 1 without them."""
    exposure_ms: float | None = setting(
        None, title="Exposure", unit="ms", gt=0, le=60_000, advanced=True
    )
    """Automatic: the base exposure, which the mask was made for."""
    cameras: Literal["all", "reference"] = setting("all", title="Cameras")


def _complete(result: CodeFrames, params: CodeCaptureParams) -> Check:
    return Check(
        "frames", Level.OK, f"{result.frame_count} frames captured", float(result.frame_count)
    )


@stage(title="Code", version=1, review=Review.ON_WARNING, checks=(_complete,))
def code_capture(
    mask: IntensityMask | None,
    base: BaseExposure,
    facts: RigFacts,
    params: CodeCaptureParams,
    shoot: Shoot,
) -> CodeFrames:
    """Project Gray code and shifted stripes under the mask, each followed by its inverse."""
    if facts.projector is None:
        raise StageFailedError("The rig has no projector: a code needs one.")
    exposure_ms = params.exposure_ms or base.exposure_ms
    _require_possible(exposure_ms, facts)
    patterns = code_patterns(facts.projector, params)
    cameras = (facts.reference,) if params.cameras == "reference" else None
    return shoot(capture_plan(patterns, exposure_ms, base.gain_db, mask, cameras))


def capture_plan(
    patterns: tuple[Pattern, ...],
    exposure_ms: float,
    gain_db: float = 0.0,
    mask: IntensityMask | None = None,
    cameras: tuple[str, ...] | None = None,
) -> Plan[CodeFrames]:
    """Take everything as one burst: nothing depends on a frame."""
    pixels = InMemory(mask.factor) if mask is not None else None
    exposed = yield tuple(
        Shot(pattern, exposure_ms, gain_db=gain_db, cameras=cameras, role="code", mask=pixels)
        for pattern in patterns
    )
    return code_frames(tuple(frame for shot in exposed for frame in shot.values()))


def code_patterns(projector: ProjectorFacts, params: CodeCaptureParams) -> tuple[Pattern, ...]:
    """List the patterns, each beside its inverse: slow drifts of light meet both alike.

    Raises
    ------
    StageFailedError
        If the stripes can't be shifted as asked, or are wider than the projector.
    """
    patterns: list[Pattern] = []
    axes: list[Axis] = ["x", "y"] if params.rows else ["x"]
    for axis in axes:
        size_px = projector.width_px if axis == "x" else projector.height_px
        shifted = params.stripes == "both" or (params.stripes == "columns" and axis == "x")
        patterns += gray_patterns(axis, size_px, _finest_px(axis, params))
        if shifted:
            patterns += stripe_patterns(
                axis, size_px, params.stripe_period_px, params.stripe_step_px
            )
    return tuple(patterns)


def gray_patterns(axis: Axis, size_px: int, finest_px: int = 1) -> tuple[Gray, ...]:
    """List a Gray code down to stripes of a width, coarsest first, each bit beside its inverse."""
    return gray_code(axis, -(-size_px // finest_px))


def stripe_patterns(axis: Axis, size_px: int, period_px: int, step_px: int) -> tuple[Stripe, ...]:
    """List stripes shifted over half their period, each position beside its inverse.

    Raises
    ------
    StageFailedError
        If half the period isn't a whole number of steps, at least four, or the stripes exceed the projector.
    """
    if period_px % (2 * step_px) or period_px // (2 * step_px) < LEAST_SHIFTS:
        raise StageFailedError(
            f"Stripes with a period of {period_px} px can't be shifted by {step_px} px: half the period has to be "
            f"a whole number of steps, {LEAST_SHIFTS} or more, e.g. {2 * step_px * max(LEAST_SHIFTS, round(period_px / 2 / step_px))} px."
        )
    if period_px > size_px:
        raise StageFailedError(
            f"Stripes with a period of {period_px} px don't fit on a projector of {size_px} px: choose narrower ones."
        )
    return tuple(
        Stripe(
            axis=axis,
            periods=size_px / period_px,
            shift_periods=number * step_px / period_px,
            inverse=inverse,
        )
        for number in range(period_px // (2 * step_px))
        for inverse in (False, True)
    )


def _finest_px(axis: Axis, params: CodeCaptureParams) -> int:
    chosen = params.finest_column_px if axis == "x" else params.finest_row_px
    if chosen is not None:
        return chosen
    if params.stripes == "none":
        return 1
    if axis == "x" or params.stripes == "both":
        return max(1, params.stripe_period_px // 4)
    return 2


def _require_possible(exposure_ms: float, facts: RigFacts) -> None:
    low = max(c.exposure_min_ms for c in facts.cameras.values())
    high = min(c.exposure_max_ms for c in facts.cameras.values())
    if not low <= exposure_ms <= high:
        raise StageFailedError(
            f"A code at {exposure_ms:g} ms isn't possible: the cameras allow {low:g} to {high:g} ms."
        )
