"""Watching over the frames of a capturing stage: whether each shows what it was taken for.

Where light isn't certain by construction, a display may lag, tear or drop a pattern, and the scan looks valid. So white
and black are exposed before the first burst, a black marker in every burst, and white after the last; step sets and
pairs of pattern and inverse are compared with themselves (`backend.numerics.sync_checks` explains how).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf

import numpy as np

from backend.devices.protocols import Frame
from backend.domain.checks import Check, at_most
from backend.domain.patterns import BLACK, WHITE, Uniform
from backend.domain.shots import Shot
from backend.domain.states import Level
from backend.jobs.sync_look import (
    FIELD_RANGE,
    NO_DRIFT,
    SET_LIMIT,
    Cause,
    Findings,
    Known,
    Look,
    Violation,
    exposure_of,
    is_light,
    nearest,
    sample_of,
)
from backend.jobs.sync_sets import Planned, Unit, Witness, marked_again, units_of, with_fields
from backend.numerics.sync_checks import Fields, FrameSample, Movement, drift, movement

DRIFT_LIMIT = 0.02
MOVED_LIMIT_PX = 0.3
"""What moves by less costs less than the fringes' noise; a rig that warms up moves by a tenth of a pixel."""
CHANGED_LIMIT = 0.15
"""Share of the light that neither a small movement nor another brightness explains."""
SYNCHRONISATION, DRIFT, STILLNESS = "synchronisation", "drift", "stillness"
"""Names of the checks that tell what was found."""
_ROOM = "the room's light has changed, keep it steady"
_LAMP = "let the lamp warm up, see that the camera doesn't set its exposure itself, and that nothing was moved"
_COVERED = (
    "the display lags, something covers it, or the camera sets its exposure itself; measure its latency, and take the stage"
    " again"
)
TRIES = 3
"""How often a unit is taken before the rig counts as failed."""


