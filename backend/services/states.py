"""The state of a scan, whole, put together from its plan, its runs and its job. Nothing here is stored."""

from collections.abc import Mapping
from functools import cached_property

from backend.contract.scans import (
    CheckView,
    DecisionView,
    JobView,
    ScanState,
    ScanSummary,
    SettingView,
    StageState,
)
from backend.domain.stage import Stage
from backend.domain.states import JobStatus, StageStatus, Verdict
from backend.jobs.calibrations import rig_identity
from backend.jobs.edits import last_group
from backend.jobs.loading import NO_RIG, LoadedScan, document_of, load_scan
from backend.jobs.plan import RIG, PlannedStage, gate_holds, run_level
from backend.jobs.views import job_view
from backend.services.context import Context
from backend.services.fields import ShownResult, point_count, shown_result
from backend.services.handed import handed_views, takers
from backend.services.words import shown_value
from backend.storage.repositories import Repositories
from backend.storage.rows import (
    CalibrationRow,
    EditKind,
    EditRow,
    GivenRow,
    JobRow,
    RunRow,
    RunStatus,
    ScanRow,
)

_DONE = (StageStatus.DONE, StageStatus.ACCEPTED, StageStatus.GIVEN)


def scan_state(context: Context, repositories: Repositories, scan: str) -> ScanState:
    """Put the state of a scan together; NotFoundError if there is none of that id."""
    return Assembly(context, repositories, load_scan(repositories, context.registry, scan)).state()


def scan_summary(
    context: Context, repositories: Repositories, row: ScanRow, job: JobRow | None
) -> ScanSummary:
    """Put one line of the scan list together; a scan whose method is gone stays in the list."""
    if row.method not in context.registry.methods:
        return _summary(row, "idle", 0, 0, None)
    loaded = load_scan(repositories, context.registry, row.id)
    return Assembly(context, repositories, loaded, job).summary()


