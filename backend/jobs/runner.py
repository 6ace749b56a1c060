"""Start, watch and stop jobs: the service's runner with a worker process, and the command line's without."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from backend.jobs.control import Live
from backend.jobs.execution import Compute, JobExecution, Workshop, compute_inline
from backend.jobs.worker import WorkerPool, WorkerSetup
from backend.storage.rows import JobRow


@runtime_checkable
class Runner(Protocol):
    """Carries out jobs that are in the database already. Called from any thread."""

    def start(self, job: JobRow) -> None:
        """Begin a job that is queued."""
        ...

    def cancel(self, job: str, who: str) -> bool:
        """Ask a job to end; returns at once. False if this runner doesn't carry it out (any more)."""
        ...

    def live(self, job: str) -> Live | None:
        """Return how far a job is; None if this runner doesn't carry it out."""
        ...

    def wait(self, job: str, timeout_s: float | None = None) -> bool:
        """Wait until a job has ended; False if it hasn't in time."""
        ...

    def close(self) -> None:
        """Interrupt what runs, so that it can be continued, and free everything."""
        ...


@dataclass(frozen=True)
class _Started:
    execution: JobExecution
    ended: threading.Event
    """Waited for instead of the thread: a `join` that Ctrl-C interrupts takes a living thread for dead (Python < 3.13)."""


class JobThreads:
    """One thread per job; capturing stages go on to the rig's thread, pure ones to `compute`."""

    def __init__(self, shop: Workshop, compute: Compute) -> None:
        self._shop = shop
        self._compute = compute
        self._lock = threading.Lock()
        self._started: dict[str, _Started] = {}

    def start(self, job: JobRow) -> None:  # noqa: D102 (see Runner)
        execution = JobExecution(job, self._shop, self._compute)
        ended = threading.Event()

        def run() -> None:
            try:
                execution.execute()
            finally:
                with self._lock:
                    self._started.pop(job.id, None)
                ended.set()

        thread = threading.Thread(target=run, name=f"job-{job.id}", daemon=True)
        with self._lock:
            self._started[job.id] = _Started(execution, ended)
        thread.start()

    def cancel(self, job: str, who: str) -> bool:  # noqa: D102 (see Runner)
        started = self._started.get(job)
        if started:
            started.execution.control.stop(who)
        return started is not None

    def live(self, job: str) -> Live | None:  # noqa: D102 (see Runner)
        started = self._started.get(job)
        return started.execution.control.live if started else None

    def wait(self, job: str, timeout_s: float | None = None) -> bool:  # noqa: D102 (see Runner)
        started = self._started.get(job)
        return started is None or started.ended.wait(timeout_s)

    def close(self) -> None:  # noqa: D102 (see Runner)
        for started in list(self._started.values()):
            started.execution.control.stop(None)
            started.ended.wait()


class LocalRunner(JobThreads):
    """The service's runner: pure stages run in worker processes that are started at once.

    Parameters
    ----------
    shop
        Database, store, rigs, methods.
    workers
        How many pure stages may run at the same time; each uses all cores.
    warm_up
        A function of a module that every worker calls before its first stage (loads compiled kernels).
    """

    def __init__(
        self,
        shop: Workshop,
        *,
        workers: int = 1,
        warm_up: Callable[[], object] | None = None,
    ) -> None:
        self._workers = WorkerPool(WorkerSetup(shop.registry, shop.store, warm_up), workers)
        super().__init__(shop, self._workers)

    def close(self) -> None:  # noqa: D102 (see Runner)
        super().close()
        self._workers.close()


class InlineRunner(JobThreads):
    """The command line's runner: everything in this process, and `start` returns when the job has ended.

    Ctrl-C cancels the job and waits for its end: the rig is left usable, captured frames count.
    """

    def __init__(self, shop: Workshop, *, who: str = "command line") -> None:
        super().__init__(shop, compute_inline(shop))
        self._who = who

    def start(self, job: JobRow) -> None:  # noqa: D102 (see Runner)
        super().start(job)
        try:
            self.wait(job.id)
        except KeyboardInterrupt:
            self.cancel(job.id, self._who)
            self.wait(job.id)
            raise