class SyncWatch:
    """Plans what is exposed besides a plan's shots, and judges what comes.

    Parameters
    ----------
    seed
        Of the markers' places: the same for a capture and its resume.
    active
        False: light is certain, every shot is right as it comes.
    """

    def __init__(self, seed: str, *, active: bool) -> None:
        self._seed = seed
        self._active = active
        self._bursts = 0
        self._known = Known()
        self._lights: dict[str, dict[float, Shot]] = {}
        """Shots with whose exposure and gain white and black were planned, by camera and exposure."""
        self._whites: dict[str, FrameSample] = {}
        """White at the end of a stage."""
        self.findings = Findings()
        self.told: Mapping[str, object] = {}
        """What was found of the unit that was judged last: kept with its frames."""
        self._recalled = Findings()
        """What was found of frames of an earlier run."""

    # what is exposed

    def units(self, burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]]) -> list[Unit]:
        """Cut what has to be taken of a burst into units."""
        if not self._active:
            return [Unit((Planned(burst[n], names, n),), ()) for n, names in cameras.items()]
        self._known.common.clear()
        self._known.levels.clear()
        self._known.before.clear()
        self._bursts += 1
        units = units_of(burst, cameras, seed=f"{self._seed}/{self._bursts}")
        return [with_fields(unit, self._lights_for(unit, burst, cameras)) for unit in units]

    def _lights_for(
        self, unit: Unit, burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]]
    ) -> list[tuple[Shot, tuple[str, ...]]]:
        """Return where white and black have to be exposed: as short as a burst allows, then where that tells nothing.

        One exposure says what black is at another one only if it isn't much longer or shorter: `FIELD_RANGE`.
        """
        wanted: dict[float, tuple[Shot, list[str]]] = {}
        for camera in dict.fromkeys(c for names in cameras.values() for c in names):
            own = [burst[n] for n, names in cameras.items() if camera in names]
            known = self._lights.setdefault(camera, {})
            told = [p.shot for p in unit.planned if camera in p.cameras and _is_judged_by_fields(p)]
            first = [] if known else [min(own, key=exposure_of)]
            for shot in (*first, *sorted(told, key=exposure_of)):
                exposure = exposure_of(shot)
                if not any(e / FIELD_RANGE <= exposure <= e * FIELD_RANGE for e in known):
                    known[exposure] = shot
                    wanted.setdefault(exposure, (shot, []))[1].append(camera)
        return [(shot, tuple(names)) for shot, names in wanted.values()]

    @property
    def markers(self) -> tuple[Shot, ...]:
        """What may have to be shown besides: loaded with a burst."""
        return tuple(Shot(pattern, 0.0) for pattern in (BLACK, WHITE)) if self._active else ()

    def again(self, unit: Unit) -> Unit:
        """Return how a unit is taken again: after white and black, which tell whether the light has changed."""
        self.findings.again += 1
        marked = marked_again(unit, seed=f"{self._seed}/again/{self.findings.again}")
        if any(p.witness in (Witness.WHITE, Witness.BLACK) for p in unit.planned):
            return marked
        wanted: dict[float, tuple[Shot, list[str]]] = {}
        for camera in dict.fromkeys(c for p in unit.planned for c in p.cameras):
            exposure = exposure_of(unit.planned[0].shot)
            fields = nearest(self._known.fields.get(camera, ()), exposure)
            if fields is not None:
                shot = self._lights[camera][fields.exposure]
                wanted.setdefault(fields.exposure, (shot, []))[1].append(camera)
        return with_fields(marked, [(shot, tuple(names)) for shot, names in wanted.values()])

    def last_look(self) -> list[Planned]:
        """Return the exposures that end a stage: white as each camera saw it first; none where nothing was exposed."""
        return self._as_first(WHITE, Witness.WHITE, [*self._known.first])

    def second_look(self) -> list[Planned]:
        """Return black for the cameras for which white has drifted, or can't tell: it says why."""
        drifts = self.findings.drifts
        doubtful = [c for c in self._whites if abs(drifts.get(c, inf)) > DRIFT_LIMIT]
        return self._as_first(BLACK, Witness.BLACK, doubtful)

    def _as_first(
        self, pattern: Uniform, witness: Witness, cameras: Sequence[str]
    ) -> list[Planned]:
        by_exposure: dict[float, list[str]] = {}
        for camera in cameras:
            by_exposure.setdefault(self._known.first[camera].exposure, []).append(camera)
        return [
            Planned(replace(shot, pattern=pattern, mask=None, role=witness.value), tuple(names), witness=witness)
            for exposure, names in by_exposure.items()
            for shot in (self._lights[names[0]][exposure],)
        ]  # fmt: skip

    # what came of it

    def judge(
        self, unit: Unit, frames: Sequence[Mapping[str, Frame]], burst: Sequence[Shot]
    ) -> Violation | None:
        """Judge a unit's frames; they are noted if they are right."""
        if not self._active:
            return None
        found = Findings()
        looks: dict[str, Look] = {}
        for camera in dict.fromkeys(c for planned in unit.planned for c in planned.cameras):
            look = Look(self._known, camera, unit, frames, burst, found)
            violation = look.judge()
            if violation is not None:
                alone = self._others_are_right(camera, unit, frames, burst)
                return replace(violation, cause=Cause.CAMERA) if alone else violation
            looks[camera] = look
        for camera, look in looks.items():
            self._known.take_in(camera, look.fields)
            self._known.before[camera] = look.last
            self._known.common |= look.common
            self._known.levels |= look.levels
        self.findings.note(found)
        self.told = _written(found)
        return None

    def recall(self, told: Mapping[str, object]) -> None:
        """Take in what was found of a frame when it came."""
        self._recalled.note(_read(told))

    def _others_are_right(
        self,
        camera: str,
        unit: Unit,
        frames: Sequence[Mapping[str, Frame]],
        burst: Sequence[Shot],
    ) -> bool:
        """Tell whether other cameras saw in the same exposures what was to be seen."""
        others = [c for p in unit.planned for c in p.cameras if c != camera]
        for other in dict.fromkeys(others):
            found = Findings()
            if Look(self._known, other, unit, frames, burst, found).judge() is not None:
                return False
            if not (found.sets or found.markers):
                return False
        return bool(others)

    def blame(self, violations: Sequence[Violation]) -> Cause:
        """Say what is to blame for a unit that was never right."""
        causes = [violation.cause for violation in violations]
        if set(causes) == {Cause.CAMERA}:
            return Cause.CAMERA
        if causes.count(Cause.STILL) > 1:
            return Cause.STILL
        if Cause.DISPLAY in causes:
            return Cause.DISPLAY
        changed = any(violation.camera in self._known.changed for violation in violations)
        return Cause.LIGHT if changed or Cause.LIGHT in causes else Cause.UNKNOWN

    def judge_white(self, frames: Mapping[str, Frame]) -> None:
        """Compare the last white with the first."""
        for camera, frame in frames.items():
            fields, now = self._known.first[camera], sample_of(frame)
            self._whites[camera] = now
            change = drift(fields.white, now, fields)
            if change is not None:
                self.findings.drifts[camera] = change
                self._note_movement(camera, movement(fields, now, None))

    def judge_black(self, frames: Mapping[str, Frame]) -> None:
        """Compare the last black with the first; what moved is told by white without it."""
        for camera, frame in frames.items():
            fields, now = self._known.first[camera], sample_of(frame)
            change = drift(fields.black, now, fields)
            if change is not None:
                self.findings.dark_drifts[camera] = change
            self._note_movement(camera, movement(fields, self._whites[camera], now))

    def _note_movement(self, camera: str, moved: Movement | None) -> None:
        self.findings.movements.pop(camera, None)
        if moved is not None:
            self.findings.movements[camera] = moved

    def checks(self) -> tuple[Check, ...]:
        """Return the verdict, beside the stage's own; empty where nothing was exposed."""
        found = self.findings
        found.note(self._recalled)
        self._recalled = Findings()
        if not found.frames:
            return ()
        for camera, fields in self._known.fields.items():
            if not any(f.seen for f in fields):
                found.unseen[camera] = _why_unseen(fields[0])
        return (_synchronisation(found), *_drift(found), *_stillness(found))