class Assembly:
    """One scan while its state is put together."""

    def __init__(
        self,
        context: Context,
        repositories: Repositories,
        loaded: LoadedScan,
        job: JobRow | None = None,
    ) -> None:
        self._context = context
        self._repositories = repositories
        self._scan = loaded
        self._row = job or repositories.jobs.last_of(loaded.row.id)
        self._job = self._job_view(self._row)
        self._latest = {run.key: run for run in loaded.runs}
        self._unattended: dict[str, bool] = {}

    def state(self) -> ScanState:
        """Return everything that a screen needs, but the arrays."""
        row = self._scan.row
        stages = tuple(self._stage(planned) for planned in self._scan.plan.stages)
        return ScanState(
            id=row.id,
            name=row.name,
            note=row.note,
            method=row.method,
            rig=row.rig,
            rig_options=dict(row.rig_options),
            created=row.created,
            who=row.who,
            revision=row.revision,
            preset=row.preset,
            status=self._scan_status([stage.status for stage in stages]),
            stages=stages,
            job=self._job,
            handed=handed_views(self._scan.method, self._scan.given),
            undo=undo_sentence(self._scan),
        )

    def summary(self) -> ScanSummary:
        """Return the line in the list of scans."""
        statuses = [self._status(planned) for planned in self._scan.plan.stages]
        done = sum(status in _DONE for status in statuses)
        return _summary(
            self._scan.row, self._scan_status(statuses), done, len(statuses), self._points()
        )

    # one stage

    def _stage(self, planned: PlannedStage) -> StageState:
        status = self._status(planned)
        shown = self._shown(planned)
        attempt = planned.run or self._failed(planned)
        return StageState(
            name=planned.name,
            title=planned.stage.title,
            status=status,
            message=self._message(planned, status),
            key=planned.key,
            stage_run=attempt.id if attempt else None,
            take=planned.take,
            settings=self._settings(planned, shown),
            checks=tuple(CheckView(**check) for check in planned.run.checks) if planned.run else (),
            fields=shown.fields if shown else (),
            decision=_decision(planned),
            duration_s=attempt.duration_s if attempt else None,
            started=attempt.started if attempt else None,
            result_hash=planned.result.hash if planned.result else None,
            can_keep=planned.run is not None and self._can_keep(planned.stage),
            kept=self._kept_as(planned),
        )

    def _status(self, planned: PlannedStage) -> StageStatus:
        if planned.given:
            return StageStatus.GIVEN
        if planned.missing:
            return StageStatus.UNAVAILABLE
        if self._is_running(planned):
            return StageStatus.RUNNING
        if planned.run is None:
            return StageStatus.FAILED if self._failed(planned) else StageStatus.PENDING
        return self._reviewed(planned, planned.run)

    def _is_running(self, planned: PlannedStage) -> bool:
        job = self._job
        return job is not None and job.status is JobStatus.RUNNING and job.stage == planned.name

    def _reviewed(self, planned: PlannedStage, run: RunRow) -> StageStatus:
        decision = planned.decision
        if decision is not None:
            accepted = decision.verdict is Verdict.ACCEPT
            return StageStatus.ACCEPTED if accepted else StageStatus.REJECTED
        review, level = planned.stage.review, run_level(run)
        if not gate_holds(review, level, None):
            return StageStatus.DONE
        # What an unattended run passed isn't asked about afterwards; a failed check still is.
        unattended = self._was_unattended(run)
        holds = gate_holds(review, level, None, unattended=unattended)
        return StageStatus.AWAITING_REVIEW if holds else StageStatus.DONE

    def _was_unattended(self, run: RunRow) -> bool:
        if run.job is None:
            return False
        if run.job not in self._unattended:
            self._unattended[run.job] = self._repositories.jobs.get(run.job).unattended
        return self._unattended[run.job]

    def _failed(self, planned: PlannedStage) -> RunRow | None:
        """Return the last try at today's key, if that is what failed."""
        run = self._latest.get(planned.key or "")
        return run if run and run.status is RunStatus.FAILED else None

    def _shown(self, planned: PlannedStage) -> ShownResult | None:
        """Describe a result. Equal results look equal: what was described once is remembered under its hash."""
        result = planned.result
        if result is None:
            return None
        key = (planned.stage.output, planned.stage.params, result.hash)
        return self._context.shown.get(key, lambda: self._describe(planned.stage, result))

    def _describe(self, stage: Stage, result: GivenRow | RunRow) -> ShownResult:
        return shown_result(stage, document_of(self._repositories, result), self._context.store)

    # calibrations

    def _can_keep(self, stage: Stage) -> bool:
        takes = stage.output.__name__ in takers(self._context.registry)
        return takes and self._scan.row.rig != NO_RIG

    @cached_property
    def _newest(self) -> Mapping[str, CalibrationRow]:
        """The calibrations that a new scan with this rig would get, by type."""
        identity = rig_identity(self._scan.row.rig, self._scan.given)
        kept = [s.output.__name__ for s in self._scan.method.stages if self._can_keep(s)]
        if identity is None or not kept:
            return {}
        return self._repositories.calibrations.newest(kept, **identity._asdict())

    def _kept_as(self, planned: PlannedStage) -> int | None:
        newest = self._newest.get(planned.stage.output.__name__)
        if newest is None or planned.run is None or newest.hash != planned.run.hash:
            return None
        return newest.sequence

    # words

    def _message(self, planned: PlannedStage, status: StageStatus) -> str:
        match status:
            case StageStatus.UNAVAILABLE:
                return f"Unavailable: {planned.missing}."
            case StageStatus.PENDING:
                return self._why_pending(planned)
            case StageStatus.RUNNING:
                return self._running_text()
            case StageStatus.FAILED:
                return self._error(planned)
            case StageStatus.GIVEN:
                return _origin(planned)
            case StageStatus.ACCEPTED:
                return f"{_found(planned)} {_decided(planned, 'Accepted')}"
            case StageStatus.REJECTED:
                said = f"{_found(planned)} {_decided(planned, 'Rejected')}"
                return f"{said} Change a setting or redo it."
            case StageStatus.DONE | StageStatus.AWAITING_REVIEW:
                return _found(planned)

    def _why_pending(self, planned: PlannedStage) -> str:
        if planned.waits_for == RIG:
            return "Not run yet: the rig is asked for its facts first."
        if planned.waits_for:
            return f"Waits for {self._scan.method.stage(planned.waits_for).title}."
        last = self._latest.get(planned.key or "")
        stopped = {
            RunStatus.CANCELLED: "Cancelled: captured frames are kept, run again to go on.",
            RunStatus.INTERRUPTED: "Interrupted: captured frames are kept, run again to go on.",
        }
        return stopped.get(last.status, "Not run yet.") if last else "Not run yet."

    def _running_text(self) -> str:
        text = self._job.text if self._job else ""
        return f"Running: {text}." if text else "Running."

    def _error(self, planned: PlannedStage) -> str:
        failed = self._failed(planned)
        return (failed.error if failed else None) or "Failed without a reason; see the log."

    # settings

    def _settings(self, planned: PlannedStage, shown: ShownResult | None) -> dict[str, SettingView]:
        settings = planned.settings
        chosen = shown.chosen if shown else {}
        return {
            name: SettingView(
                value=value,
                source=settings.sources[name],
                chosen=chosen.get(name) if value is None else None,
            )
            for name, value in settings.values.items()
        }

    # the scan

    def _scan_status(self, statuses: list[StageStatus]) -> str:
        if self._job is not None and not self._job.status.ended:
            return "running"
        if StageStatus.FAILED in statuses:
            return "failed"
        if {StageStatus.AWAITING_REVIEW, StageStatus.REJECTED} & set(statuses):
            return "awaiting_review"
        available = [status for status in statuses if status is not StageStatus.UNAVAILABLE]
        return "done" if all(status in _DONE for status in available) else "idle"

    def _job_view(self, row: JobRow | None) -> JobView | None:
        return job_view(row, self._context.runner.live(row.id)) if row else None

    def _points(self) -> int | None:
        for planned in reversed(self._scan.plan.stages):
            if any(f.hint.kind == "points" for f in planned.stage.shown):
                shown = self._shown(planned)
                return point_count(shown.fields) if shown else None
        return None


