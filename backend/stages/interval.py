"""Choose the gray levels that fringes lie between: straight enough, and wide enough."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from backend.domain.checks import Check, at_least
from backend.domain.errors import StageFailedError, sentence_of
from backend.domain.hints import Picture, Value
from backend.domain.params import Params, setting
from backend.domain.rig import RigFacts
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.errors import NumericsError
from backend.numerics.interval_search import search_interval
from backend.numerics.linearisation import Interval as GrayInterval
from backend.numerics.linearisation import interval_of
from backend.numerics.screen_ramp import MonotoneRamp, control_of_gray
from backend.stages.camera_response import Response
from backend.stages.ramp import Ramp, monotone


class IntervalParams(Params):
    """How the interval is chosen."""

    interval_gray: tuple[float, float] | None = setting(
        None, title="Interval", unit="gray", auto="chosen_gray"
    )
    """Darkest and brightest gray level of the fringes. Automatic: the smallest U."""
    resolution_weight: float = setting(20.0, title="Weight of the range", ge=1, le=200)
    """eta of equation 15: a wide range has less noise, a narrow one is straighter; 10 to 50 differ little."""
    degree: int = setting(8, title="Degree", ge=3, le=8, advanced=True)
    """Of the polynomial of equation 10. One of degree 6 still bends by 1 to 2 % where a tone curve flattens."""
    grid_gray: int = setting(5, title="Grid", unit="gray", ge=2, le=20, advanced=True)
    """Step of the full search, in gray levels of 8 bit; around the best it is 1."""


@dataclass(frozen=True)
class Interval:
    """Gray levels between which the fringes lie, and the control values that make them."""

    chosen_gray: tuple[float, float]
    """Darkest, brightest."""
    gray_low: Annotated[float, Value("Darkest gray level", unit="gray")]
    gray_high: Annotated[float, Value("Brightest gray level", unit="gray")]
    control_low: Annotated[float, Value("Darkest control value")]
    control_high: Annotated[float, Value("Brightest control value")]
    quoted_error_percent: Annotated[float, Value("Largest quoted error of ln E", unit="%")]
    """NaN without an exposure stack."""
    cost: Annotated[float, Value("U", unit="%")]
    cost_map: Annotated[
        Float[np.ndarray, "high low"] | None,
        Picture(
            "U over darkest (across) and brightest gray level (down)",
            unit="%",
            colormap="viridis",
            high=30.0,
            x="axis_gray",
            y="axis_gray",
            point="chosen_gray",
            edits="interval_gray",
        ),
    ]
    """NaN: refused, the ramp doesn't reach it or the response doesn't grow. None without an exposure stack."""
    axis_gray: Float[np.ndarray, "grid"]
    """Gray levels of columns and rows."""
    degree: int
    """Of the polynomial that the interval was chosen for."""


def _wide(result: Interval, params: IntervalParams) -> Check:
    width = result.control_high - result.control_low
    return at_least(
        "range", width, warning=0.8, failure=0.05,
        sentence=f"fringes use control values {result.control_low:.2f} to {result.control_high:.2f}",
        remedy="change the exposure, or raise the weight of the range",
    )  # fmt: skip


@stage(title="Interval", version=1, review=Review.ALWAYS, checks=(_wide,))
def interval(
    ramp: Ramp, response: Response | None, facts: RigFacts | None, params: IntervalParams
) -> Interval:
    """Choose the gray levels between which screen and camera answer along a straight line."""
    curve = monotone(ramp)
    _check_belongs(ramp, response, facts)
    levels = round(ramp.full_scale_gray) + 1
    try:
        if response is None:
            return _without_stack(curve, levels, params)
        return _searched(curve, response, levels, params)
    except NumericsError as error:
        raise StageFailedError(sentence_of(error)) from error


def _check_belongs(ramp: Ramp, response: Response | None, facts: RigFacts | None) -> None:
    """Refuse a ramp of another screen or camera depth, as far as sizes tell; its fringes tell the rest."""
    if response is not None and ramp.full_scale_gray != response.full_scale_gray:
        raise StageFailedError(
            f"The ramp reaches gray {ramp.full_scale_gray:.0f}, the stack {response.full_scale_gray:.0f}: "
            "measure the ramp again at this bit depth."
        )
    screen = facts.projector if facts else None
    if screen and ramp.screen_px and ramp.screen_px != (screen.width_px, screen.height_px):
        raise StageFailedError(
            f"The ramp is of a screen of {ramp.screen_px[0]} x {ramp.screen_px[1]} px, this rig's has "
            f"{screen.width_px} x {screen.height_px}: measure the ramp again on this screen."
        )


def _searched(
    curve: MonotoneRamp, response: Response, levels: int, params: IntervalParams
) -> Interval:
    found = search_interval(
        response.problem(params.degree), curve,
        resolution_weight=params.resolution_weight, grid_gray=params.grid_gray,
        at=_rounded(params.interval_gray),
    )  # fmt: skip
    return _result(
        found.best, found.quoted_error_percent, found.cost, found.cost_map, found.axis_gray, params
    )


def _without_stack(curve: MonotoneRamp, levels: int, params: IntervalParams) -> Interval:
    """Take everything that the ramp tells: nothing says how the camera alone answers."""
    control = control_of_gray(curve, levels)
    known = np.flatnonzero(np.isfinite(control))
    low, high = _rounded(params.interval_gray) or (int(known[0]), int(known[-1]))
    none = float("nan")
    return _result(interval_of(control, low, high), none, none, None, np.empty(0), params)


def _rounded(interval_gray: tuple[float, float] | None) -> tuple[int, int] | None:
    return None if interval_gray is None else (round(interval_gray[0]), round(interval_gray[1]))


def _result(
    best: GrayInterval,
    quoted_error_percent: float,
    cost: float,
    cost_map: Float[np.ndarray, "high low"] | None,
    axis_gray: Float[np.ndarray, "grid"],
    params: IntervalParams,
) -> Interval:
    return Interval(
        chosen_gray=(float(best.gray_low), float(best.gray_high)),
        gray_low=float(best.gray_low),
        gray_high=float(best.gray_high),
        control_low=best.control_low,
        control_high=best.control_high,
        quoted_error_percent=quoted_error_percent,
        cost=cost,
        cost_map=cost_map,
        axis_gray=axis_gray,
        degree=params.degree,
    )