_DEVIATION, _MARKER, _UNTOLD = "sync_deviation", "sync_marker", "sync_untold"
"""What a frame's metadata say of its set, of the marker beside it, and whether only that tells of it."""
_LIT = "sync_lit"
"""Whether a white marker was lit beside it."""


def _written(found: Findings) -> dict[str, object]:
    return {
        **({_DEVIATION: found.deviation} if found.sets else {}),
        **({_MARKER: found.marker} if found.markers else {}),
        **({_LIT: True} if found.lit else {}),
        _UNTOLD: found.untold > 0,
    }


def _read(told: Mapping[str, object]) -> Findings:
    deviation, marker, untold = (told.get(name) for name in (_DEVIATION, _MARKER, _UNTOLD))
    return Findings(
        sets=int(isinstance(deviation, float)),
        deviation=deviation if isinstance(deviation, float) else 0.0,
        markers=int(isinstance(marker, float)),
        marker=marker if isinstance(marker, float) else 0.0,
        lit=int(told.get(_LIT) is True),
        frames=int(untold is not None),
        untold=int(untold is True),
    )


def _is_judged_by_fields(planned: Planned) -> bool:
    if planned.witness is Witness.MARKER:
        return True
    shot = planned.shot
    return isinstance(shot.pattern, Uniform) and shot.mask is None


def _why_unseen(fields: Fields) -> str:
    if float(fields.black.gray.mean()) > 0.9 * fields.black.full_scale_gray:
        return "is saturated where nothing is projected, too: expose shorter, or darken the room"
    return "sees too little of the projector's light to tell whether frames are late"


