"""Drive capture plans: frames from the journal where it has them, from the rig where it doesn't.

Driving a plan again with journalled frames is resume after a crash, undo, partial re-capture and replay in one:
plans are deterministic, so the same frames lead to the same shots.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import isfinite
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from backend.devices.errors import DeviceError, OutOfSync
from backend.devices.protocols import Frame as DeviceFrame
from backend.domain.checks import Check
from backend.domain.errors import (
    InvalidCaptureError,
    RigFailedError,
    StageFailedError,
)
from backend.domain.frames import Frame, InMemory, Pixels, identity
from backend.domain.patterns import Pattern
from backend.domain.rig import RigFacts
from backend.domain.shots import Burst, Exposed, OneOf, Plan, Shot, Until
from backend.jobs.control import JobControl
from backend.jobs.evidence import KeepEvidence, chosen, no_evidence
from backend.jobs.journal import Journal, shot_document, shot_hash
from backend.jobs.pace import Pace, Series
from backend.jobs.rendering import render
from backend.jobs.shooting import Shooter, Take
from backend.jobs.sync_checks import TRIES, SyncWatch
from backend.jobs.sync_look import Cause, Violation
from backend.jobs.sync_sets import Planned, Unit, Witness
from backend.storage.artifacts import ArtifactStore, StoredPixels
from backend.storage.rows import FrameRow

log = logging.getLogger(__name__)

T = TypeVar("T")

_DISPLAY = "the display is late, torn or not lit"
_LIGHT = "the light changes from frame to frame"
_STEADY = (
    "darken the room or keep its lamps steady (those on mains flicker 100 or 120 times a second: expose for whole periods of"
    " that), let the projector's lamp warm up, and see that the camera doesn't set its exposure or gain itself"
)

_STILL = "white isn't brighter than black any more: the display stands still or is off, or something covers it or the lens"
_EARLIER = "the other cameras saw what was shown at the same time"
_ALONE = (
    "see that this camera isn't covered, exposes at its trigger and doesn't set its exposure itself, and that its driver hands"
    " out no frame that was waiting"
)

_MOST_UNWRITTEN = 4
"""Shots that may wait to be written: memory for a disk that is slow now and then, no more."""


@runtime_checkable
class Seen(Protocol):
    """Is told of every picture at once: for the live preview and the event stream."""

    def __call__(self, camera: str, frame: DeviceFrame, row: FrameRow | None) -> None:
        """Look at a picture; `row` is None if it isn't kept. Must not block."""
        ...


def _unseen(camera: str, frame: DeviceFrame, row: FrameRow | None) -> None:
    """Look at nothing."""


@dataclass(frozen=True)
class _Asked:
    """One camera's share of a shot: which frame of the journal it is."""

    shot: Shot
    camera: str
    mask_hash: str | None
    id: str
    occurrence: int


_Frames = Mapping[str, DeviceFrame]
"""What one exposure brought, by camera."""


