"""Threads that drivers are called on: a call that never returns costs its scan, not the application.

A vendor's library may block for good, and a thread can't be ended from outside. So nobody waits for a driver
without a deadline. A call that misses it is left behind: its thread takes no more work, and being a daemon
it doesn't keep the application from ending.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from typing import Any, Generic, NoReturn, TypeVar

from backend.devices.errors import DeviceStalled
from backend.devices.foreign import failure, is_ours
from backend.devices.protocols import Camera, Device, KnowsItsPace
from backend.domain.errors import UnglareError
from backend.jobs.control import JobControl

log = logging.getLogger(__name__)

ANSWER_S = 20.0
"""How long a call may take beyond what it was told to wait, unless the device says otherwise (`KnowsItsPace`)."""
AFTER_STOP_S = 3.0
"""How long a call may go on, at least, once its job is to end: `abort` should have ended it at once."""
_MOMENT_S = 1.0
"""How long whoever aborts or closes a device beside its own thread waits for that."""
_LOOK_S = 0.1
"""So often whoever waits looks whether the job is to end."""

T = TypeVar("T")


def answers_within_s(device: Device) -> float:
    """Return how long a device may take for a call before it counts as stuck."""
    return float(device.answers_within_s) if isinstance(device, KnowsItsPace) else ANSWER_S


class DriverThread:
    """One thread for calls into a driver, in order, started by the first.

    Parameters
    ----------
    name
        Shown in stack dumps.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._work: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = (
            queue.SimpleQueue()
        )
        self._open: set[Future[Any]] = set()
        self._thread: threading.Thread | None = None
        self._left: Exception | None = None

    @property
    def is_here(self) -> bool:
        """Whether the caller runs on this thread."""
        return threading.current_thread() is self._thread

    def submit(self, work: Callable[[], T]) -> "Future[T]":
        """Queue a call; it fails at once if the thread was left."""
        future: Future[T] = Future()
        with self._lock:
            if self._left is not None:
                future.set_exception(self._left)
                return future
            self._queue(future, work)
        return future

    def leave(self, error: Exception, last: Callable[[], None] | None = None) -> "Future[None]":
        """Take no more work; what is queued, and what runs, fails with an error at once.

        `last` is still called, when the call that runs now returns; the returned future tells when that is over.
        """
        ended: Future[None] = Future()
        with self._lock:
            failed, self._open = self._open, set()
            if self._left is not None or (self._thread is None and last is None):
                ended.set_result(None)
            else:
                self._queue(ended, last or _nothing)
                self._work.put(None)
            self._left = self._left or error
        for future in failed:
            future.set_exception(error)
        return ended

    def _queue(self, future: "Future[T]", work: Callable[[], T]) -> None:
        self._open.add(future)
        self._work.put((future, work))
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()

    def _run(self) -> None:
        while (item := self._work.get()) is not None:
            if item[0] in self._open:
                self._carry_out(*item)
            del item  # or the last call's frame stays in memory until the next one

    def _carry_out(self, future: "Future[T]", work: Callable[[], T]) -> None:
        try:
            result = work()
        except BaseException as error:  # noqa: BLE001  whoever waits for the future gets it
            if self._is_awaited(future):
                future.set_exception(error)
        else:
            if self._is_awaited(future):
                future.set_result(result)

    def _is_awaited(self, future: "Future[Any]") -> bool:
        """Tell whether a call's end is news still: not if the thread was left meanwhile."""
        with self._lock:
            awaited = future in self._open
            self._open.discard(future)
        return awaited


def _nothing() -> None:
    """Only mark the end of what was queued before."""


@dataclass(frozen=True)
class DriverCall(Generic[T]):
    """A call that runs on a device's thread."""

    device: str
    doing: str
    """What it does, as a sentence names it: `taking a picture`."""
    within_s: float
    future: "Future[T]"
    began_s: float = field(default_factory=time.monotonic)

    @property
    def since_s(self) -> float:
        """How long ago it was made."""
        return time.monotonic() - self.began_s

    def stalled(self) -> DeviceStalled:
        """Return the error that says that it doesn't return."""
        return DeviceStalled(
            self.device,
            f"its driver hasn't come back from {self.doing} for {self.since_s:.0f} s; check cable and power, or switch"
            " the device off and on",
        )


