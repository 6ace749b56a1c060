"""Carry out one job: walk a scan's stages from the first that isn't current to the next gate or the end.

Nothing is kept in memory that the database doesn't know: the plan is made anew after every stage, so a killed
job continues where it was, and an edit made meanwhile counts.
"""

import logging
import platform
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol, runtime_checkable

from backend.contract.events import Event, FrameCaptured, JobProgress, ScanChanged
from backend.devices.protocols import Frame as DeviceFrame
from backend.devices.protocols import KnowsTruth, Rig
from backend.domain.checks import Check
from backend.domain.errors import CancelledError, UnglareError
from backend.domain.method import Method
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.stage import Stage
from backend.domain.states import JobStatus, Level, Verdict
from backend.jobs.calibrations import hand_over
from backend.jobs.capture import CaptureSession
from backend.jobs.control import JobControl, Live
from backend.jobs.device_threads import DeviceThreads
from backend.jobs.evidence import ACTION, MOST_LINES, evidence_of
from backend.jobs.journal import DatabaseJournal
from backend.jobs.live import LivePicture
from backend.jobs.loading import NO_RIG, LoadedScan, load_inputs, load_scan
from backend.jobs.plan import Gate, PlannedStage, next_step
from backend.jobs.rig_thread import wait_for
from backend.jobs.rigs import Owner, RigGiven, RigPool
from backend.jobs.sequence_shooting import shooter_of
from backend.jobs.shooting import Shooter
from backend.jobs.stage_work import (
    Outcome,
    StageDefectError,
    StageTask,
    conclude,
    decode_inputs,
    perform,
    stage_errors,
)
from backend.jobs.sync_checks import DRIFT, STILLNESS, SYNCHRONISATION
from backend.jobs.views import job_view
from backend.methods import Registry
from backend.storage.artifacts import ArtifactStore
from backend.storage.codec import content_hash, decode, encode
from backend.storage.database import Database
from backend.storage.repositories import Repositories
from backend.storage.rows import FrameRow, JobRow

log = logging.getLogger(__name__)


@runtime_checkable
class Compute(Protocol):
    """Runs a pure stage: here or in a worker process."""

    def __call__(self, task: StageTask, control: JobControl) -> Outcome:
        """Run a stage to its end; raises what `perform` raises, `CancelledError` if the job is stopped."""
        ...


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Return what a result may depend on beside its settings; stored with every run."""
    found = {"python": platform.python_version()}
    for name in ("unglare", "numpy", "numba", "scipy", "opencv-python-headless"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


@dataclass(frozen=True)
class Workshop:
    """What every job needs."""

    database: Database
    store: ArtifactStore
    rigs: RigPool
    registry: Callable[[], Registry]
    """A function of a module, so that a worker process can call it too."""
    publish: Callable[[Event], None] = lambda event: None
    versions: Mapping[str, str] = field(default_factory=versions)


def compute_inline(shop: Workshop) -> Compute:
    """Run pure stages in this process, in the job's thread."""

    def compute(task: StageTask, control: JobControl) -> Outcome:
        return perform(task, shop.registry(), shop.store, control.progress)

    return compute


def store_rig(
    repositories: Repositories,
    store: ArtifactStore,
    method: Method,
    scan: str,
    rig: RigGiven,
    declined: Collection[str] = (),
) -> None:
    """Hand a rig's facts, and its calibration if it has one, to a scan, and what is kept for the rig; once for all.

    `declined` are types of kept results that the scan doesn't want.
    """
    repositories.scans.lock(scan)
    known = repositories.given.of(scan)
    for kind, result in ((RigFacts, rig.facts), (RigCalibration, rig.calibration)):
        if result is not None and kind.__name__ not in known:
            document = encode(result, store)
            name = kind.__name__
            repositories.given.add(scan, name, name, document, content_hash(document))
    if RigFacts.__name__ not in known:
        hand_over(repositories, method, scan, declined)


@dataclass(frozen=True)
class _End:
    """How a job ends."""

    status: JobStatus
    text: str = ""
    error: str | None = None
    stage: str | None = None


