"""What use cases have in common: tell the others about a change, and refuse what a running job forbids."""

from backend.contract.events import ScanChanged
from backend.contract.scans import ScanState
from backend.domain.errors import ConflictError
from backend.jobs.loading import LoadedScan
from backend.services.context import Context
from backend.storage.repositories import Repositories


def announce(context: Context, state: ScanState) -> ScanState:
    """Tell every client that a scan changed; called when the change is committed. Returns the state."""
    context.events.publish(ScanChanged(scan=state.id, revision=state.revision))
    return state


def refuse_running(context: Context, repositories: Repositories, loaded: LoadedScan) -> None:
    """Raise `ConflictError` if a job of the scan is going on, naming who started it and where it is."""
    job = repositories.jobs.last_of(loaded.row.id)
    if job is None or job.status.ended:
        return
    live = context.runner.live(job.id)
    stage = live.stage if live else job.stage
    place = f" at {loaded.method.stage(stage).title}" if stage else ""
    raise ConflictError(
        f"A run of {loaded.title!r} that {job.who} started is going on{place}: wait for it or cancel it.",
        details={"job": job.id, "who": job.who, "stage": stage},
    )