def undo_sentence(scan: LoadedScan) -> str | None:
    """Say what undo would take back; None if there is nothing."""
    group = last_group(scan.edits)
    if not group:
        return None
    who = group[0].who
    if group[0].kind is EditKind.TAKE:
        return f"{_titles(scan, group)}: go back to take {group[0].old} ({who})."
    changes = ", ".join(f"{row.field} back to {shown_value(row.old)}" for row in group)
    return f"{_titles(scan, group)}: {changes} ({who})."


def _titles(scan: LoadedScan, group: list[EditRow]) -> str:
    names = dict.fromkeys(row.stage for row in group)
    return ", ".join(scan.method.stage(name).title for name in names)


def _found(planned: PlannedStage) -> str:
    """Say what a result says of itself: its gravest check."""
    run = planned.run
    if run is None:
        return ""
    gravest = [check for check in run.checks if check["level"] == run_level(run)]
    if not gravest:
        return f"Done in {run.duration_s or 0:.1f} s."
    sentence = str(gravest[0]["sentence"]).removesuffix(".")
    return f"{sentence[:1].upper()}{sentence[1:]}."


def _origin(planned: PlannedStage) -> str:
    given = planned.given
    said = (given.origin or {}).get("sentence") if given else None
    return str(said or "Handed over with the scan.")


def _decided(planned: PlannedStage, verb: str) -> str:
    decision = planned.decision
    if decision is None:
        return ""
    reason = f": {decision.reason.removesuffix('.')}" if decision.reason else ""
    return f"{verb} by {decision.who}{reason}."


def _decision(planned: PlannedStage) -> DecisionView | None:
    decision = planned.decision
    if decision is None or planned.run is None:
        return None
    return DecisionView(
        verdict=decision.verdict, reason=decision.reason, who=decision.who, when=decision.when
    )


def _summary(row: ScanRow, status: str, done: int, stages: int, points: int | None) -> ScanSummary:
    return ScanSummary(
        id=row.id,
        name=row.name,
        method=row.method,
        rig=row.rig,
        created=row.created,
        who=row.who,
        status=status,
        stages_done=done,
        stages=stages,
        points=points,
    )
