"""One camera's look at the frames that are verified together."""

import enum
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isclose
from typing import Any

import numpy as np

from backend.devices.protocols import Frame
from backend.domain.patterns import WHITE, Gray, Pattern, Sine, Stripe, Uniform
from backend.domain.shots import Shot
from backend.jobs.sync_sets import FrameSet, SetKind, Unit, Witness
from backend.numerics.sync_checks import (
    CommonPart,
    Fields,
    Finding,
    FrameSample,
    Movement,
    black_light,
    common_part,
    drift,
    is_unchanged,
    level,
    marker_light,
    pair_part,
    same,
    step_set,
    white_light,
)

SET_LIMIT = 0.08
"""Share of the light that a set moves by which a frame may deviate: a display that is one pattern late deviates by 25 %."""
PAIR_LIMIT = 0.25
"""The same for a pattern and its inverse, one of which is shown where the other should be: 70 %. What spills over from
saturated pixels doesn't add up."""
MARKER_LIMIT = 0.05
NO_DRIFT = 0.3
"""No lamp changes by that much within a stage: the display shows something else."""
WHITE_LEAST = 0.3
"""White may be so much darker than expected: a camera's tone curve isn't known."""


FIELD_RANGE = 8.0
"""White and black tell of exposures that are longer or shorter by this factor at most: a black level isn't known, and what
is dark at one exposure says little of another one."""


class Cause(enum.Enum):
    """What a frame that isn't right tells of the reason."""

    DISPLAY = "display"
    """It shows another pattern, or a part of one."""
    LIGHT = "light"
    """It is brighter or darker all over."""
    STILL = "still"
    """White isn't brighter than black any more."""
    CAMERA = "camera"
    """The other cameras saw what was shown."""
    UNKNOWN = "unknown"
    """It may be the display or the light."""


@dataclass(frozen=True)
class Violation:
    """A frame that doesn't show what it was taken for."""

    camera: str
    sentence: str
    """Which frame, what was seen, what is allowed."""
    cause: Cause = Cause.UNKNOWN
    number: int | None = None
    """The frame's place in the burst, if it is one of the plan's."""


@dataclass
class Known:
    """What earlier frames of a stage told: what later ones are compared with."""

    fields: dict[str, list[Fields]] = field(default_factory=dict)
    """White and black, by camera: for every range of exposures the newest."""
    first: dict[str, Fields] = field(default_factory=dict)
    """The first white and black that the camera sees the projector by: what drifts is compared with."""
    tried: dict[tuple[str, float], Fields] = field(default_factory=dict)
    """White and black as they were exposed last, in a unit that was right or not."""
    common: dict[tuple[Any, str], CommonPart] = field(default_factory=dict)
    """What sets of a family have in common, by family and camera; of one burst."""
    before: dict[str, tuple[FrameSample, int | None]] = field(default_factory=dict)
    """The frame taken last and its place in the burst, by camera."""
    levels: dict[tuple[float, str], dict[float, float]] = field(default_factory=dict)
    """Brightness of uniform fields by their code, by exposure and camera; of one burst."""
    changed: set[str] = field(default_factory=set)
    """Cameras for which the light isn't what it was when a stage began."""

    def take_in(self, camera: str, new: Sequence[Fields]) -> None:
        """Let new fields replace those of their exposure."""
        for one in new:
            old = self.fields.setdefault(camera, [])
            old[:] = [o for o in old if not isclose(o.exposure, one.exposure)]
            old.append(one)
            if one.seen:
                self.first.setdefault(camera, one)

    def forget(self, camera: str) -> None:
        """Compare nothing with what a camera saw under another light."""
        self.changed.add(camera)
        for kept in (self.common, self.levels):
            for key in [key for key in kept if key[1] == camera]:
                del kept[key]