@dataclass
class CaptureSession:
    """Everything that one run of a capturing stage needs to drive its plans.

    `run_plan` may be called several times; a shot that is asked for again is a new occurrence, across plans.
    Where the rig's light isn't certain, frames are verified before they count (`SyncWatch`); `finish` ends that.
    """

    scan: str
    stage: str
    take: int
    facts: RigFacts
    journal: Journal
    store: ArtifactStore
    shooter: Shooter | None
    """None: nothing is captured, every frame has to be in the journal (a replay)."""
    control: JobControl = field(default_factory=JobControl)
    seen: Seen = _unseen
    evidence: KeepEvidence = no_evidence
    """Where frames go that couldn't be verified."""
    clock: Callable[[], float] = time.monotonic
    _occurrences: Counter[str] = field(default_factory=Counter, init=False)
    _masks: dict[Hashable, tuple[Pixels, str]] = field(default_factory=dict, init=False)
    _loaded: tuple[str, ...] = field(default=(), init=False)
    _watch: SyncWatch = field(init=False)
    _unverified: int = field(default=0, init=False)
    """Frames that are kept as evidence."""
    _series: Series = field(default_factory=Series, init=False)
    """The bursts that the present one is one of."""

    def __post_init__(self) -> None:
        """Watch over what is captured, unless its light is certain."""
        uncertain = self.shooter is not None and not self.shooter.certain
        self._watch = SyncWatch(f"{self.scan}/{self.stage}/{self.take}", active=uncertain)

    def run_plan(self, plan: Plan[T]) -> T:
        """Drive a plan to its end and return what it learnt.

        Raises
        ------
        CancelledError
            Between two shots, or while one is waited for.
        RigFailedError
            If a device gives up. The frames captured before are kept.
        StageFailedError
            If what `Until` waits for doesn't come, or a pattern can't be rendered.
        """
        try:
            request = next(plan)
            while True:
                self.control.check()
                request = plan.send(self._answer(request))
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # a generator's return value has no type here
        finally:
            plan.close()

    def finish(self) -> tuple[Check, ...]:
        """Take the last look at the light, and return what was found of the frames; empty where nothing was captured.

        Raises
        ------
        CancelledError
            If the job is stopped.
        """
        if self.shooter is not None and self._watch.last_look():
            try:
                self._load(self._watch.markers)
                for white in self._watch.last_look():
                    self._watch.judge_white(self._witness(white))
                for black in self._watch.second_look():
                    self._watch.judge_black(self._witness(black))
            except DeviceError as error:
                # The frames are all there: a witness is no reason to lose them.
                self.control.check()
                log.warning("The last look at the light of %s failed: %s", self.stage, error)
        return self._watch.checks()

    def _witness(self, planned: Planned) -> _Frames:
        assert self.shooter is not None  # `finish` looked
        self.control.shots(None, "a last look at the light", None)
        return self.shooter.take_all([self._take_of(planned)])[0]

    def _answer(self, request: Burst | OneOf | Until) -> tuple[Exposed, ...]:
        if isinstance(request, Until):
            return (self._until(request),)
        if isinstance(request, OneOf):
            self._series = self._series.followed_by(request)
            return self._burst(request.burst)
        self._series = Series()
        return self._burst(request)

    # bursts

    def _burst(self, burst: Burst) -> tuple[Exposed, ...]:
        asked = [self._ask(shot) for shot in burst]
        known = [self._known(shares) for shares in asked]
        self._recall(row for rows in known for row in rows.values())
        missing = {
            i: [share for share in shares if share.camera not in known[i]]
            for i, shares in enumerate(asked)
            if len(known[i]) < len(shares)
        }
        try:
            taken = self._capture(burst, missing)
        except DeviceError as error:
            raise self._failed(error) from error
        return tuple(
            {
                share.camera: self._frame(share, (known[i] | taken.get(i, {}))[share.camera])
                for share in shares
            }
            for i, shares in enumerate(asked)
        )

    def _capture(
        self, burst: Burst, missing: Mapping[int, Sequence[_Asked]]
    ) -> dict[int, dict[str, FrameRow]]:
        """Take the shots that aren't in the journal; some are written while the next are exposed.

        Whatever ends this, what was exposed and verified is written first.
        """
        if not missing:
            return {}
        cameras = {i: tuple(share.camera for share in shares) for i, shares in missing.items()}
        units = self._watch.units(burst, cameras)
        self._load(
            [
                *(planned.shot for unit in units for planned in unit.planned),
                *self._watch.markers,
            ]
        )
        writes: list[Future[dict[int, dict[str, FrameRow]]]] = []
        most = 1 + (_MOST_UNWRITTEN - 1) // max(len(unit.planned) for unit in units)
        with ThreadPoolExecutor(1, thread_name_prefix="journal") as writer:
            for unit, frames in self._verified(units, burst, kept=len(burst) - len(missing)):
                if len(writes) >= most:
                    writes[-most].result()
                told = self._watch.told
                writes.append(writer.submit(self._keep_unit, unit, frames, missing, told))
        return {i: rows for write in writes for i, rows in write.result().items()}

    def _verified(
        self, units: Sequence[Unit], burst: Burst, *, kept: int
    ) -> Iterator[tuple[Unit, Sequence[_Frames]]]:
        """Expose unit after unit; one whose frames aren't right is taken again, a few times."""
        assert self.shooter is not None  # `_load` refused otherwise
        planned = [p for unit in units for p in unit.planned]
        pace = Pace([p.shot.exposure_ms for p in planned], self.clock)
        if self._series.count > 1 and not kept:
            self._series = self._series.begun(self.clock())
        done = 0
        chunks = self.shooter.chunks([self._take_of(p) for p in planned])
        waiting: deque[_Frames] = deque()
        for unit in units:
            while len(waiting) < len(unit.planned):
                chunk = next(chunks)
                self._tell(pace, done, planned, len(burst), kept=kept)
                try:
                    waiting.extend(self.shooter.take_all(chunk))
                except DeviceError as error:
                    # What waits for the rest of its set can't be verified any more.
                    self._keep_evidence(error, planned[done - len(waiting) : done], waiting)
                    raise
                done += len(chunk)
            frames = [waiting.popleft() for _ in unit.planned]
            yield self._right(unit, frames, burst)

    def _right(
        self, unit: Unit, frames: Sequence[_Frames], burst: Burst
    ) -> tuple[Unit, Sequence[_Frames]]:
        """Judge a unit's frames, and take them again if they aren't right; what was taken is returned.

        Raises
        ------
        OutOfSync
            If they never are.
        """
        assert self.shooter is not None  # `_load` refused otherwise
        violations: list[Violation] = []
        while True:
            violation = self._watch.judge(unit, frames, burst)
            if violation is None:
                return unit, frames
            violations.append(violation)
            if len(violations) == 1:
                first = unit, frames
            if len(violations) == TRIES:
                error = self._out_of_sync(violations, first[0].planned)
                self._keep_evidence(error, first[0].planned, first[1], violations[0].number)
                raise error
            self.control.note(f"{violation.camera}: {violation.sentence}; taken again")
            log.warning(
                "%s/%s, camera %s: %s; taken again",
                self.scan, self.stage, violation.camera, violation.sentence,
            )  # fmt: skip
            unit = self._watch.again(unit)
            takes = [self._take_of(planned) for planned in unit.planned]
            chunks = self.shooter.chunks(takes)
            try:
                frames = [taken for chunk in chunks for taken in self.shooter.take_all(chunk)]
            except DeviceError as error:
                self._keep_evidence(error, first[0].planned, first[1], violations[0].number)
                raise

    def _keep_evidence(
        self,
        error: DeviceError,
        planned: Sequence[Planned],
        frames: Sequence[_Frames],
        number: int | None = None,
    ) -> None:
        """Keep exposures that don't count, to be looked at; whatever hinders that isn't what the operator has to know."""
        kept = chosen(planned, frames, number)
        try:
            documents = [
                {
                    **shot_document(one.planned.shot, self._mask_hash(one.planned.shot.mask)),
                    "camera": one.camera,
                    "number": one.planned.number,
                    "take": self.take,
                    "artifact": self.store.put(np.ascontiguousarray(one.frame.data)).hash,
                    "bit_depth": one.frame.bits,
                    "metadata": _metadata(one.frame),
                }
                for one in kept
            ]
            if documents and self.evidence(error.sentence, documents):
                self._unverified += len(documents)
        except Exception as hindrance:  # noqa: BLE001  a full disk, a scan that is gone: the error that led here says more
            log.warning("Frames that couldn't be verified aren't kept: %s", hindrance)

    def _recall(self, rows: Iterable[FrameRow]) -> None:
        """Take in what was found of frames when they came: a verdict that holds for whatever is made of them."""
        for row in rows:
            self._watch.recall(row.metadata)

    def _out_of_sync(
        self, violations: Sequence[Violation], planned: Sequence[Planned]
    ) -> OutOfSync:
        """Say which frame was wrong first, and what is to blame; `planned` is what was looked at with it."""
        assert self.shooter is not None  # `_load` refused otherwise
        first = violations[0]
        cause = self._watch.blame(violations)
        looked_at = [p for p in planned if first.number in (None, p.number)]
        off_grid = (self.shooter.off_grid(p.cameras, p.shot.exposure_ms) for p in looked_at)
        grid = "" if cause is Cause.STILL else next(filter(None, off_grid), "")
        reason = {
            Cause.DISPLAY: f"{_DISPLAY}; {self.shooter.way_out}",
            Cause.LIGHT: f"{_LIGHT}; {_STEADY}",
            Cause.STILL: f"{_STILL}; {self.shooter.way_out}",
            Cause.CAMERA: f"{_EARLIER}; {_ALONE}",
            Cause.UNKNOWN: f"{_DISPLAY}, or the room's light has changed; {self.shooter.way_out}",
        }[cause]
        if grid:
            reason = f"{grid}; if that isn't it, {reason}"
        return OutOfSync(
            first.camera,
            f"{first.sentence}, and taken again it wasn't right in {TRIES} tries: {reason}",
        )

    def _take_of(self, planned: Planned) -> Take:
        shot = planned.shot
        return Take(
            self._loaded.index(_picture_id(shot.pattern, self._mask_hash(shot.mask))),
            shot.exposure_ms,
            shot.gain_db,
            planned.cameras,
            steady=planned.witness in (Witness.WHITE, Witness.BLACK),
        )

    def _keep_unit(
        self,
        unit: Unit,
        frames: Sequence[_Frames],
        missing: Mapping[int, Sequence[_Asked]],
        told: Mapping[str, object],
    ) -> dict[int, dict[str, FrameRow]]:
        """Write what the plan asked for of a unit, together."""
        taken = [
            (share, exposed[share.camera])
            for planned, exposed in zip(unit.planned, frames, strict=True)
            if planned.number is not None
            for share in missing[planned.number]
        ]
        rows = iter(self._keep(taken, told))
        return {
            planned.number: {share.camera: next(rows) for share in missing[planned.number]}
            for planned in unit.planned
            if planned.number is not None
        }

    def _ask(self, shot: Shot) -> list[_Asked]:
        mask_hash = self._mask_hash(shot.mask)
        shares = []
        for camera in shot.cameras or tuple(self.facts.cameras):
            if camera not in self.facts.cameras:
                known = ", ".join(self.facts.cameras)
                raise StageFailedError(
                    f"{self.stage} asks for camera {camera!r}, the rig has {known}."
                )
            identity = shot_hash(shot, camera, mask_hash)
            shares.append(_Asked(shot, camera, mask_hash, identity, self._occurrences[identity]))
            self._occurrences[identity] += 1
        return shares

    def _known(self, shares: Sequence[_Asked]) -> dict[str, FrameRow]:
        found = {s.camera: self.journal.find(s.id, s.occurrence) for s in shares}
        return {camera: row for camera, row in found.items() if row is not None}

    def _expose(
        self, shares: Sequence[_Asked], *, steady: bool
    ) -> list[tuple[_Asked, DeviceFrame]]:
        shot = shares[0].shot
        assert self.shooter is not None  # `_load` refused otherwise
        frames = self.shooter.take(
            self._loaded.index(_picture_id(shot.pattern, shares[0].mask_hash)),
            exposure_ms=shot.exposure_ms,
            gain_db=shot.gain_db,
            cameras=[share.camera for share in shares],
            steady=steady,
        )
        return [(share, frames[share.camera]) for share in shares]

    def _keep(
        self, taken: Sequence[tuple[_Asked, DeviceFrame]], told: Mapping[str, object]
    ) -> list[FrameRow]:
        """Write pictures, then their lines in the journal: a crash between the two loses them, nothing else."""
        rows = [self._row(share, frame, told) for share, frame in taken]
        self.journal.add(tuple(rows))
        for (share, frame), row in zip(taken, rows, strict=True):
            self.seen(share.camera, frame, row)
        return rows

    def _row(self, share: _Asked, frame: DeviceFrame, told: Mapping[str, object]) -> FrameRow:
        return FrameRow(
            scan=self.scan,
            stage=self.stage,
            take=self.take,
            shot=share.id,
            occurrence=share.occurrence,
            camera=share.camera,
            document=shot_document(share.shot, share.mask_hash),
            artifact=self.store.put(np.ascontiguousarray(frame.data)).hash,
            bit_depth=frame.bits,
            when=datetime.now(UTC),
            metadata={**_metadata(frame), **told},
        )

    def _frame(self, share: _Asked, row: FrameRow) -> Frame:
        """Hand out a frame with the exposure and gain that the camera really used."""
        return Frame(
            camera=share.camera,
            pattern=share.shot.pattern,
            exposure_ms=row.metadata["exposure_us"] / 1000.0,
            pixels=StoredPixels(self.store, row.artifact),
            bit_depth=row.bit_depth,
            gain_db=row.metadata["gain_db"],
            role=share.shot.role,
        )

    # waiting for an operator or a condition

    def _until(self, request: Until) -> Exposed:
        shares = self._ask(request.shot)
        rows = self._known(shares)
        self._recall(rows.values())
        if len(rows) < len(shares):
            try:
                rows = self._wait(request, shares)
            except DeviceError as error:
                raise self._failed(error) from error
        return {share.camera: self._frame(share, rows[share.camera]) for share in shares}

    def _wait(self, request: Until, shares: Sequence[_Asked]) -> dict[str, FrameRow]:
        """Repeat a shot until its picture is wanted; one that isn't right, or not lit, isn't offered again."""
        burst = (request.shot,)
        (unit,) = self._watch.units(burst, {0: tuple(share.camera for share in shares)})
        self._load([request.shot, *self._watch.markers])
        deadline = self.clock() + request.timeout_s
        # Fields and marker come first, in the order of their own; the picture may be long in coming.
        besides = [self._besides(planned) for planned in unit.planned if planned.number is None]
        violations: list[Violation] = []
        is_lit = not besides
        while True:
            self.control.shots(None, f"waiting, {request.shot.role or 'picture'} by picture", None)
            taken = self._expose(shares, steady=not is_lit)
            frames = {share.camera: frame for share, frame in taken}
            is_lit = True
            if request.ready({share.camera: _unsaved(share, frame) for share, frame in taken}):
                others = iter(besides)
                shown = [frames if p.number is not None else next(others) for p in unit.planned]
                violation = self._watch.judge(unit, shown, burst)
                if violation is None:
                    rows = self._keep(taken, self._watch.told)
                    return {share.camera: row for share, row in zip(shares, rows, strict=True)}
                violations.append(violation)
                if len(violations) == TRIES:
                    error = self._out_of_sync(violations, unit.planned)
                    self._keep_evidence(error, unit.planned, shown)
                    raise error
                self.control.note(f"{violation.camera}: {violation.sentence}; taken again")
                unit = self._watch.again(unit)
                besides = [self._besides(p) for p in unit.planned if p.number is None]
                is_lit = False
            for share, frame in taken:
                self.seen(share.camera, frame, None)
            if self.clock() >= deadline:
                raise StageFailedError(
                    f"{self.stage} waited {request.timeout_s:g} s for a usable picture and none came: "
                    f"look at the live picture and run again."
                )

    def _besides(self, planned: Planned) -> _Frames:
        """Expose what nobody asked for."""
        assert self.shooter is not None  # `_load` refused otherwise
        return self.shooter.take_all([self._take_of(planned)])[0]

    # what the projector gets

    def _load(self, shots: Sequence[Shot]) -> None:
        """Render what isn't loaded. Bursts that show the same patterns at other exposures load them once."""
        if not shots:
            return
        if self.shooter is None:
            raise InvalidCaptureError(
                f"The captured frames lack {_named(shots[0])} of {self.stage}: capture again, "
                f"or use the settings that they were captured with."
            )
        wanted = {_picture_id(s.pattern, self._mask_hash(s.mask)): s for s in shots}
        if not set(wanted) <= set(self._loaded):
            self.shooter.load([self._picture(s, self.shooter) for s in wanted.values()])
            self._loaded = tuple(wanted)

    def _picture(self, shot: Shot, shooter: Shooter) -> np.ndarray[Any, np.dtype[np.uint8]]:
        width_px, height_px = shooter.projector_size
        return render(
            shot.pattern,
            width_px=width_px,
            height_px=height_px,
            gamma=self.facts.projector.gamma if self.facts.projector else 1.0,
            mask=shot.mask.load() if shot.mask else None,
        )

    def _mask_hash(self, mask: Pixels | None) -> str | None:
        """Identify a mask by its content; the store keeps it, so that the journal can be understood."""
        if mask is None or isinstance(mask, StoredPixels):
            return mask.hash if mask else None
        known = identity(mask)
        if known not in self._masks:
            # Keeping the mask keeps its id from being given to another one.
            self._masks[known] = (mask, self.store.put(mask.load()).hash)
        return self._masks[known][1]

    # words

    def _tell(
        self, pace: Pace, done: int, planned: Sequence[Planned], size: int, *, kept: int
    ) -> None:
        """Tell how far a burst is; what is exposed besides is passed over."""
        before = kept + sum(p.number is not None for p in planned[:done])
        following = (p for p in planned[done:] if p.number is not None)
        shot = next(following, planned[done]).shot
        series = self._series
        share = series.share(before / size) if size > 1 or series.count > 1 else None
        text = f"{series.prefix}{_named(shot)}, {min(before + 1, size)} of {size}"
        self.control.shots(share, text, series.remaining_s(pace.remaining_s(done), self.clock))

    def _failed(self, error: DeviceError) -> RigFailedError:
        kept = len(self.journal)
        frames = "1 captured frame is" if kept == 1 else f"{kept} captured frames are"
        cause = error.sentence.removesuffix(".")
        beside = f" (and {self._unverified} that count for nothing, to look at)"
        return RigFailedError(
            f"{cause}; {frames} kept{beside if self._unverified else ''}, mend it and run again to go on.",
            details={"device": error.device},
        )


