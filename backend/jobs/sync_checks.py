"""Watching over the frames of a capturing stage: whether each shows what it was taken for.

Where light isn't certain by construction, a display may lag, tear or drop a pattern, and the scan looks valid. So white
and black are exposed before the first burst, a black marker in every burst, and white after the last; step sets and
pairs of pattern and inverse are compared with themselves (`backend.numerics.sync_checks` explains how).
"""

from collections.abc import Mapping, Sequence

from backend.devices.protocols import Frame
from backend.domain.checks import Check, at_most
from backend.domain.patterns import BLACK, WHITE
from backend.domain.shots import Shot
from backend.domain.states import Level
from backend.jobs.sync_look import (
    SET_LIMIT,
    Findings,
    Known,
    Look,
    Violation,
    exposure_of,
    sample_of,
)
from backend.jobs.sync_sets import Planned, Unit, Witness, marked_again, units_of
from backend.numerics.sync_checks import drift

DRIFT_LIMIT = 0.02
NO_DRIFT = 0.3
"""No lamp changes by that much within a stage: the display shows something else."""
SYNCHRONISATION, DRIFT = "synchronisation", "drift"
"""Names of the checks that tell what was found."""
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
        self._white: Planned | None = None
        self.findings = Findings()

    # what is exposed

    def units(self, burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]]) -> list[Unit]:
        """Cut what has to be taken of a burst into units."""
        if not self._active:
            return [Unit((Planned(burst[n], names, n),), ()) for n, names in cameras.items()]
        self._known.common.clear()
        self._known.levels.clear()
        self._bursts += 1
        seed = f"{self._seed}/{self._bursts}"
        return units_of(burst, cameras, seed=seed, first=self._witnesses(burst, cameras))

    def _witnesses(
        self, burst: Sequence[Shot], cameras: Mapping[int, tuple[str, ...]]
    ) -> tuple[Planned, ...]:
        """Expose white and black for cameras that haven't seen them yet, as short as the burst allows."""
        new = dict.fromkeys(
            c for names in cameras.values() for c in names if c not in self._known.fields
        )
        if not new:
            return ()
        shortest = min((burst[n] for n in cameras), key=exposure_of)
        shown = ((WHITE, Witness.WHITE), (BLACK, Witness.BLACK))
        white, black = (
            Planned(
                Shot(pattern, shortest.exposure_ms, shortest.gain_db, role=witness.value),
                tuple(new),
                witness=witness,
            )
            for pattern, witness in shown
        )
        self._white = self._white or white
        return white, black

    @property
    def markers(self) -> tuple[Shot, ...]:
        """What may have to be shown besides: loaded with a burst."""
        return tuple(Shot(pattern, 0.0) for pattern in (BLACK, WHITE)) if self._active else ()

    def again(self, unit: Unit) -> Unit:
        """Return how a unit is taken again."""
        self.findings.again += 1
        return marked_again(unit, seed=f"{self._seed}/again/{self.findings.again}")

    @property
    def last_white(self) -> Planned | None:
        """The exposure that ends a stage: the first one again; None where nothing was exposed."""
        return self._white

    @property
    def last_black(self) -> Planned | None:
        """Black, to tell what has drifted."""
        if self._white is None:
            return None
        shot = self._white.shot
        return Planned(
            Shot(BLACK, shot.exposure_ms, shot.gain_db, role="black"),
            self._white.cameras,
            witness=Witness.BLACK,
        )

    # what came of it

    def judge(
        self, unit: Unit, frames: Sequence[Mapping[str, Frame]], burst: Sequence[Shot]
    ) -> Violation | None:
        """Judge a unit's frames; they are noted if they are right."""
        if not self._active:
            return None
        found = Findings()
        cameras = dict.fromkeys(c for planned in unit.planned for c in planned.cameras)
        for camera in cameras:
            look = Look(self._known, camera, unit, frames, burst, found)
            violation = look.judge()
            if violation is not None:
                return violation
            self._known.before[camera] = look.last
            self._known.common |= look.common
            self._known.levels |= look.levels
        self.findings.note(found)
        return None

    def judge_drift(
        self, white: Mapping[str, Frame], black: Mapping[str, Frame] | None = None
    ) -> bool:
        """Compare the last white (and black) with the first; returns whether white has drifted notably."""
        for camera, frame in white.items():
            fields = self._known.fields.get(camera)
            if fields is None or not fields.seen:
                continue
            change = drift(fields.white, sample_of(frame), fields)
            if change is not None:
                self.findings.drifts[camera] = change
        for camera, frame in (black or {}).items():
            fields = self._known.fields.get(camera)
            change = drift(fields.black, sample_of(frame), fields) if fields else None
            if change is not None:
                self.findings.dark_drifts[camera] = change
        return any(abs(change) > DRIFT_LIMIT for change in self.findings.drifts.values())

    def checks(self) -> tuple[Check, ...]:
        """Return the verdict, beside the stage's own; empty where nothing was exposed."""
        found = self.findings
        if not self._active or not found.frames:
            return ()
        return (_synchronisation(found), *_drift(found))


def _synchronisation(found: Findings) -> Check:
    again = f"; {found.again} times frames were wrong and taken again" if found.again else ""
    if not found.sets and not found.markers:
        sentence = (
            "the cameras see too little of the projector's light to tell whether frames are late"
        )
        return Check(SYNCHRONISATION, Level.OK, sentence + again)
    parts = []
    if found.sets:
        parts.append(f"sets deviate by {found.deviation:.1%} at most")
    if found.markers:
        parts.append(f"markers are dark ({found.marker:.1%} of the light)")
    sentence = f"frames show what they were taken for: {', '.join(parts)}{again}"
    return Check(SYNCHRONISATION, Level.OK, sentence, found.deviation, SET_LIMIT)


def _drift(found: Findings) -> tuple[Check, ...]:
    if not found.drifts:
        return ()
    camera = max(found.drifts, key=lambda name: abs(found.drifts[name]))
    change, dark = found.drifts[camera], found.dark_drifts.get(camera)
    sentence = f"white has changed by {change:+.1%} of the projector's light in camera {camera}"
    if abs(change) > DRIFT_LIMIT:
        room = dark is not None and abs(dark) > abs(change) / 2
        cause = f", black by {dark:+.1%}" if dark is not None else ""
        remedy = (
            "keep the room's light steady"
            if room
            else "let the lamp warm up, and check that nothing was moved"
        )
        if abs(change) > NO_DRIFT:
            remedy = "the display lags, or something covers it; measure its latency, and take the stage again"
        sentence += f"{cause}: {remedy}"
    return (at_most(DRIFT, abs(change), warning=DRIFT_LIMIT, failure=NO_DRIFT, sentence=sentence),)
