"""Measure the relation between control value and gray level, on uniform fields of the screen."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from backend.domain.checks import Check, at_least
from backend.domain.errors import StageFailedError, sentence_of
from backend.domain.frames import Frame
from backend.domain.hints import Curve, Mask, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import Uniform
from backend.domain.rig import RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.errors import NumericsError
from backend.numerics.screen_ramp import MonotoneRamp, monotone_ramp
from backend.stages.stack import Stack

FEWEST_PIXELS = 50


class RampParams(Params):
    """How the ramp is measured."""

    levels: int = setting(33, title="Gray fields", ge=9, le=256)
    """Uniform fields from black to white; 17 suffice."""
    repeats: int = setting(2, title="Pictures of each", ge=1, le=16)
    """Two tell the noise of each gray level; one leaves it to the camera's data."""
    exposure_ms: float | None = setting(
        None, title="Exposure", unit="ms", auto="exposure_ms", gt=0, le=60_000
    )
    """Of ramp and fringes alike. Automatic: the stack's."""
    alike: float = setting(0.05, title="Pixels alike", gt=0, le=1, advanced=True)
    """The ramp is the mean of the pixels whose white is within this share of the most frequent one."""


@dataclass(frozen=True)
class Ramp:
    """Gray level over control value, of one screen and camera at one exposure."""

    control: Float[np.ndarray, "point"]
    """Increasing, in [-1, 1]; display code 127.5 (Y + 1)."""
    gray: Annotated[
        Float[np.ndarray, "point"], Curve("Ramp", x="control", x_title="control value", unit="gray")
    ]
    """Mean over the pixels."""
    noise_gray: Annotated[
        Float[np.ndarray, "point"],
        Curve("Noise of one picture", x="control", x_title="control value", unit="gray"),
    ]
    """Standard deviation of one sample; NaN where it wasn't measured."""
    exposure_ms: Annotated[float | None, Value("Exposure of ramp and fringes", unit="ms")]
    """None: a ramp on file that doesn't tell."""
    full_scale_gray: float
    camera: str = ""
    screen_px: tuple[int, int] | None = None
    """Width and height of the screen that it was measured on; None: not known."""
    pixels: Annotated[Mapping[str, Bool[np.ndarray, "_h _w"]] | None, Mask("Pixels averaged", {1: "averaged"})] = None  # fmt: skip


def monotone(ramp: Ramp) -> MonotoneRamp:
    """Return the strictly increasing part of a ramp.

    Raises
    ------
    StageFailedError
        If it isn't monotone, or too short.
    """
    try:
        return monotone_ramp(ramp.control, ramp.gray, full_scale_gray=ramp.full_scale_gray)
    except NumericsError as error:
        raise StageFailedError(sentence_of(error)) from error


def ramp_from_table(
    codes: Float[np.ndarray, "point"],
    gray: Float[np.ndarray, "point"],
    *,
    full_scale_gray: float = 255.0,
    exposure_ms: float | None = None,
) -> Ramp:
    """Make a ramp on file of display codes 0..255 and the gray levels seen at them."""
    control = np.asarray(codes, np.float64) / 127.5 - 1.0
    return Ramp(
        control=control,
        gray=np.asarray(gray, np.float64),
        noise_gray=np.full(control.shape, np.nan),
        exposure_ms=exposure_ms,
        full_scale_gray=full_scale_gray,
    )


def _monotone(result: Ramp, params: RampParams) -> Check:
    try:
        found = monotone(result)
    except StageFailedError as error:
        return Check("monotone", Level.FAILURE, error.sentence)
    sentence = f"the gray level grows with the control value, from {found.gray_low:.0f} to {found.gray_high:.0f}"
    return Check("monotone", Level.OK, sentence)


def _span(result: Ramp, params: RampParams) -> Check:
    share = float(np.ptp(result.gray)) / result.full_scale_gray
    return at_least(
        "span", share, warning=0.5, failure=0.1,
        sentence=f"the ramp spans {share:.0%} of the camera's gray levels", remedy="expose longer",
    )  # fmt: skip


@stage(title="Ramp", version=1, review=Review.ON_WARNING, checks=(_monotone, _span))
def ramp(stack: Stack, facts: RigFacts, params: RampParams, shoot: Shoot) -> Ramp:
    """Measure the gray level of every control value on uniform fields."""
    if facts.projector is None:
        raise StageFailedError("The rig has no screen: fringe reflection needs one.")
    exposure_ms = params.exposure_ms or stack.base_exposure_ms
    if exposure_ms is None:
        raise StageFailedError(
            "The imported stack doesn't tell at which exposure fringes are taken: set the ramp's exposure."
        )
    codes = np.unique(np.rint(np.linspace(0.0, 255.0, params.levels)))
    frames = shoot(_ramp_plan(codes, exposure_ms, params.repeats, facts.reference))
    region = stack.region.get(facts.reference)
    screen_px = (facts.projector.width_px, facts.projector.height_px)
    return make_ramp(codes, frames, region=region, alike=params.alike, screen_px=screen_px)


def _ramp_plan(
    codes: Float[np.ndarray, "point"], exposure_ms: float, repeats: int, camera: str
) -> Plan[tuple[tuple[Frame, ...], ...]]:
    exposed = yield tuple(
        Shot(Uniform(gray=float(code)), exposure_ms, cameras=(camera,), role="ramp")
        for code in codes
        for _ in range(repeats)
    )
    frames = [one[camera] for one in exposed]
    return tuple(tuple(frames[i : i + repeats]) for i in range(0, len(frames), repeats))


def make_ramp(
    codes: Float[np.ndarray, "point"],
    frames: tuple[tuple[Frame, ...], ...],
    *,
    region: Bool[np.ndarray, "h w"] | None = None,
    alike: float = 0.05,
    screen_px: tuple[int, int] | None = None,
) -> Ramp:
    """Average pictures of uniform fields, one or several per display code (darkest first)."""
    chosen = _typical(frames, region, alike)
    first = frames[0][0]
    means, noise = [], []
    for pictures in frames:
        samples = np.stack([f.gray[chosen] for f in pictures]).astype(np.float64)
        means.append(float(samples.mean()))
        spread = float(np.sqrt(samples.var(axis=0, ddof=1).mean())) if len(pictures) > 1 else np.nan
        noise.append(spread)
    return Ramp(
        control=codes / 127.5 - 1.0,
        gray=np.array(means),
        noise_gray=np.array(noise),
        exposure_ms=first.exposure_ms,
        full_scale_gray=first.full_scale_gray,
        camera=first.camera,
        screen_px=screen_px,
        pixels={first.camera: chosen},
    )


def _typical(
    frames: tuple[tuple[Frame, ...], ...], region: Bool[np.ndarray, "h w"] | None, alike: float
) -> Bool[np.ndarray, "h w"]:
    """Choose pixels of one brightness: the mean over brighter and darker ones would be of no pixel's shape."""
    middle = frames[2 * len(frames) // 3][0].gray.astype(np.float32)
    inside = np.ones(middle.shape, np.bool_) if region is None else region
    typical = float(np.median(middle[inside])) if inside.any() else 0.0
    chosen = inside & (np.abs(middle - typical) <= np.maximum(alike * typical, 1.0))
    if chosen.sum() < FEWEST_PIXELS:
        raise StageFailedError(
            f"The screen is seen in {int(inside.sum())} pixels, of which {int(chosen.sum())} are alike: "
            f"turn the mirror until the camera sees the screen in it, at least {FEWEST_PIXELS} pixels are needed."
        )
    return np.asarray(chosen)