def nearest(known: Sequence[Fields], exposure: float) -> Fields | None:
    """Return the fields that tell most of an exposure: the longest that aren't longer, among those that are seen."""
    usable = [f for f in known if f.seen] or list(known)
    below = [f for f in usable if f.exposure <= exposure * (1 + 1e-6)]
    if below:
        return max(below, key=lambda f: f.exposure)
    return min(usable, key=lambda f: f.exposure, default=None)


@dataclass
class Findings:
    """What was found of one stage's frames so far."""

    sets: int = 0
    deviation: float = 0.0
    markers: int = 0
    marker: float = 0.0
    lit: int = 0
    """White markers among frames that are dark themselves."""
    frames: int = 0
    untold: int = 0
    """Frames of the plan that only markers tell of."""
    unseen: dict[str, str] = field(default_factory=dict)
    """Cameras that can't tell the projector's white from its black, and why."""
    again: int = 0
    """Units that were taken again."""
    drifts: dict[str, float] = field(default_factory=dict)
    """Of white, by camera, as a share of the projector's light."""
    dark_drifts: dict[str, float] = field(default_factory=dict)
    """Of black, where white has drifted."""
    movements: dict[str, Movement] = field(default_factory=dict)
    """Of the picture, by camera."""

    def note(self, found: "Findings") -> None:
        """Take in what was found of a unit that is right."""
        self.sets += found.sets
        self.markers += found.markers
        self.lit += found.lit
        self.frames += found.frames
        self.untold += found.untold
        self.deviation = max(self.deviation, found.deviation)
        self.marker = max(self.marker, found.marker)


def is_light(white: float, black: float) -> bool:
    """Tell whether white and black have changed as under another lamp, not as if one showed what the other should."""
    most = max(abs(white), abs(black))
    return most < NO_DRIFT or abs(white - black) < NO_DRIFT * most


