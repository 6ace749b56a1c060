"""Take one static scene at several exposures: what the camera's response is learned from."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Int64, Integer

from backend.domain.checks import Check, at_least
from backend.domain.errors import InvalidCaptureError, StageFailedError, sentence_of
from backend.domain.frames import Frame
from backend.domain.hints import Frames, Mask, Table, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import BLACK, WHITE, Sine
from backend.domain.rig import RigFacts
from backend.domain.shots import Exposed, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.camera_response import stratified_samples, unclipped
from backend.numerics.errors import NumericsError
from backend.stages.pre_exposure import ExposureGrid

LONGEST_OVER_BASE = 4.0
"""The ladder's longest exposure over that of the fringes: shows the scene's dark parts at mid gray."""

LIT_SHARE = 0.1
"""The mirror is where white is brighter than black by this share of what its brightest parts are."""

FIRST_MS = 30.0
MOST_TRIALS = 16
SATURATED_SHARE = 1e-3
"""Of the bright pixels: dead and hot ones must not decide."""

UNSEEN_SHARE = 0.2
"""Pictures of white and black that differ by less than this share of white differ by noise and stray light only."""

NEAR_ENOUGH = 0.04
"""The search ends when exposures that do and don't saturate differ by this."""


class StackParams(Params):
    """Which exposures, and of what."""

    base_exposure_ms: float | None = setting(
        None, title="Exposure of ramp and fringes", unit="ms", auto="base_exposure_ms", gt=0, le=60_000
    )  # fmt: skip
    """Automatic: the longest at which a white screen saturates nothing."""
    exposures_ms: tuple[float, ...] | None = setting(
        None, title="Exposures", unit="ms", auto="exposures_ms", min_length=2, max_length=16
    )
    """Automatic: a ladder from four times the fringes' exposure down, in equal ratios."""
    count: int = setting(6, title="Number of exposures", ge=2, le=16)
    """Of the automatic ladder."""
    spread: float = setting(50.0, title="Longest over shortest", unit="x", ge=2, le=1000)
    """Of the automatic ladder."""
    scene_periods: float = setting(3.0, title="Scene", unit="periods", gt=0, le=64, advanced=True)
    """The static scene is one fringe pattern with so many periods: every brightness, smoothly."""
    points: int = setting(400, title="Points", ge=20, le=5000, advanced=True)
    """About how many pixels the response is fitted to; they cover the brightness evenly."""
    snap: bool = setting(True, title="Whole screen frames", advanced=True)
    """Use multiples of the screen's frame period, so that its modulation averages out."""


@dataclass(frozen=True)
class StackRow:
    """One exposure."""

    exposure_ms: float
    median_gray: float
    black_share: float
    """Of the mirror's pixels, at gray 0."""
    white_share: float
    """Of the mirror's pixels, at full scale."""


@dataclass(frozen=True)
class Stack:
    """One static scene at several exposures."""

    frames: Annotated[tuple[Frame, ...], Frames("The scene at each exposure")]
    exposures_ms: tuple[float, ...]
    table: Annotated[tuple[StackRow, ...], Table("Exposures", edits="exposures_ms")]
    base_exposure_ms: Annotated[float | None, Value("Exposure of ramp and fringes", unit="ms")]
    """None: imported, it isn't known."""
    region: Annotated[Mapping[str, Bool[np.ndarray, "_h _w"]], Mask("Mirror", {1: "mirror"})]
    """Where the screen is seen: its white is brighter than its black."""
    samples_gray: Int64[np.ndarray, "point exposure"]
    """Gray levels of the points at each exposure, darkest point first."""
    covered_share: Annotated[float, Value("Gray levels covered")]
    """Share of all gray levels that are within 1/32 of full scale of an unclipped sample."""
    full_scale_gray: float
    screen_px: tuple[int, int] | None = None
    """Width and height of the screen."""


def _covered(result: Stack, params: StackParams) -> Check:
    return at_least(
        "coverage", result.covered_share, warning=0.85, failure=0.3,
        sentence=f"the stack's samples cover {result.covered_share:.0%} of the gray levels",
        remedy="take more exposures, or choose them closer together",
    )  # fmt: skip