def _synchronisation(found: Findings) -> Check:
    again = f"; {found.again} times frames were wrong and taken again" if found.again else ""
    unseen = "".join(f"; camera {name} {why}" for name, why in found.unseen.items())
    if not found.sets and not found.markers and not found.lit:
        sentence = (
            "the cameras see too little of the projector's light to tell whether frames are late"
        )
        if any(not why.startswith("sees") for why in found.unseen.values()):
            sentence = unseen.removeprefix("; ")
        return Check(SYNCHRONISATION, Level.OK, sentence + again)
    parts = []
    if found.sets:
        parts.append(f"sets deviate by {found.deviation:.1%} at most")
    if found.markers:
        parts.append(f"markers are dark ({found.marker:.1%} of the light)")
    if found.lit:
        parts.append("white markers are lit")
    if found.untold:
        parts.append(f"of {found.untold} frames only markers tell")
    sentence = f"frames show what they were taken for: {', '.join(parts)}{unseen}{again}"
    return Check(SYNCHRONISATION, Level.OK, sentence, found.deviation, SET_LIMIT)


def _drift(found: Findings) -> tuple[Check, ...]:
    if not found.drifts:
        return _dark_drift(found)
    camera = max(found.drifts, key=lambda name: abs(found.drifts[name]))
    change, dark = found.drifts[camera], found.dark_drifts.get(camera)
    sentence = f"white has changed by {change:+.1%} of the projector's light in camera {camera}"
    failure = NO_DRIFT
    if abs(change) > DRIFT_LIMIT:
        sentence += f", black by {dark:+.1%}" if dark is not None else ""
        if dark is not None and abs(dark) > abs(change) / 2 and is_light(change, dark):
            sentence += f": {_ROOM}"
            failure = inf
        elif abs(change) > NO_DRIFT:
            sentence += f": {_COVERED}"
        else:
            sentence += f": {_LAMP}"
    return (at_most(DRIFT, abs(change), warning=DRIFT_LIMIT, failure=failure, sentence=sentence),)


def _dark_drift(found: Findings) -> tuple[Check, ...]:
    """Tell of black where white is saturated."""
    if not found.dark_drifts:
        return ()
    camera = max(found.dark_drifts, key=lambda name: abs(found.dark_drifts[name]))
    change = found.dark_drifts[camera]
    sentence = f"black has changed by {change:+.1%} of the projector's light in camera {camera}"
    if abs(change) > DRIFT_LIMIT:
        sentence += f": {_ROOM}"
    return (at_most(DRIFT, abs(change), warning=DRIFT_LIMIT, failure=inf, sentence=sentence),)


def _stillness(found: Findings) -> tuple[Check, ...]:
    if not found.movements:
        return ()
    camera = max(found.movements, key=lambda name: _severity(found.movements[name]))
    moved = found.movements[camera]
    shift_px = _moved_px(moved)
    sentence = f"the picture has moved by {shift_px:.2f} px in camera {camera}"
    is_other = moved.share > CHANGED_LIMIT
    if is_other:
        sentence += f" or more, {moved.share:.0%} of the light are elsewhere"
    if not is_other and shift_px <= MOVED_LIMIT_PX:
        return (Check(STILLNESS, Level.OK, sentence, shift_px, MOVED_LIMIT_PX, "px"),)
    sentence += ": fasten part, camera and projector, and take the stage again"
    return (Check(STILLNESS, Level.WARNING, sentence, shift_px, MOVED_LIMIT_PX, "px"),)


def _moved_px(moved: Movement) -> float:
    return float(np.hypot(moved.x_px, moved.y_px))


def _severity(moved: Movement) -> float:
    return max(_moved_px(moved) / MOVED_LIMIT_PX, moved.share / CHANGED_LIMIT)
