"""Which shots of a burst verify one another, and where a marker goes that only the software knows of."""

import enum
import random
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from backend.domain.frames import identity
from backend.domain.patterns import (
    BLACK,
    WHITE,
    Gray,
    Pattern,
    Sine,
    StaticPicture,
    Stripe,
    Uniform,
)
from backend.domain.shots import Shot

FEWEST_STEPS_ALONE = 4
"""So many phase steps say by themselves whether one is wrong; three need another set to be compared with."""
_EARLY = 6
"""The marker is among so many shots at the beginning: until it is seen, nothing is written."""
_WHITE_FROM = 200.0


class SetKind(enum.Enum):
    """How the frames of a set verify one another."""

    STEPS = "steps"
    """Phase steps of one fringe: a sinusoid fits them."""
    PAIR = "pair"
    """A pattern and its inverse: their sum is the same for all."""
    SAME = "same"
    """One pattern several times."""
    WHITE = "white"
    """Bright, as the projector's light is known."""
    BLACK = "black"
    """Dark."""
    SINGLE = "single"
    """Nothing is known of it."""


class Witness(enum.Enum):
    """What is exposed besides what the plan asks for."""

    WHITE = "white"
    BLACK = "black"
    MARKER = "marker"


@dataclass(frozen=True)
class Planned:
    """One exposure to be taken."""

    shot: Shot
    cameras: tuple[str, ...]
    number: int | None = None
    """Place in the burst; None for what the plan doesn't ask for."""
    witness: Witness | None = None


@dataclass(frozen=True)
class FrameSet:
    """Consecutive shots that verify one another."""

    kind: SetKind
    numbers: tuple[int, ...]
    """Their places in the burst."""
    family: Hashable = None
    """Sets of one family have light in common; None: they are judged by themselves."""

    @property
    def needs_partner(self) -> bool:
        """Whether it takes another set of its family to judge it."""
        return self.family is not None


@dataclass(frozen=True)
class Unit:
    """What is written together, once it is verified, and taken again together if it isn't right."""

    planned: tuple[Planned, ...]
    sets: tuple[FrameSet, ...]


def sets_of(burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]]) -> list[FrameSet]:
    """Group the shots to be taken, whose numbers are the keys of `cameras`, into sets."""
    groups: list[list[int]] = []
    for number in cameras:
        group = groups[-1] if groups else []
        if group and _joins([burst[n] for n in group], burst[number]):
            same_cameras = cameras[group[-1]] == cameras[number]
            if same_cameras and group[-1] + 1 == number:
                group.append(number)
                continue
        groups.append([number])
    return [_set(burst, group, cameras[group[0]]) for group in groups]


def units_of(
    burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]], *, seed: str
) -> list[Unit]:
    """Cut a burst into units, the first of which holds the marker.

    Where a set follows one of the same patterns (a single fringe at several exposures), there is one more: the last
    step, shown once more, would be the first of a set that fits, with every phase wrong.

    Parameters
    ----------
    burst
        What the plan asks for.
    cameras
        Shots to be taken, by their place in the burst, and the cameras that take them.
    seed
        Of the marker's place.
    """
    sets = sets_of(burst, cameras)
    place = _place(seed, len(cameras))
    units: list[Unit] = []
    joined: list[FrameSet] = []
    compared: set[Hashable] = set()
    for n, one in enumerate(sets):
        joined.append(one)
        count = sum(len(s.numbers) for s in joined)
        if (not units and count < place) or _lacks_partner(joined, sets[n + 1 :], compared):
            continue
        units.append(_unit(burst, cameras, joined))
        compared |= {s.family for s in joined}
        joined = []
    if units:
        units[0] = _marked(units[0], place)
    return [
        unit if n == 0 else _told_apart(unit, burst[units[n - 1].sets[-1].numbers[-1]])
        for n, unit in enumerate(units)
    ]


def _told_apart(unit: Unit, before: Shot) -> Unit:
    """Put a marker in front of a unit that begins with what was shown before, at another exposure or under a mask."""
    first = unit.planned[0].shot
    return _marked(unit, 0) if _same_patterns(before.pattern, first.pattern) else unit


def marked_again(unit: Unit, *, seed: str) -> Unit:
    """Put one more marker into a unit, to take it again.

    A display that is late by one pattern shows the last step of the first try as the first step of the second, and so
    on: a set that fits, with every phase wrong.
    """
    shots = sum(p.number is not None for p in unit.planned)
    return _marked(unit, _place(seed, shots))