@stage(title="Exposure stack", version=1, review=Review.ON_WARNING, checks=(_covered,))
def stack(facts: RigFacts, params: StackParams, shoot: Shoot) -> Stack:
    """Take one scene at several exposures, from which the camera's response is learned."""
    if facts.projector is None:
        raise StageFailedError("The rig has no screen: fringe reflection needs one.")
    grid = ExposureGrid.of(facts, snap=params.snap)
    base_ms, region = shoot(_region_plan(facts, params, grid))
    exposures_ms = params.exposures_ms or ladder(base_ms, grid, params)
    frames = shoot(_stack_plan(exposures_ms, params, facts.reference))
    screen_px = (facts.projector.width_px, facts.projector.height_px)
    return make_stack(
        frames, base_exposure_ms=base_ms, region=region, points=params.points, screen_px=screen_px
    )


def ladder(base_ms: float, grid: ExposureGrid, params: StackParams) -> tuple[float, ...]:
    """Choose exposures in equal ratios around the fringes' exposure, increasing, all different."""
    longest = base_ms * LONGEST_OVER_BASE
    wanted = np.geomspace(longest / params.spread, longest, params.count)
    chosen = {grid.index(t) for t in wanted}
    # Whole frames leave few short exposures: longer ones tell as much, of the scene's darker parts.
    while len(chosen) < params.count and max(chosen) < grid.highest:
        chosen.add(min(grid.highest, max(max(chosen) + 1, round(1.5 * max(chosen)))))
    return tuple(_ms(grid, i) for i in sorted(chosen))


def _ms(grid: ExposureGrid, step: int) -> float:
    """Return the exposure of a step without the digits that counting leaves; to the nanosecond."""
    return round(grid.ms(step), 6)


def _region_plan(
    facts: RigFacts, params: StackParams, grid: ExposureGrid
) -> Plan[tuple[float, Bool[np.ndarray, "h w"]]]:
    """Find the fringes' exposure, and where the screen is seen."""
    camera = facts.reference
    if params.base_exposure_ms is None:
        white = yield from _longest_unsaturated(grid, camera)
    else:
        shot = Shot(WHITE, params.base_exposure_ms, cameras=(camera,), role="white")
        white = (yield (shot,))[0][camera]
    assert white.exposure_ms is not None, "frames of a rig always carry their exposure"
    shot = Shot(BLACK, white.exposure_ms, cameras=(camera,), role="dark")
    dark = (yield (shot,))[0][camera]
    light = white.gray.astype(np.float32) - dark.gray.astype(np.float32)
    brightest = float(np.quantile(light, 0.995))
    whitest = float(np.quantile(white.gray, 0.995))
    if brightest < max(0.02 * white.full_scale_gray, UNSEEN_SHARE * whitest):
        raise StageFailedError(
            f"The screen isn't seen at {white.exposure_ms:.0f} ms, white is {brightest:.1f} gray above black: "
            "turn the mirror until the camera sees the screen in it, or expose longer."
        )
    return white.exposure_ms, light > LIT_SHARE * brightest


def _longest_unsaturated(grid: ExposureGrid, camera: str) -> Plan[Frame]:
    """Bracket and bisect, in ratios: a tone curve says little of how far away saturation is."""
    good: Frame | None = None
    below, above, step = grid.lowest - 1, grid.highest + 1, grid.index(FIRST_MS)
    for _ in range(MOST_TRIALS):
        shot = Shot(WHITE, _ms(grid, step), cameras=(camera,), role="white")
        white = (yield (shot,))[0][camera]
        if _saturated_share(white) <= SATURATED_SHARE:
            good, below = white, step
        else:
            above = step
        if above - below <= max(1, NEAR_ENOUGH * below):
            break
        step = _between(below, above, grid)
    if good is None:
        raise StageFailedError(
            f"White saturates the camera even at {grid.ms(step):g} ms: close the aperture or dim the screen."
        )
    return good


def _between(below: int, above: int, grid: ExposureGrid) -> int:
    """Return the next exposure to try, strictly between the two."""
    if below < grid.lowest:
        wanted = above // 3
    elif above > grid.highest:
        wanted = 2 * below
    else:
        wanted = round((below * above) ** 0.5)
    return min(max(wanted, below + 1), above - 1)


