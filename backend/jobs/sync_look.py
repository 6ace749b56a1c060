"""One camera's look at the frames that are verified together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
    black_light,
    common_part,
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
WHITE_LEAST = 0.3
"""White may be so much darker than expected: a camera's tone curve isn't known."""


@dataclass(frozen=True)
class Violation:
    """A frame that doesn't show what it was taken for."""

    camera: str
    sentence: str
    """Which frame, what was seen, what is allowed."""


@dataclass
class Known:
    """What earlier frames of a stage told: what later ones are compared with."""

    fields: dict[str, Fields] = field(default_factory=dict)
    """White and black, by camera."""
    common: dict[tuple[Any, str], CommonPart] = field(default_factory=dict)
    """What sets of a family have in common, by family and camera; of one burst."""
    before: dict[str, FrameSample] = field(default_factory=dict)
    """The frame taken last, by camera."""
    levels: dict[tuple[float, str], dict[float, float]] = field(default_factory=dict)
    """Brightness of uniform fields by their code, by exposure and camera; of one burst."""


@dataclass
class Findings:
    """What was found of one stage's frames so far."""

    sets: int = 0
    deviation: float = 0.0
    markers: int = 0
    marker: float = 0.0
    frames: int = 0
    again: int = 0
    """Units that were taken again."""
    drifts: dict[str, float] = field(default_factory=dict)
    """Of white, by camera, as a share of the projector's light."""
    dark_drifts: dict[str, float] = field(default_factory=dict)
    """Of black, where white has drifted."""

    def note(self, found: "Findings") -> None:
        """Take in what was found of a unit that is right."""
        self.sets += found.sets
        self.markers += found.markers
        self.frames += found.frames
        self.deviation = max(self.deviation, found.deviation)
        self.marker = max(self.marker, found.marker)


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
        self.common: dict[tuple[Any, str], CommonPart] = {}
        self.levels: dict[tuple[float, str], dict[float, float]] = {}
        self.last = self._samples[-1]

    def judge(self) -> Violation | None:
        """Return the first frame that isn't right, None if all are."""
        self._found.frames += len(self._samples)
        return self._witnesses() or self._unseen_fields() or self._markers() or self._sets()

    # uniform fields

    def _witnesses(self) -> Violation | None:
        shown = {p.witness: n for n, p in enumerate(self._planned)}
        if Witness.WHITE in shown and Witness.BLACK in shown:
            white, black = (shown[w] for w in (Witness.WHITE, Witness.BLACK))
            exposure = exposure_of(self._planned[white].shot)
            a, b = self._samples[white], self._samples[black]
            if Fields(b, a, exposure).seen:
                return self._violation("the white field is darker than the black one")
            self._known.fields[self._camera] = Fields(a, b, exposure)
        return None

    def _unseen_fields(self) -> Violation | None:
        """See whether anything is brighter than white was, or darker than black: then those came too late."""
        fields = self._known.fields.get(self._camera)
        if fields is None or fields.seen:
            return None
        for planned, sample in zip(self._planned, self._samples, strict=True):
            exposure = exposure_of(planned.shot)
            name = "the marker" if planned.number is None else self._named(planned.number)
            if Fields(sample, fields.at_most(exposure), exposure).seen:
                return self._violation(f"{name} is brighter than the white field")
            if Fields(fields.at_least(exposure), sample, exposure).seen:
                return self._violation(f"{name} is darker than the black field")
        return None

    def _markers(self) -> Violation | None:
        fields = self._known.fields.get(self._camera)
        for n, planned in enumerate(self._planned):
            if planned.witness is not Witness.MARKER or fields is None:
                continue
            exposure = exposure_of(planned.shot)
            if planned.shot.pattern == WHITE:
                share = white_light(self._samples[n], fields, exposure)
                if share is not None and share < WHITE_LEAST:
                    return self._violation(
                        f"the white marker {self._place(n)} has only {share:.0%} of the light"
                    )
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
            return self._uniform(one, samples[0])
        before = self._known.before.get(self._camera)
        if places[0] > 0:
            before = self._samples[places[0] - 1]
        found, limit = self._finding(one, samples, before)
        if found is None:
            return None
        self._found.sets += 1
        self._found.deviation = max(self._found.deviation, found.share)
        if found.share <= limit:
            return None
        return self._deviation(one, found, limit)

    def _finding(
        self, one: FrameSet, samples: Sequence[FrameSample], before: FrameSample | None
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
        self, one: FrameSet, part: CommonPart, before: FrameSample | None
    ) -> Finding | None:
        """Compare with an earlier set of the family; the first one waits for the second."""
        key = (one.family, self._camera)
        known = self.common.get(key) or self._known.common.get(key)
        if known is None:
            self.common[key] = part
            return None
        return part.against(known, before)

    def _disorder(self, one: FrameSet, sample: FrameSample) -> Violation | None:
        """See whether a brighter code is darker than another one, at one exposure: whatever the display's gamma is."""
        shot, fields = self._burst[one.numbers[-1]], self._known.fields.get(self._camera)
        if not isinstance(shot.pattern, Uniform) or shot.mask is not None or fields is None:
            return None
        exposure, code = exposure_of(shot), shot.pattern.gray
        key = (exposure, self._camera)
        known = dict(self.levels.get(key) or self._known.levels.get(key, {}))
        if exposure == fields.exposure:
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
        fields = self._known.fields.get(self._camera)
        shot = self._burst[one.numbers[0]]
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
        if found.frame is None:
            first, last = (self._named(one.numbers[i]) for i in (0, -1))
            return self._violation(f"a frame from {first} to {last} is wrong: {amount}")
        name = self._named(one.numbers[found.frame])
        shows = "shows what was shown before" if found.repeats else "doesn't show its pattern"
        return self._violation(f"{name} {shows}: {amount}")

    def _named(self, number: int) -> str:
        shot = self._burst[number]
        role = f"{shot.role} " if shot.role else ""
        return f"{role}frame {number + 1} of {len(self._burst)} ({_words(shot.pattern)}, {shot.exposure_ms:.4g} ms)"

    def _violation(self, sentence: str) -> Violation:
        return Violation(self._camera, sentence)


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
