"""Run what isn't current, cancel, and decide about results."""

from backend.contract.requests import Decide, StartRun
from backend.contract.scans import ScanState
from backend.domain.errors import ConflictError
from backend.domain.ids import new_id
from backend.domain.states import JobStatus, Level, Verdict
from backend.jobs.loading import NO_RIG, LoadedScan, load_scan
from backend.jobs.plan import Gate, PlannedStage, Run, next_step
from backend.jobs.recovery import interrupt
from backend.services.context import Context
from backend.services.editing import find_stage
from backend.services.states import scan_state
from backend.services.telling import announce, refuse_running
from backend.storage.repositories import Repositories
from backend.storage.rows import JobRow


def run(context: Context, scan: str, request: StartRun, who: str) -> ScanState:
    """Start a job that runs every stage that isn't current, up to a gate or the end.

    Raises
    ------
    ConflictError
        If a job of this scan runs, or the next thing to do is a decision.
    RigBusyError
        If the next thing to do is a capture and another scan owns the rig.
    StageUnavailableError
        If the stage that is named as the last one is unavailable.
    """
    with context.database.transaction() as repositories:
        repositories.scans.lock(scan)
        loaded = load_scan(repositories, context.registry, scan)
        refuse_running(context, repositories, loaded)
        if request.until is not None:
            find_stage(loaded, request.until)
        step = next_step(loaded.plan, until=request.until, unattended=request.unattended)
        _refuse_step(context, loaded, step)
        job = _new_job(context, repositories, loaded, request, who)
    context.runner.start(job)
    with context.database.reading() as repositories:
        return scan_state(context, repositories, scan)


def cancel(context: Context, scan: str, who: str) -> ScanState:
    """Ask the scan's job to end; it does so within a second, and keeps what is finished.

    A job that no process carries out any more is marked as interrupted.
    """
    with context.database.transaction() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        job = repositories.jobs.last_of(scan)
        if job is None or job.status.ended:
            raise ConflictError(f"Nothing runs in {loaded.title!r}: there is nothing to cancel.")
    if not context.runner.cancel(job.id, who):
        with context.database.transaction() as repositories:
            if not repositories.jobs.get(job.id).status.ended:
                interrupt(repositories, job)
    with context.database.reading() as repositories:
        return announce(context, scan_state(context, repositories, scan))


def decide(context: Context, stage_run: str, request: Decide, who: str) -> ScanState:
    """Accept or reject a result; after accepting, go on to the next gate if that is wanted.

    The decision is stored first: where going on isn't possible (the rig is busy), it holds all the same.

    Raises
    ------
    ConflictError
        If the result isn't today's any more, or going on isn't possible; the sentence says which.
    """
    with context.database.transaction() as repositories:
        row = repositories.runs.get(stage_run)
        repositories.scans.lock(row.scan)
        loaded = load_scan(repositories, context.registry, row.scan)
        planned = _present(loaded, row.key)
        run_id = planned.run.id if planned.run else stage_run
        repositories.decisions.add(
            row.scan, run_id, planned.name, row.key, request.verdict, request.reason, who
        )
        accepted = request.verdict is Verdict.ACCEPT
        action = "accepted" if accepted else "rejected"
        sentence = f"{planned.stage.title} {action}. {request.reason}".rstrip()
        details = {"run": run_id, "key": row.key, "reason": request.reason}
        repositories.audit.add(row.scan, who, action, planned.name, sentence, details)
        state = scan_state(context, repositories, row.scan)
    announce(context, state)
    if accepted and request.proceed:
        return _proceed(context, row.scan, who, state)
    return state


def _proceed(context: Context, scan: str, who: str, state: ScanState) -> ScanState:
    """Run what comes next, if anything does and no job is at it already."""
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        job = repositories.jobs.last_of(scan)
    busy = job is not None and not job.status.ended
    if busy or not isinstance(next_step(loaded.plan, until=None, unattended=False), Run):
        return state
    return run(context, scan, StartRun(), who)


def _present(loaded: LoadedScan, key: str) -> PlannedStage:
    for planned in loaded.plan.stages:
        if planned.key == key and planned.run is not None:
            return planned
    raise ConflictError(
        f"That result of {loaded.title!r} isn't today's any more, or not finished: look at the scan again."
    )


def _refuse_step(context: Context, loaded: LoadedScan, step: Run | Gate | None) -> None:
    if isinstance(step, Run):
        if step.planned.stage.captures and loaded.row.rig != NO_RIG:
            context.rigs.refuse_busy(loaded.row.rig)
        return
    if step is None:
        return
    stage, decision = step.planned.stage, step.planned.decision
    if decision is not None and decision.verdict is Verdict.REJECT:
        raise ConflictError(
            f"{decision.who} rejected {stage.title}: change a setting or redo it, then run."
        )
    reason = "failed a check" if step.level is Level.FAILURE else "waits for a decision"
    raise ConflictError(f"{stage.title} {reason}: accept it, change a setting or redo it.")


def _new_job(
    context: Context,
    repositories: Repositories,
    loaded: LoadedScan,
    request: StartRun,
    who: str,
) -> JobRow:
    job = JobRow(
        id=new_id(),
        scan=loaded.row.id,
        status=JobStatus.QUEUED,
        who=who,
        created=context.clock(),
        until=request.until,
        unattended=request.unattended,
    )
    repositories.jobs.add(job)
    until = f" up to {loaded.method.stage(request.until).title}" if request.until else ""
    how = ", unattended" if request.unattended else ""
    details = {"job": job.id, "until": request.until, "unattended": request.unattended}
    repositories.audit.add(loaded.row.id, who, "run", None, f"Run started{until}{how}.", details)
    return job