def with_fields(unit: Unit, lights: Sequence[tuple[Shot, tuple[str, ...]]]) -> Unit:
    """Expose white and black before everything else, with the exposure and gain of some shots, by some cameras."""
    fields = [
        Planned(
            Shot(pattern, shot.exposure_ms, shot.gain_db, role=witness.value),
            cameras,
            witness=witness,
        )
        for shot, cameras in lights
        for pattern, witness in ((WHITE, Witness.WHITE), (BLACK, Witness.BLACK))
    ]
    return Unit((*fields, *unit.planned), unit.sets)


def _place(seed: str, shots: int) -> int:
    """Return before which shot the marker comes."""
    # Nobody has to be kept from guessing it: a display doesn't try.
    return random.Random(seed).randint(0, min(shots, _EARLY))  # noqa: S311  not for secrets


def _lacks_partner(
    joined: Sequence[FrameSet], later: Sequence[FrameSet], compared: set[Hashable]
) -> bool:
    families = [s.family for s in joined if s.needs_partner and s.family not in compared]
    alone = {family for family in families if families.count(family) < 2}
    return any(s.family in alone for s in later)


def _unit(
    burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]], sets: Sequence[FrameSet]
) -> Unit:
    numbers = [n for one in sets for n in one.numbers]
    return Unit(tuple(Planned(burst[n], cameras[n], n) for n in numbers), tuple(sets))


def _marked(unit: Unit, place: int) -> Unit:
    planned = unit.planned
    asked = [n for n, p in enumerate(planned) if p.number is not None]
    beside = planned[asked[min(place, len(asked) - 1)]]
    at = asked[place] if place < len(asked) else len(planned)
    dark = all(_is_dark(planned[n].shot.pattern) for n in asked)
    shot = Shot(
        WHITE if dark else BLACK,
        beside.shot.exposure_ms,
        beside.shot.gain_db,
        role="marker",
    )
    marker = Planned(shot, beside.cameras, witness=Witness.MARKER)
    return Unit((*planned[:at], marker, *planned[at:]), unit.sets)


def _is_dark(pattern: Pattern) -> bool:
    if isinstance(pattern, Uniform):
        return pattern.gray < 32
    return isinstance(pattern, StaticPicture)


# ---------------------------------------------------------------- what belongs together


def _joins(group: Sequence[Shot], shot: Shot) -> bool:
    first = group[0]
    a, b = first.pattern, shot.pattern
    if _light(first) != _light(shot) or not _same_patterns(a, b):
        return False
    if isinstance(b, Sine):
        shifts = {s.pattern.shift_rad for s in group if isinstance(s.pattern, Sine)}
        return b.shift_rad not in shifts
    return len(group) == 1 if isinstance(b, Gray | Stripe) else a == b


def _same_patterns(a: Pattern, b: Pattern) -> bool:
    """Tell whether two patterns are steps of one fringe, a pattern and its inverse, or the same field."""
    if isinstance(a, Sine) and isinstance(b, Sine):
        return _fringe(a) == _fringe(b)
    if isinstance(a, Gray | Stripe) and isinstance(b, Gray | Stripe):
        return b == a.model_copy(update={"inverse": not a.inverse})
    return isinstance(a, Uniform) and a == b


def _set(burst: Sequence[Shot], numbers: Sequence[int], cameras: tuple[str, ...]) -> FrameSet:
    first = burst[numbers[0]]
    pattern, count = first.pattern, len(numbers)
    light = (*_light(first), cameras)
    if isinstance(pattern, Sine):
        family = None
        if count < FEWEST_STEPS_ALONE:
            family = ("sine", pattern.low_gray, pattern.high_gray, pattern.codes, light)
        kind = SetKind.STEPS if count >= FEWEST_STEPS_ALONE - 1 else SetKind.SINGLE
        return FrameSet(kind, tuple(numbers), family if kind is SetKind.STEPS else None)
    if isinstance(pattern, Gray | Stripe):
        if count == 2:
            return FrameSet(SetKind.PAIR, tuple(numbers), ("pair", light))
        return FrameSet(SetKind.SINGLE, tuple(numbers))
    return FrameSet(_uniform_kind(first, count), tuple(numbers))


def _uniform_kind(shot: Shot, count: int) -> SetKind:
    if count > 1:
        return SetKind.SAME
    if not isinstance(shot.pattern, Uniform):
        return SetKind.SINGLE
    if shot.pattern.gray == 0:
        return SetKind.BLACK
    is_white = shot.pattern.gray >= _WHITE_FROM and shot.mask is None
    return SetKind.WHITE if is_white else SetKind.SINGLE


def _light(shot: Shot) -> tuple[Hashable, ...]:
    return shot.exposure_ms, shot.gain_db, None if shot.mask is None else identity(shot.mask)


def _fringe(sine: Sine) -> tuple[Hashable, ...]:
    return sine.axis, sine.periods, sine.offset_rad, sine.low_gray, sine.high_gray, sine.codes