class Look:
    """One camera's look at one unit."""

    def __init__(
        self,
        known: Known,
        camera: str,
        unit: Unit,
        frames: Sequence[Mapping[str, Frame]],
        burst: Sequence[Shot],
        found: Findings,
    ) -> None:
        self._camera, self._unit, self._burst, self._found = camera, unit, burst, found
        self._known = known
        own = [
            (p, taken[camera])
            for p, taken in zip(unit.planned, frames, strict=True)
            if camera in p.cameras
        ]
        self._planned = [p for p, _ in own]
        self._samples = [sample_of(frame) for _, frame in own]
        self._of = {p.number: n for n, p in enumerate(self._planned) if p.number is not None}
        self.fields: list[Fields] = []
        """White and black of this unit."""
        self.common: dict[tuple[Any, str], CommonPart] = {}
        self.levels: dict[tuple[float, str], dict[float, float]] = {}
        self.last = self._samples[-1], self._planned[-1].number

    def judge(self) -> Violation | None:
        """Return the first frame that isn't right, None if all are."""
        self._found.frames += len(self._samples)
        return self._witnesses() or self._unseen_fields() or self._markers() or self._sets()

    # uniform fields

    def _witnesses(self) -> Violation | None:
        for white, black in self._pairs():
            exposure = exposure_of(self._planned[white].shot)
            a, b = self._samples[white], self._samples[black]
            if Fields(b, a, exposure).seen:
                return self._violation("the white field is darker than the black one")
            fields = Fields(a, b, exposure)
            before = self._known.tried.get((self._camera, exposure))
            self._known.tried[self._camera, exposure] = fields
            if before is not None and before.seen:
                if not fields.seen:
                    self._known.tried[self._camera, exposure] = before
                    return self._violation("white and black look the same by now", Cause.STILL)
                self._compare(before, fields)
            self.fields.append(fields)
        return None

    def _pairs(self) -> Iterator[tuple[int, int]]:
        """Find white and the black that follows it."""
        for n, (one, other) in enumerate(zip(self._planned, self._planned[1:], strict=False)):
            if (one.witness, other.witness) == (Witness.WHITE, Witness.BLACK):
                yield n, n + 1

    def _compare(self, before: Fields, now: Fields) -> None:
        white = drift(before.white, now.white, before) or 0.0
        black = drift(before.black, now.black, before) or 0.0
        if max(abs(white), abs(black)) > MARKER_LIMIT and is_light(white, black):
            # What is compared from now on is what is seen under the light of now.
            self._known.forget(self._camera)

    def _fields(self, exposure: float) -> Fields | None:
        """Return white and black that tell of an exposure: this unit's, or earlier ones."""
        own = [f.exposure for f in self.fields]
        earlier = [
            f
            for f in self._known.fields.get(self._camera, ())
            if not any(isclose(f.exposure, e) for e in own)
        ]
        return nearest([*self.fields, *earlier], exposure)

    def _unseen_fields(self) -> Violation | None:
        """See whether anything is brighter than white was, or darker than black: then those came too late."""
        for planned, sample in zip(self._planned, self._samples, strict=True):
            exposure = exposure_of(planned.shot)
            fields = self._fields(exposure)
            if fields is None or fields.seen:
                continue
            name = "the marker" if planned.number is None else self._named(planned.number)
            if Fields(sample, fields.at_most(exposure), exposure).seen:
                return self._violation(f"{name} is brighter than the white field")
            if Fields(fields.at_least(exposure), sample, exposure).seen:
                return self._violation(f"{name} is darker than the black field")
        return None

    def _markers(self) -> Violation | None:
        for n, planned in enumerate(self._planned):
            exposure = exposure_of(planned.shot)
            fields = self._fields(exposure)
            if planned.witness is not Witness.MARKER or fields is None:
                continue
            if planned.shot.pattern == WHITE:
                share = white_light(self._samples[n], fields, exposure)
                if share is not None and share < WHITE_LEAST:
                    return self._violation(
                        f"the white marker {self._place(n)} has only {share:.0%} of the light"
                    )
                self._found.lit += share is not None
                continue
            others = [
                self._samples[i]
                for i, p in enumerate(self._planned)
                if p.number is not None and exposure_of(p.shot) == exposure
            ]
            share = marker_light(self._samples[n], others, fields, exposure)
            if share is None:
                continue
            self._found.markers += 1
            self._found.marker = max(self._found.marker, share)
            if share > MARKER_LIMIT:
                return self._violation(
                    f"the black marker {self._place(n)} has {share:.0%} of the light around it, {MARKER_LIMIT:.0%} are"
                    " allowed"
                )
        return None

    def _place(self, n: int) -> str:
        """Say where in the burst a marker was."""
        before = [p.number for p in self._planned[:n] if p.number is not None]
        if before:
            return f"after {self._named(before[-1])}"
        return f"before {self._named(min(self._of))}" if self._of else ""

    # sets

    def _sets(self) -> Violation | None:
        for one in self._unit.sets:
            if not all(number in self._of for number in one.numbers):
                continue
            violation = self._set(one)
            if violation is not None:
                return violation
        return None

    def _set(self, one: FrameSet) -> Violation | None:
        places = [self._of[number] for number in one.numbers]
        samples = [self._samples[n] for n in places]
        disorder = self._disorder(one, samples[-1])
        if disorder is not None:
            return disorder
        if one.kind in (SetKind.WHITE, SetKind.BLACK):
            wrong = self._uniform(one, samples[0])
            return wrong or self._unchanged(
                one.numbers[0], samples[0], *self._exposed_before(places[0])
            )
        before = [self._exposed_before(n) for n in places]
        found, limit = self._finding(one, samples, [sample for sample, _ in before])
        if found is None:
            self._found.untold += len(samples) if not self._is_ordered(one) else 0
            return self._unchanged(one.numbers[0], samples[0], *before[0])
        self._found.sets += 1
        self._found.deviation = max(self._found.deviation, found.share)
        if found.share <= limit:
            return None
        return self._deviation(one, found, limit)

    def _exposed_before(self, place: int) -> tuple[FrameSample | None, int | None]:
        """Return what was exposed right before, and where in the burst, if it isn't a witness."""
        if place > 0:
            return self._samples[place - 1], self._planned[place - 1].number
        return self._known.before.get(self._camera, (None, None))

    def _finding(
        self, one: FrameSet, samples: Sequence[FrameSample], before: Sequence[FrameSample | None]
    ) -> tuple[Finding | None, float]:
        if one.kind is SetKind.SAME:
            return same(samples), SET_LIMIT
        if one.kind is SetKind.PAIR:
            return self._compared(one, pair_part(samples), before), PAIR_LIMIT
        if one.kind is not SetKind.STEPS:
            return None, SET_LIMIT
        shifts = np.array([_shift(self._burst[number]) for number in one.numbers])
        if not one.needs_partner:
            return step_set(samples, shifts, before), SET_LIMIT
        part = common_part(samples, shifts)
        return (None if part is None else self._compared(one, part, before)), SET_LIMIT

    def _compared(
        self, one: FrameSet, part: CommonPart, before: Sequence[FrameSample | None]
    ) -> Finding | None:
        """Compare with an earlier set of the family; the first one waits for the second."""
        key = (one.family, self._camera)
        known = self.common.get(key) or self._known.common.get(key)
        if known is None:
            self.common[key] = part
            return None
        return part.against(known, before)

    def _is_ordered(self, one: FrameSet) -> bool:
        """Tell whether the set is a field that is compared with other fields, or waits for a partner."""
        shot = self._burst[one.numbers[-1]]
        ordered = len(self.levels.get((exposure_of(shot), self._camera), ())) > 1
        return one.needs_partner or (isinstance(shot.pattern, Uniform) and ordered)

    def _unchanged(
        self, number: int, sample: FrameSample, before: FrameSample | None, last: int | None
    ) -> Violation | None:
        """See whether a gray field is as bright as another one that was exposed right before it."""
        if last is None or before is None:
            return None
        here, there = self._burst[number], self._burst[last]
        exposure = exposure_of(here)
        fields = self._fields(exposure)
        if not (isinstance(here.pattern, Uniform) and isinstance(there.pattern, Uniform)):
            return None
        codes = here.pattern.gray, there.pattern.gray
        masked = here.mask is not None or there.mask is not None
        if fields is None or masked or codes[0] == codes[1] or exposure_of(there) != exposure:
            return None
        if not is_unchanged(sample, before, codes, fields, exposure):
            return None
        return self._violation(
            f"{self._named(number)} shows what was shown before: it is as bright as gray {codes[1]:g}",
            Cause.DISPLAY,
            number,
        )

    def _disorder(self, one: FrameSet, sample: FrameSample) -> Violation | None:
        """See whether a brighter code is darker than another one, at one exposure: whatever the display's gamma is."""
        shot = self._burst[one.numbers[-1]]
        exposure = exposure_of(shot)
        fields = self._fields(exposure)
        if not isinstance(shot.pattern, Uniform) or shot.mask is not None or fields is None:
            return None
        code = shot.pattern.gray
        key = (exposure, self._camera)
        known = dict(self.levels.get(key) or self._known.levels.get(key, {}))
        if isclose(exposure, fields.exposure):
            known |= {
                255.0: level(fields.white, fields) or 0.0,
                0.0: level(fields.black, fields) or 0.0,
            }
        here = level(sample, fields)
        if here is None:
            return None
        slack = MARKER_LIMIT * (max([here, *known.values()]) - min([here, *known.values()]))
        for other, brightness in known.items():
            if (other - code) * (brightness - here) < 0 and abs(brightness - here) > max(
                slack, 1.0
            ):
                return self._violation(
                    f"{self._named(one.numbers[-1])} is {'brighter' if here > brightness else 'darker'} than gray"
                    f" {other:g}"
                )
        self.levels[key] = known | {code: here}
        return None

    def _uniform(self, one: FrameSet, sample: FrameSample) -> Violation | None:
        shot = self._burst[one.numbers[0]]
        fields = self._fields(exposure_of(shot))
        if fields is None:
            return None
        if one.kind is SetKind.BLACK:
            share = black_light(sample, fields, exposure_of(shot))
            if share is not None and share > MARKER_LIMIT:
                return self._violation(
                    f"{self._named(one.numbers[0])} has {share:.0%} of the projector's light, {MARKER_LIMIT:.0%} are"
                    " allowed"
                )
            return None
        share = white_light(sample, fields, exposure_of(shot))
        if share is not None and share < WHITE_LEAST:
            return self._violation(
                f"{self._named(one.numbers[0])} has only {share:.0%} of the projector's light"
            )
        return None

    # words

    def _deviation(self, one: FrameSet, found: Finding, limit: float) -> Violation:
        amount = (
            f"it deviates from its set by {found.share:.0%} of the light, {limit:.0%} are allowed"
        )
        cause = Cause.LIGHT if found.even else Cause.DISPLAY
        if one.kind is SetKind.SAME:
            cause = Cause.UNKNOWN  # any other field is brighter or darker all over, too
        if found.frame is None:
            first, last = (self._named(one.numbers[i]) for i in (0, -1))
            what = "is brighter or darker all over" if found.even else "is wrong"
            return self._violation(
                f"a frame from {first} to {last} {what}: {amount}", cause, one.numbers[0]
            )
        number = one.numbers[found.frame]
        shows = "doesn't show its pattern"
        if found.repeats:
            shows = "shows what was shown before"
        elif self._is_dark(number):
            cause = Cause.DISPLAY
        elif found.even:
            shows = "is brighter or darker all over"
        return self._violation(f"{self._named(number)} {shows}: {amount}", cause, number)

    def _is_dark(self, number: int) -> bool:
        """Tell whether a frame shows nothing at all."""
        exposure = exposure_of(self._burst[number])
        fields = self._fields(exposure)
        if fields is None:
            return False
        share = black_light(self._samples[self._of[number]], fields, exposure)
        return share is not None and share < MARKER_LIMIT

    def _named(self, number: int) -> str:
        shot = self._burst[number]
        role = f"{shot.role} " if shot.role else ""
        return f"{role}frame {number + 1} of {len(self._burst)} ({_words(shot.pattern)}, {shot.exposure_ms:.4g} ms)"

    def _violation(
        self, sentence: str, cause: Cause = Cause.UNKNOWN, number: int | None = None
    ) -> Violation:
        return Violation(self._camera, sentence, cause, number)