class JobExecution:
    """One job, carried out by one thread."""

    def __init__(self, job: JobRow, shop: Workshop, compute: Compute) -> None:
        self._job = job
        self._shop = shop
        self._compute = compute
        self._failure_noted = False
        self.control = JobControl(self._tell)

    def execute(self) -> None:
        """Run until a gate, the end, a failure or a cancellation. Never raises."""
        try:
            end = self._guarded_walk()
            self._finish(end)
        except Exception:
            # The database refuses to note the end (a full disk): the next start finds the job interrupted.
            log.exception("Job %s ended and can't be noted", self._job.id)

    # the walk

    def _guarded_walk(self) -> _End:
        try:
            with self._writing() as repositories:
                self._job = repositories.jobs.update(self._job.id, status=JobStatus.RUNNING)
            return self._walk()
        except CancelledError as error:
            return self._stopped(error)
        except UnglareError as error:
            return _End(JobStatus.FAILED, error=error.sentence, stage=self._job.stage)
        except StageDefectError as error:
            log.error("%s\n%s", error.sentence, error.trace)
            return _End(JobStatus.FAILED, error=error.sentence, stage=self._job.stage)
        except Exception as error:
            log.exception("Job %s has a defect", self._job.id)
            sentence = f"Defect in the application: {type(error).__name__}: {error}; see the log."
            return _End(JobStatus.FAILED, error=sentence, stage=self._job.stage)

    def _walk(self) -> _End:
        while True:
            self.control.check()
            with self._shop.database.reading() as repositories:
                scan = load_scan(repositories, self._shop.registry(), self._job.scan)
            step = next_step(scan.plan, until=self._job.until, unattended=self._job.unattended)
            if step is None:
                return _End(JobStatus.FINISHED)
            if isinstance(step, Gate):
                return self._at_gate(step)
            if step.planned.key is None:
                self._open_rig(scan)
            else:
                self._run(step.planned, scan)

    def _at_gate(self, gate: Gate) -> _End:
        stage, decision = gate.planned.stage, gate.planned.decision
        if decision is not None and decision.verdict is Verdict.REJECT:
            text = f"{stage.title} was rejected: change a setting or redo it."
        else:
            text = f"{stage.title} waits for your decision."
        if not self._job.unattended:
            return _End(JobStatus.AWAITING_REVIEW, text, stage=stage.name)
        assert gate.planned.run is not None  # a gate is behind a result
        failed = [c["sentence"] for c in gate.planned.run.checks if c["level"] == Level.FAILURE]
        reason = f"{stage.title} failed its check: {failed[0]}." if failed else text
        return _End(JobStatus.FAILED, error=reason, stage=stage.name)

    def _open_rig(self, scan: LoadedScan) -> None:
        """Do what `create_scan` couldn't because the rig was busy."""
        asked = self._shop.rigs.ask(scan.row.rig, scan.row.rig_options)
        rig = wait_for(asked, self.control)
        with self._shop.database.transaction() as repositories:
            store_rig(repositories, self._shop.store, scan.method, scan.row.id, rig)

    # one stage

    def _run(self, planned: PlannedStage, scan: LoadedScan) -> None:
        self.control.begin_stage(planned.name)
        run, task = self._begin(planned, scan)
        began = time.monotonic()
        try:
            if planned.stage.captures:
                outcome = self._capture(planned, scan, task)
            else:
                outcome = self._compute(task, self.control)
        except Exception as error:
            self._note_failure(run, planned.stage, error)
            raise
        if outcome.seconds is None:
            outcome = replace(outcome, seconds=time.monotonic() - began)
        self._note_result(run, planned.stage, outcome)

    def _begin(self, planned: PlannedStage, scan: LoadedScan) -> tuple[str, StageTask]:
        assert planned.key is not None  # `_walk` opens the rig first
        with self._writing() as repositories:
            self._job = repositories.jobs.update(self._job.id, stage=planned.name)
            run = repositories.runs.start(
                scan.row.id,
                planned.name,
                planned.key,
                planned.take,
                self._job.id,
                versions=self._shop.versions,
            )
            inputs = load_inputs(repositories, planned)
        return run, StageTask(scan.method.name, planned.name, planned.settings.values, inputs)

    def _capture(self, planned: PlannedStage, scan: LoadedScan, task: StageTask) -> Outcome:
        """Capture with the rig's lock held; write the result when the rig is free again."""
        stage, params = planned.stage, planned.settings.params
        device: dict[str, Any] = {}
        if scan.row.rig == NO_RIG:
            result, verified = self._drive(None, planned, scan, task)
        else:
            owner = Owner(scan.row.id, scan.title, self._job.who)
            rigs, row = self._shop.rigs, scan.row
            with rigs.lease(row.rig, row.rig_options, owner, self.control) as lease:
                result, verified, device = lease.call(
                    lambda rig: self._shoot(rig, lease.threads, planned, scan, task)
                )
        with stage_errors(stage):
            outcome = conclude(stage, result, params, self._shop.store)
        # What is known of frames from now goes before what was found when the take was run first.
        found = {c["name"]: c for c in _found_before(planned, scan)}
        found |= {check.name: asdict(check) for check in verified}
        return replace(outcome, checks=(*outcome.checks, *found.values()), device=device)

    def _shoot(
        self,
        rig: Rig,
        threads: DeviceThreads,
        planned: PlannedStage,
        scan: LoadedScan,
        task: StageTask,
    ) -> tuple[Any, tuple[Check, ...], dict[str, Any]]:
        with shooter_of(rig, self.control, threads) as shooter:
            result, verified = self._drive(shooter, planned, scan, task)
        return result, verified, _devices(rig, shooter.waited_s)

    def _drive(
        self,
        shooter: Shooter | None,
        planned: PlannedStage,
        scan: LoadedScan,
        task: StageTask,
    ) -> tuple[Any, tuple[Check, ...]]:
        """Run a capturing stage, and return what was found of its frames, too.

        Without a shooter every frame has to be in the journal.
        """
        stage, shop = planned.stage, self._shop
        facts = decode(scan.given[RigFacts.__name__].document, RigFacts, shop.store)
        session = CaptureSession(
            scan=scan.row.id,
            stage=planned.name,
            take=planned.take,
            facts=facts,
            journal=DatabaseJournal(shop.database, scan.row.id, planned.name, planned.take),
            store=shop.store,
            shooter=shooter,
            control=self.control,
            seen=lambda camera, frame, row: self._seen(scan, camera, frame, row),
            evidence=lambda reason, frames: self._keep_evidence(stage, reason, frames),
        )
        with stage_errors(stage):
            result = stage.run(
                decode_inputs(stage, task.inputs, shop.store),
                planned.settings.params,
                shoot=session.run_plan,
                progress=self.control.progress,
                load=shop.store.get,
            )
            return result, session.finish()

    def _seen(
        self, scan: LoadedScan, camera: str, frame: DeviceFrame, row: FrameRow | None
    ) -> None:
        self._shop.rigs.show(scan.row.rig, camera, LivePicture.of(frame))
        if row is not None:
            self._shop.publish(
                FrameCaptured(
                    scan=scan.row.id,
                    rig=scan.row.rig,
                    camera=camera,
                    artifact=row.artifact,
                    exposure_ms=frame.exposure_us / 1000.0,
                    text=self.control.live.text,
                )
            )

    def _keep_evidence(
        self, stage: Stage, reason: str, frames: Sequence[Mapping[str, Any]]
    ) -> bool:
        """Note frames that couldn't be verified in the audit trail, which keeps them to be looked at."""
        with self._writing() as repositories:
            lines = sum(1 for _ in evidence_of(repositories.audit.of(self._job.scan)))
            if lines >= MOST_LINES:
                return False
            count = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
            sentence = f"{count} of {stage.title} can't be verified and kept only to be looked at: {reason}"
            self._audit(repositories, ACTION, stage.name, sentence, {"frames": list(frames)})
        return True

    # what the database gets to know

    def _note_result(self, run: str, stage: Stage, outcome: Outcome) -> None:
        worst = max(
            (Level(c["level"]) for c in outcome.checks), key=list(Level).index, default=Level.OK
        )
        with self._writing() as repositories:
            repositories.runs.finish(
                run,
                outcome.document,
                outcome.hash,
                outcome.checks,
                outcome.seconds,
                device=outcome.device,
            )
            self._audit(
                repositories,
                "finished",
                stage.name,
                f"{stage.title} finished in {outcome.seconds or 0:.1f} s.",
                {"run": run, "hash": outcome.hash, "level": worst.value},
            )

    def _note_failure(self, run: str, stage: Stage, error: Exception) -> None:
        with self._shop.database.transaction() as repositories:
            if isinstance(error, CancelledError):
                if self.control.stopped_by is None:
                    repositories.runs.interrupt(run)
                else:
                    repositories.runs.cancel(run)
                return
            self._failure_noted = True
            expected = isinstance(error, UnglareError)
            sentence = _sentence(error)
            repositories.runs.fail(run, sentence, defect=not expected)
            self._audit(
                repositories,
                "failed",
                stage.name,
                f"{stage.title} failed: {sentence}",
                {"run": run},
            )

    def _stopped(self, error: CancelledError) -> _End:
        if self.control.stopped_by is None:
            sentence = "The application was stopped: run again to go on."
            return _End(JobStatus.INTERRUPTED, error=sentence, stage=self._job.stage)
        return _End(JobStatus.CANCELLED, error=error.sentence, stage=self._job.stage)

    def _finish(self, end: _End) -> None:
        """Write the job's end and its line in the audit trail together."""
        progress = 1.0 if end.status is JobStatus.FINISHED else self.control.live.progress
        with self._writing() as repositories:
            self._job = repositories.jobs.update(
                self._job.id,
                status=end.status,
                stage=end.stage,
                text=end.text,
                error=end.error,
                progress=progress,
            )
            if not self._failure_noted:
                self._audit_end(repositories, end)

    def _audit_end(self, repositories: Repositories, end: _End) -> None:
        action, sentence = _LAST_WORDS[end.status]
        who = self.control.stopped_by or self._job.who
        reason = (
            f": {end.error}" if end.error else "." if end.stage is None else f" at {end.stage}."
        )
        details = {"job": self._job.id}
        repositories.audit.add(
            self._job.scan, who, action, end.stage, f"{sentence}{reason}", details
        )

    @contextmanager
    def _writing(self) -> Iterator[Repositories]:
        """Write, and tell the clients when it is committed."""
        with self._shop.database.transaction() as repositories:
            yield repositories
            revision = repositories.scans.get(self._job.scan).revision
        self._shop.publish(ScanChanged(scan=self._job.scan, revision=revision))
        self._tell(self.control.live)

    def _audit(
        self,
        repositories: Repositories,
        action: str,
        stage: str,
        sentence: str,
        details: Mapping[str, Any],
    ) -> None:
        repositories.audit.add(self._job.scan, self._job.who, action, stage, sentence, details)

    # what the clients get to know

    def _tell(self, live: Live) -> None:
        self._shop.publish(JobProgress(scan=self._job.scan, job=job_view(self._job, live)))


