"""Captured fringes of a reflection, sorted: by camera and axis, coarse before fine, step by step."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.patterns import Axis, Sine, Uniform
from backend.numerics.sine_code import SineCode


@dataclass(frozen=True)
class Step:
    """One frame of a set."""

    number: int
    """Place among all fringe frames of its camera, in the order of capture; from 0."""
    shift_rad: float
    frame: Frame


@dataclass(frozen=True)
class FringeSteps:
    """The frames of one period count along one axis."""

    periods: float
    offset_rad: float
    steps: tuple[Step, ...]

    @property
    def equal(self) -> tuple[Step, ...]:
        """One step of each shift, by shift: without repetitions."""
        first: dict[float, Step] = {}
        for step in self.steps:
            first.setdefault(_degrees(step), step)
        return tuple(step for _, step in sorted(first.items()))

    def without(self, numbers: frozenset[int]) -> "FringeSteps":
        """Leave frames out by their number."""
        return replace(self, steps=tuple(s for s in self.steps if s.number not in numbers))


@dataclass(frozen=True)
class AxisSets:
    """All fringes of one camera along one axis, the coarsest first."""

    camera: str
    axis: Axis
    sets: tuple[FringeSteps, ...]

    @property
    def periods(self) -> tuple[float, ...]:
        """Period counts, ascending."""
        return tuple(s.periods for s in self.sets)

    @property
    def code(self) -> SineCode:
        """Period counts and shifts, for decoding; offsets are part of the shifts."""
        shifts = tuple(tuple(step.shift_rad + s.offset_rad for step in s.steps) for s in self.sets)
        return SineCode(self.periods, shifts)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames in the order of `code`."""
        return tuple(step.frame for s in self.sets for step in s.steps)

    def without(self, numbers: frozenset[int]) -> "AxisSets":
        """Leave frames out by their number."""
        return replace(self, sets=tuple(s.without(numbers) for s in self.sets))


@dataclass(frozen=True)
class MaskFields:
    """Pictures of the dark and the light screen."""

    dark: Frame
    light: Frame


def axis_sets(frames: Iterable[Frame]) -> tuple[AxisSets, ...]:
    """Sort fringes, camera by camera, x before y.

    Raises
    ------
    InvalidCaptureError
        If there are no fringes, a set lacks a step that the others of its axis have, has fewer than three
        different ones, or frames of one camera differ in size or bit depth.
    """
    groups: dict[tuple[str, Axis], dict[float, list[tuple[Step, float]]]] = defaultdict(
        lambda: defaultdict(list)
    )
    numbers: dict[str, int] = defaultdict(int)
    for frame in frames:
        if isinstance(frame.pattern, Sine):
            sine = frame.pattern
            step = Step(numbers[frame.camera], sine.shift_rad, frame)
            numbers[frame.camera] += 1
            groups[frame.camera, sine.axis][sine.periods].append((step, sine.offset_rad))
    if not groups:
        raise InvalidCaptureError("The capture holds no fringes: frames of kind 'sine' are needed.")
    found = tuple(
        AxisSets(camera, axis, tuple(_set(p, group[p]) for p in sorted(group)))
        for (camera, axis), group in sorted(groups.items())
    )
    for one in found:
        _require_complete(one)
    return found


def mask_fields(frames: Iterable[Frame], camera: str) -> MaskFields | None:
    """Return the darkest and the brightest uniform field of a camera; None if there aren't both."""
    fields = [f for f in frames if f.camera == camera and isinstance(f.pattern, Uniform)]
    if len({_code(f) for f in fields}) < 2:
        return None
    return MaskFields(min(fields, key=_code), max(fields, key=_code))


def _code(frame: Frame) -> float:
    assert isinstance(frame.pattern, Uniform), "only uniform fields are compared"
    return frame.pattern.gray


def _set(periods: float, group: Sequence[tuple[Step, float]]) -> FringeSteps:
    first = group[0][1]
    # Offsets that differ within a set are shifts by another name.
    steps = tuple(replace(s, shift_rad=s.shift_rad + offset - first) for s, offset in group)
    return FringeSteps(periods, first, steps)


def _require_complete(one: AxisSets) -> None:
    where = f"camera {one.camera!r} along {one.axis}"
    shapes = {(f.pixels.shape, f.bit_depth) for f in one.frames}
    if len(shapes) > 1:
        raise InvalidCaptureError(
            f"The fringe frames of {where} differ in size or bit depth: capture them alike."
        )
    wanted = {_degrees(s) for of_one in one.sets for s in of_one.equal}
    for of_one in one.sets:
        missing = sorted(wanted - {_degrees(s) for s in of_one.equal})
        if missing or len(of_one.equal) < 3:
            lacking = ", ".join(f"{d:g} deg" for d in missing) or "steps"
            raise InvalidCaptureError(
                f"The fringes of {of_one.periods:g} periods of {where} lack {lacking}: {len(of_one.equal)} different "
                f"shifts are there, {max(3, len(wanted))} are needed; add the missing frame."
            )


def _degrees(step: Step) -> float:
    return round(float(np.degrees(step.shift_rad)), 1) % 360