def sample_of(frame: Frame) -> FrameSample:
    """Return the rows of a frame that are looked at."""
    return FrameSample(np.asarray(frame.data), full_scale_gray=float(2**frame.bits - 1))


def exposure_of(shot: Shot) -> float:
    """Return exposure times gain."""
    return float(shot.exposure_ms * 10 ** (shot.gain_db / 20))


def _shift(shot: Shot) -> float:
    assert isinstance(shot.pattern, Sine), "a step set holds nothing else"
    return shot.pattern.shift_rad


def _words(pattern: Pattern) -> str:
    if isinstance(pattern, Sine):
        return f"{pattern.periods:g} periods along {pattern.axis} at {np.rad2deg(pattern.shift_rad):.0f} deg"
    inverse = ", inverse" if isinstance(pattern, Gray | Stripe) and pattern.inverse else ""
    if isinstance(pattern, Gray):
        return f"Gray code along {pattern.axis}, bit {pattern.bit}{inverse}"
    if isinstance(pattern, Stripe):
        return f"stripes along {pattern.axis}, shift {pattern.shift_periods:g}{inverse}"
    if isinstance(pattern, Uniform):
        return {0.0: "black", 255.0: "white"}.get(pattern.gray, f"gray {pattern.gray:g}")
    return pattern.kind