class DeviceThreads:
    """A thread for each device of an opened rig, for as long as it is open.

    Parameters
    ----------
    devices
        Cameras and projector.
    """

    def __init__(self, devices: Iterable[Device]) -> None:
        self._devices = {device.name: device for device in devices}
        self._threads = {name: DriverThread(f"device-{name}") for name in self._devices}
        self._stuck: dict[str, DriverCall[Any]] = {}

    @property
    def stuck(self) -> "tuple[DriverCall[Any], ...]":
        """The calls that missed their deadline, also if they have returned since."""
        return tuple(self._stuck.values())

    def call(
        self,
        device: str,
        doing: str,
        work: Callable[[], T],
        *,
        control: JobControl | None = None,
        wait_s: float = 0.0,
    ) -> T:
        """Call a device's driver on its thread.

        Parameters
        ----------
        device
            Its name.
        doing
            What the call does, for the sentence: `showing a pattern`.
        work
            The call.
        control
            The job that waits: once it is to end, little more time is given.
        wait_s
            How long the driver was told to wait; the device's own time comes on top.

        Raises
        ------
        DeviceStalled
            If the call doesn't return in time, or one before it never did.
        """
        return self.each([device], doing, lambda _: work(), control=control, wait_s=wait_s)[device]

    def each(
        self,
        devices: Sequence[str],
        doing: str,
        work: Callable[[str], T],
        *,
        control: JobControl | None = None,
        wait_s: float = 0.0,
    ) -> dict[str, T]:
        """Do the same with several devices at once; raise the first error when all have returned or are overdue."""
        for name in devices:
            self._refuse_stuck(name)
        calls = [self._begin(name, doing, work, wait_s) for name in devices]
        for call in calls:
            self._wait(call, control)
        overdue = [call for call in calls if not call.future.done()]
        for call in overdue:
            self._give_up(call)
        errors = [(call, error) for call in calls if (error := _error_of(call)) is not None]
        if errors:
            self._raise(*errors[0])
        return {call.device: call.future.result() for call in calls}

    def leave(self, error: Exception, close: Callable[[], None]) -> "tuple[Future[None], ...]":
        """Take no more work; `close` is called behind each call that is stuck, as soon as that returns."""
        return tuple(
            thread.leave(error, close if name in self._stuck else None)
            for name, thread in self._threads.items()
        )

    def _refuse_stuck(self, name: str) -> None:
        before = self._stuck.get(name)
        if before is not None and not before.future.done():
            raise before.stalled()

    def _begin(
        self, name: str, doing: str, work: Callable[[str], T], wait_s: float
    ) -> DriverCall[T]:
        within_s = wait_s + answers_within_s(self._devices[name])
        return DriverCall(name, doing, within_s, self._threads[name].submit(lambda: work(name)))

    def _wait(self, call: DriverCall[T], control: JobControl | None) -> None:
        stopped_s: float | None = None
        while True:
            left_s = call.within_s - call.since_s
            if control is not None and control.stopping:
                stopped_s = stopped_s or time.monotonic()
                # A device that computes its pictures can't be stopped in the middle of one.
                grace_s = max(AFTER_STOP_S, call.within_s / 10)
                left_s = min(left_s, stopped_s + grace_s - time.monotonic())
            if wait([call.future], timeout=max(0.0, min(left_s, _LOOK_S))).done or left_s <= 0:
                return

    def _raise(self, call: DriverCall[T], error: BaseException) -> NoReturn:
        """Raise what came of a call; what a driver from outside shouldn't have raised gets its device's name."""
        foreign = not is_ours(self._devices[call.device])
        if foreign and isinstance(error, Exception) and not isinstance(error, UnglareError):
            raise failure(call.device, call.doing, error) from error
        raise error

    def _give_up(self, call: DriverCall[T]) -> None:
        self._stuck[call.device] = call
        log.warning("%s", call.stalled())
        device = self._devices[call.device]
        if isinstance(device, Camera):
            # The last means of a camera that ignores its timeout: it may be closed in order then.
            aside(device.abort)


def aside(work: Callable[[], None]) -> None:
    """Call a driver from a thread of its own and wait a moment; it may go on, and what it raises is its own matter."""
    wait([DriverThread("aside").submit(work)], timeout=_MOMENT_S)


def _error_of(call: DriverCall[T]) -> BaseException | None:
    return call.future.exception() if call.future.done() else call.stalled()