def _unsaved(share: _Asked, frame: DeviceFrame) -> Frame:
    return Frame(
        camera=share.camera,
        pattern=share.shot.pattern,
        exposure_ms=frame.exposure_us / 1000.0,
        pixels=InMemory(frame.data),
        bit_depth=frame.bits,
        gain_db=frame.gain_db,
        role=share.shot.role,
    )


def _picture_id(pattern: Pattern, mask_hash: str | None) -> str:
    return f"{pattern.model_dump_json()} {mask_hash}"


def _named(shot: Shot) -> str:
    return f"{shot.role or shot.pattern.kind} at {shot.exposure_ms:.4g} ms"


def _metadata(frame: DeviceFrame) -> dict[str, Any]:
    """Return what the camera told of a frame: numbers and texts, the rest of a driver's words stays out."""
    told: Mapping[str, object] = {
        **frame.metadata,
        "frame_id": frame.frame_id,
        "exposure_us": float(frame.exposure_us),
        "gain_db": float(frame.gain_db),
        "pixel_format": frame.pixel_format,
        "timestamp_s": frame.timestamp_s,
        "host_time_s": frame.host_time_s,
    }
    return {name: value for name, value in told.items() if _is_plain(value)}


def _is_plain(value: object) -> bool:
    if isinstance(value, float):
        return isfinite(value)
    return isinstance(value, str | int | bool)