_LAST_WORDS = {
    JobStatus.FINISHED: ("finished", "The run is through"),
    JobStatus.AWAITING_REVIEW: ("awaiting_review", "The run waits for a decision"),
    JobStatus.FAILED: ("failed", "The run failed"),
    JobStatus.CANCELLED: ("cancelled", "The run was cancelled"),
    JobStatus.INTERRUPTED: ("interrupted", "The run was interrupted"),
}


def _found_before(planned: PlannedStage, scan: LoadedScan) -> tuple[dict[str, Any], ...]:
    """Return what was found of a take's frames when they came: that holds for all that is computed of them."""
    for run in reversed(scan.runs):
        if (run.stage, run.take) == (planned.name, planned.take):
            found = tuple(c for c in run.checks if c["name"] in (SYNCHRONISATION, DRIFT, STILLNESS))
            if found:
                return found
    return ()


def _sentence(error: Exception) -> str:
    if isinstance(error, UnglareError | StageDefectError):
        return error.sentence
    return f"Defect in the application: {type(error).__name__}: {error}; see the log."


def _devices(rig: Rig, waited_s: float) -> dict[str, Any]:
    """Return who every device of a rig is, and how long they were waited for, to be stored with what they captured."""
    devices = {"rig": rig.info, "projector": rig.projector.info}
    cameras = {name: camera.info for name, camera in rig.cameras.items()}
    told = {name: asdict(info) for name, info in (devices | cameras).items()}
    told["rig"]["knows_truth"] = isinstance(rig, KnowsTruth)
    told["rig"]["waited_s"] = round(waited_s, 3)
    return told