def _saturated_share(white: Frame) -> float:
    """Return the share of the bright pixels that are within one gray level of full scale."""
    gray, full = white.gray, white.full_scale_gray
    bright = int(np.count_nonzero(gray > full / 16))
    return float(np.count_nonzero(gray >= full - 1)) / max(bright, 1)


def _stack_plan(
    exposures_ms: tuple[float, ...], params: StackParams, camera: str
) -> Plan[tuple[Frame, ...]]:
    scene = Sine(axis="x", periods=params.scene_periods)
    take = partial(Shot, scene, cameras=(camera,), role="stack")
    exposed: tuple[Exposed, ...] = yield tuple(take(t) for t in sorted(exposures_ms))
    return tuple(one[camera] for one in exposed)


def import_stack(frames: tuple[Frame, ...]) -> Stack:
    """Make the result of imported pictures of one scene; refuses one exposure, several cameras, no exposures."""
    cameras = sorted({f.camera for f in frames})
    if len(cameras) != 1:
        raise InvalidCaptureError(
            f"The stack is of {len(cameras)} cameras ({', '.join(cameras)}): a response is one camera's, give one."
        )
    if any(f.exposure_ms is None for f in frames):
        raise InvalidCaptureError(
            "A picture of the stack doesn't tell its exposure: give exposure_ms with every picture."
        )
    try:
        return make_stack(frames, base_exposure_ms=None)
    except StageFailedError as error:
        raise InvalidCaptureError(error.sentence) from error


def make_stack(
    frames: tuple[Frame, ...],
    *,
    base_exposure_ms: float | None,
    region: Bool[np.ndarray, "h w"] | None = None,
    points: int = 400,
    screen_px: tuple[int, int] | None = None,
) -> Stack:
    """Sample pictures of one scene.

    Raises
    ------
    StageFailedError
        If there is one exposure only, everything is clipped, or sizes or depths differ.
    """
    ordered = tuple(sorted(frames, key=lambda f: f.exposure_ms or 0.0))
    if len({(f.pixels.shape, f.bit_depth) for f in ordered}) != 1:
        raise StageFailedError(
            "The stack's pictures differ in size or bit depth: take them all with the same settings."
        )
    exposures_ms = tuple(f.exposure_ms or 0.0 for f in ordered)
    if len(set(exposures_ms)) < 2:
        raise StageFailedError(
            f"The stack has one exposure, {exposures_ms[0]:g} ms: a response needs at least two, better six."
        )
    full_scale = int(ordered[0].full_scale_gray)
    pictures = np.stack([f.gray for f in ordered])
    inside = np.ones(pictures.shape[1:], np.bool_) if region is None else region
    try:
        samples = stratified_samples(
            pictures, full_scale_gray=full_scale, count=points, region=inside
        )
    except NumericsError as error:
        raise StageFailedError(sentence_of(error)) from error
    return Stack(
        frames=ordered,
        exposures_ms=exposures_ms,
        table=tuple(_row(f, inside) for f in ordered),
        base_exposure_ms=base_exposure_ms,
        region={ordered[0].camera: inside},
        samples_gray=samples,
        covered_share=_coverage(samples, full_scale),
        full_scale_gray=float(full_scale),
        screen_px=screen_px,
    )


def _row(frame: Frame, region: Bool[np.ndarray, "h w"]) -> StackRow:
    gray = frame.gray[region]
    return StackRow(
        exposure_ms=frame.exposure_ms or 0.0,
        median_gray=float(np.median(gray)),
        black_share=float(np.mean(gray == 0)),
        white_share=float(np.mean(gray >= frame.full_scale_gray)),
    )


def _coverage(samples_gray: Integer[np.ndarray, "point exposure"], full_scale: int) -> float:
    good = np.sort(samples_gray[unclipped(samples_gray, full_scale)])
    levels = np.arange(full_scale + 1)
    after = good[np.clip(np.searchsorted(good, levels), 0, good.size - 1)]
    before = good[np.clip(np.searchsorted(good, levels) - 1, 0, good.size - 1)]
    nearest = np.minimum(np.abs(after - levels), np.abs(levels - before))
    return float(np.mean(nearest <= full_scale / 32))
