"""What captured fringes say of themselves: defective frames, and whether a ramp belongs to them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64, Shaped

from backend.numerics.errors import FrameError, FrequencyError
from backend.numerics.fringe_health import (
    RampVerdict,
    closures,
    judge_ramp,
    learn_response,
    name_defective_frame,
    suspect_sets,
)
from backend.numerics.screen_phase import ScreenPosition, screen_position
from backend.stages.reflect_sets import AxisSets, FringeSteps

Table = Float[np.ndarray, "level"]
"""Linear value of each gray level."""

Chosen = Int64[np.ndarray, "pixel"]
"""Pixels that are looked at, as places in the picture read row by row."""

_LEAST_CYCLES = 2.0
"""A set that learns the response should show at least so many fringes."""


@dataclass(frozen=True)
class FrameFinding:
    """A set of frames that doesn't fit a sinusoid."""

    number: int | None
    """Number of the defective frame; None if the set is bad but no single frame explains it."""
    axis: str
    periods: float
    closure: float
    """Rms distance of the set from sinusoids, over the modulation."""
    usual: float
    """Median of all sets."""


def set_closures(
    sets: Sequence[AxisSets], chosen: Chosen, values: Table | None
) -> dict[tuple[str, float], float]:
    """Return the closure of every set, by axis and period count; NaN for three steps."""
    found: dict[tuple[str, float], float] = {}
    for one in sets:
        for of_one in one.sets:
            picked = _picked(of_one, chosen, values)
            found[one.axis, of_one.periods] = float(closures(picked[None])[0])
    return found


def defective_frames(
    sets: Sequence[AxisSets],
    closure: dict[tuple[str, float], float],
    chosen: Chosen,
    values: Table | None,
) -> tuple[FrameFinding, ...]:
    """Look into every set whose closure is far above the others', and name its defective frame."""
    keys = list(closure)
    suspects = {keys[i] for i in suspect_sets(np.array([closure[k] for k in keys]))}
    usual = float(np.nanmedian([closure[k] for k in keys])) if keys else float("nan")
    found = []
    for one in sets:
        for place, of_one in enumerate(one.sets):
            if (one.axis, of_one.periods) not in suspects:
                continue
            number, is_blur = _named(one, place, chosen, values)
            if not is_blur:
                found.append(
                    FrameFinding(
                        number, one.axis, of_one.periods, closure[one.axis, of_one.periods], usual
                    )
                )
    return tuple(found)


def _named(
    one: AxisSets, place: int, chosen: Chosen, values: Table | None
) -> tuple[int | None, bool]:
    """Return the defective frame's number, and whether nothing but blur is the matter."""
    of_one = one.sets[place]
    steps = of_one.equal
    if place > 0:
        phase = _expected(one, place, chosen, values)
    elif len(one.sets) > 1:
        return _named_coarsest(one, chosen, values), False
    else:
        return None, False
    try:
        verdict = name_defective_frame(
            _picked(of_one, chosen, values),
            phase,
            shifts_rad=np.array([s.shift_rad + of_one.offset_rad for s in steps]),
        )
    except FrameError:
        return None, False
    if verdict.clear:
        return steps[verdict.step].number, False
    # No frame stands out: noise over a small modulation raises closure, too.
    return None, True


def _expected(
    one: AxisSets, place: int, chosen: Chosen, values: Table | None
) -> Float64[np.ndarray, "pixel"]:
    """Predict a set's phase from the coarser ones; its offset counts with the shifts."""
    coarser = AxisSets(one.camera, one.axis, one.sets[:place])
    position = _position(coarser, chosen, values)
    return np.asarray(2 * np.pi * one.sets[place].periods * position.share[0], np.float64)


def _named_coarsest(one: AxisSets, chosen: Chosen, values: Table | None) -> int | None:
    """Leave out each frame of the coarsest set in turn: without the defective one, it fits the next finer."""
    steps = one.sets[0].equal
    if len(steps) < 4:
        return None
    misfit = []
    for step in steps:
        rest = AxisSets(one.camera, one.axis, one.sets[:2]).without(frozenset({step.number}))
        misfit.append(float(np.nanmedian(_position(rest, chosen, values).residual_cycles)))
    best = int(np.argmin(misfit))
    others = np.delete(misfit, best)
    return steps[best].number if misfit[best] < 0.6 * others.min() else None


def _position(one: AxisSets, chosen: Chosen, values: Table | None) -> ScreenPosition:
    frames = [f.gray.ravel()[chosen][None, :] for f in one.frames]
    return screen_position(frames, one.code, values)


def _picked(
    of_one: FringeSteps, chosen: Chosen, values: Table | None
) -> Float64[np.ndarray, "step pixel"]:
    gray = _gray(of_one, chosen)
    return gray.astype(np.float64) if values is None else values[gray].astype(np.float64)


def _gray(of_one: FringeSteps, chosen: Chosen) -> Shaped[np.ndarray, "step pixel"]:
    return np.stack([step.frame.gray.ravel()[chosen] for step in of_one.equal])


def ramp_verdict(one: AxisSets, chosen: Chosen, values: Table) -> RampVerdict | None:
    """Learn the response from the fringes and read them through a ramp's values; None if they don't tell it.

    The set that is looked at is the coarsest with two fringes in view: its phase follows from the finer ones,
    and blur leaves it alone. Positions are found from gray levels as captured: whatever bends the finest phase moves
    them by a small part of the finest fringe only.
    """
    share = _position(one, chosen, None).share[0]
    known = share[np.isfinite(share)]
    if known.size == 0 or len(one.sets) < 2:
        return None
    extent = float(np.subtract(*np.percentile(known, [98, 2])))
    enough = [s for s in one.sets[:-1] if s.periods * extent >= _LEAST_CYCLES]
    of_one = enough[0] if enough else one.sets[-2]
    try:
        learned = learn_response(
            _gray(of_one, chosen),
            (2 * np.pi * of_one.periods * share).astype(np.float64),
            shifts_rad=np.array([s.shift_rad + of_one.offset_rad for s in of_one.equal]),
        )
    except (FrameError, FrequencyError):
        return None
    return judge_ramp(learned, values)
