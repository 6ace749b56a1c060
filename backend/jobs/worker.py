"""The worker process for pure stages: its own small one, because it has to report, and to be killed.

See backend/decisions/0003-runner.md. Tasks, progress and outcomes go over one pipe.
"""

import itertools
import logging
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from backend.domain.errors import CancelledError, StageFailedError, UnglareError
from backend.jobs.control import REPORT_PERIOD_S, JobControl
from backend.jobs.stage_work import Outcome, StageDefectError, StageTask, perform
from backend.methods import Registry
from backend.storage.artifacts import ArtifactStore

log = logging.getLogger(__name__)

GRACE_S = 0.5
"""How long a cancelled stage has to end by itself, before its process is ended and made anew."""

_POLL_S = 0.1


@dataclass(frozen=True)
class _Order:
    """To the worker: run this."""

    number: int
    task: StageTask


@dataclass(frozen=True)
class _Stop:
    """To the worker: end the order with that number."""

    number: int


@dataclass(frozen=True)
class _Ready:
    """From the worker: everything is loaded and compiled."""


@dataclass(frozen=True)
class _Progress:
    done: float
    text: str


@dataclass(frozen=True)
class _Failure:
    """From the worker: the stage said why it can't."""

    sentence: str
    trace: str | None = None
    """The traceback, if it is a defect."""


_Report = _Ready | _Progress | _Failure | Outcome


@dataclass(frozen=True)
class WorkerSetup:
    """What a worker process needs to run any stage. Everything in it has to be picklable."""

    registry: Callable[[], Registry]
    """Finds the methods, called in the worker: a function of a module, not a closure."""
    store: ArtifactStore
    warm_up: Callable[[], object] | None = None
    """Called once before the first task: loads compiled kernels."""


class Worker:
    """One worker process; runs one stage at a time. Used by one thread at a time."""

    def __init__(self, setup: WorkerSetup) -> None:
        self._setup = setup
        self._numbers = itertools.count()
        self._sending = threading.Lock()
        self._spawn()

    @property
    def pid(self) -> int | None:
        """The process' id."""
        return self._process.pid

    def run(self, task: StageTask, control: JobControl) -> Outcome:
        """Run a stage and pass its progress on.

        Raises
        ------
        CancelledError
            When the job is stopped: the stage is asked to end, and ended after half a second.
        UnglareError
            What the stage says; also if the process dies (out of memory), with the way out.
        StageDefectError
            Anything else that the stage raises.
        """
        if not self._process.is_alive():
            self._respawn()
        number = next(self._numbers)
        self._send(_Order(number, task))
        if not self._ready:
            control.note("waits for the worker process; after an update it compiles first")
        with control.when_stopped(lambda: self._send(_Stop(number))):
            report = self._listen(task, control)
        if isinstance(report, Outcome):
            return report
        control.check()
        if report.trace is not None:
            raise StageDefectError(report.sentence, report.trace)
        raise StageFailedError(report.sentence)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()
        self._process.close()

    def _listen(self, task: StageTask, control: JobControl) -> Outcome | _Failure:
        deadline = None
        while True:
            if control.stopping:
                deadline = deadline or time.monotonic() + GRACE_S
                if time.monotonic() > deadline:
                    self._respawn()
                    control.check()
            # The worker's end is closed in this process: when it dies, the pipe is ready and at its end.
            if not wait([self._pipe], timeout=_POLL_S):
                continue
            try:
                report: _Report = self._pipe.recv()
            except (EOFError, OSError):
                raise self._died(task, control) from None
            if isinstance(report, _Ready):
                self._ready = True
                control.note("")
            elif not isinstance(report, _Progress):
                return report
            elif not control.stopping:
                control.progress(report.done, report.text)

    def _died(self, task: StageTask, control: JobControl) -> UnglareError:
        self._process.join()
        code = self._process.exitcode
        self._respawn()
        control.check()
        return StageFailedError(
            f"The worker process died in stage {task.stage} (exit code {code}), perhaps out of memory: "
            f"close other programs or use smaller pictures, then run again."
        )

    def _send(self, message: _Order | _Stop) -> None:
        try:
            with self._sending:
                self._pipe.send(message)
        except OSError:
            # A dead worker is noticed by whoever listens.
            log.debug("The worker %s is gone, %r isn't sent", self.pid, message)

    def _spawn(self) -> None:
        # spawn: forking after numba's OpenMP layer has started kills the child.
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._pipe: Connection = ours
        self._process: SpawnProcess = context.Process(
            target=_work, args=(theirs, self._setup), name="unglare-worker", daemon=True
        )
        self._process.start()
        theirs.close()
        self._ready = False

    def _respawn(self) -> None:
        self.close()
        self._spawn()


class WorkerPool:
    """A few workers; a task waits for one to be free."""

    def __init__(self, setup: WorkerSetup, count: int = 1) -> None:
        self._all = [Worker(setup) for _ in range(count)]
        self._free: queue.SimpleQueue[Worker] = queue.SimpleQueue()
        for worker in self._all:
            self._free.put(worker)

    def __call__(self, task: StageTask, control: JobControl) -> Outcome:
        """Run a stage on the next free worker; see `Worker.run`."""
        worker = self._take(control)
        try:
            return worker.run(task, control)
        finally:
            self._free.put(worker)

    def close(self) -> None:
        """End all processes; nobody may run anything any more."""
        for worker in self._all:
            worker.close()

    def _take(self, control: JobControl) -> Worker:
        waiting = False
        while True:
            control.check()
            try:
                return self._free.get(timeout=_POLL_S)
            except queue.Empty:
                if not waiting:
                    control.note("waits for another scan's stage to end")
                waiting = True


# in the worker process


def _work(pipe: Connection, setup: WorkerSetup) -> None:
    """Run orders until the parent is gone."""
    # Ctrl-C goes to every process of a terminal; what it means is decided in the parent.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    orders: queue.SimpleQueue[_Order] = queue.SimpleQueue()
    stopped: set[int] = set()
    threading.Thread(target=_receive, args=(pipe, orders, stopped), daemon=True).start()
    registry = setup.registry()
    if setup.warm_up:
        setup.warm_up()
    _report(pipe, _Ready())
    while True:
        order = orders.get()
        _report(pipe, _carry_out(order, pipe, registry, setup.store, stopped))


def _receive(pipe: Connection, orders: "queue.SimpleQueue[_Order]", stopped: set[int]) -> None:
    """Take messages while a stage runs; without a parent, end at once whatever runs."""
    while True:
        try:
            message = pipe.recv()
        except (EOFError, OSError):
            os._exit(0)
        if isinstance(message, _Stop):
            stopped.add(message.number)
        else:
            orders.put(message)


def _report(pipe: Connection, report: _Report) -> None:
    try:
        pipe.send(report)
    except OSError:
        # The parent is gone, and nobody wants the result.
        os._exit(0)


def _carry_out(
    order: _Order, pipe: Connection, registry: Registry, store: ArtifactStore, stopped: set[int]
) -> Outcome | _Failure:
    told = 0.0

    def progress(done: float, text: str = "") -> None:
        nonlocal told
        if order.number in stopped:
            raise CancelledError("Cancelled.")
        if time.monotonic() - told >= REPORT_PERIOD_S:
            told = time.monotonic()
            _report(pipe, _Progress(done, text))

    try:
        return perform(order.task, registry, store, progress)
    except StageDefectError as error:
        return _Failure(error.sentence, error.trace)
    except UnglareError as error:
        return _Failure(error.sentence)
