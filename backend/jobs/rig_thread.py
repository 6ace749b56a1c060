"""The thread of one rig, which is replaced when a driver never returns from it."""

import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from backend.devices.errors import DeviceError, DeviceStalled
from backend.devices.protocols import Device, LinkState, Rig
from backend.jobs.control import JobControl
from backend.jobs.device_threads import (
    ANSWER_S,
    DeviceThreads,
    DriverThread,
    answers_within_s,
    aside,
)

log = logging.getLogger(__name__)

GRACE_S = 2.0
"""How long a rig waits for calls that were left behind before it is opened beside them."""
_MOST_LEFT = 3
"""So many calls may be stuck in a rig's drivers before nobody tries any more: each costs a thread."""
_LOOK_S = 0.1

T = TypeVar("T")


@dataclass(frozen=True)
class _LeftBehind:
    """A call that never returned; behind it its rig is closed."""

    stalled: DeviceStalled
    closed: "Future[None]"


class RigThread:
    """Everything that is asked of one rig runs here, in order.

    Parameters
    ----------
    name
        The rig's.
    forget
        Called when a rig is left behind: it must not be used any more.
    """

    def __init__(self, name: str, forget: Callable[[], None]) -> None:
        self._name = name
        self._forget = forget
        self._lock = threading.Lock()
        self._thread = DriverThread(f"rig-{name}")
        self._left: list[_LeftBehind] = []

    def submit(self, work: Callable[[], T]) -> "Future[T]":
        """Queue something; the future fails with `DeviceStalled` where a driver never returns."""
        with self._lock:
            thread = self._thread
        return thread.submit(work)

    @property
    def is_here(self) -> bool:
        """Whether the caller runs on the rig's thread, and not on one that was left behind."""
        return self._thread.is_here

    @contextmanager
    def limited(self, rig: Rig, doing: str) -> Iterator[None]:
        """Give up the thread that runs this block, and the rig, if it takes too long.

        Raises
        ------
        DeviceStalled
            At its end, if the thread was given up: whoever waited has been told already.
        """
        thread = self._thread
        timer = threading.Timer(_patience_s(rig), self._give_up, (thread, rig, doing))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            if self._thread is not thread:
                raise DeviceStalled(self._name, f"{doing} came to its end too late; run again")

    def leave_stuck(self, rig: Rig, threads: DeviceThreads) -> bool:
        """Leave a rig behind if a call into one of its devices is stuck; the other devices are given back.

        On the rig's thread. Returns whether that was so.
        """
        stuck = [call for call in threads.stuck if not call.future.done()]
        if not stuck:
            return False
        stalled = stuck[0].stalled()
        closed = threads.leave(stalled, rig.close)
        self._left += [_LeftBehind(stalled, future) for future in closed if not future.done()]
        _close_others(rig, {call.device for call in stuck})
        log.warning(
            "Rig %r is left behind and opened anew when it is needed: %s", self._name, stalled
        )
        self._forget()
        return True

    @contextmanager
    def beside_what_is_stuck(self) -> Iterator[None]:
        """Open a rig in this block: what was left behind gets a moment to end, and is named if the rig refuses.

        Raises
        ------
        DeviceStalled
            If too much was left behind already, or the rig can't be opened while something is.
        """
        wait([left.closed for left in self._left], timeout=GRACE_S)
        stuck = self._still_stuck()
        if len(stuck) >= _MOST_LEFT:
            raise stuck[0]
        try:
            yield
        except DeviceError as error:
            stuck = self._still_stuck()
            if stuck:
                raise stuck[0] from error
            raise

    def _still_stuck(self) -> list[DeviceStalled]:
        self._left = [left for left in self._left if not left.closed.done()]
        return [
            DeviceStalled(
                left.stalled.device,
                "its driver is still stuck in an earlier call; switch the device off and on, and restart unglare if"
                " that doesn't help",
            )
            for left in self._left
        ]

    def _give_up(self, thread: DriverThread, rig: Rig, doing: str) -> None:
        """Leave the thread to the call that it is stuck in."""
        with self._lock:
            if self._thread is not thread:
                return
            self._thread = DriverThread(f"rig-{self._name}")
        culprit = _unfinished(rig, doing) or self._name
        stalled = DeviceStalled(
            culprit,
            f"its driver hasn't come back from {doing} for {_patience_s(rig):.0f} s; check cable and power, or switch"
            " the device off and on",
        )
        log.warning(
            "Rig %r is left behind and opened anew when it is needed: %s", self._name, stalled
        )
        self._forget()
        self._left.append(_LeftBehind(stalled, thread.leave(stalled, rig.close)))
        _close_others(rig, {culprit})


OPENING, CLOSING = "opening", "closing"


def wait_for(future: "Future[T]", control: JobControl | None = None) -> T:
    """Wait for a rig's answer; `CancelledError` at once if the job is to end meanwhile."""
    while control is not None and not wait([future], timeout=_LOOK_S).done:
        control.check()
    return future.result()


def _patience_s(rig: Rig) -> float:
    return sum(map(answers_within_s, _devices(rig))) or 3 * ANSWER_S


def _unfinished(rig: Rig, doing: str) -> str | None:
    """Return the device that a rig is stuck in: projector first, they are opened one after the other, or closed last."""
    projector, cameras = _devices(rig)[:1], _devices(rig)[1:]
    if doing == CLOSING:
        left = [d for d in (*cameras, *projector) if d.state is not LinkState.CLOSED]
    else:
        ready = (LinkState.READY, LinkState.ARMED)
        left = [d for d in (*projector, *cameras) if d.state not in ready]
    return left[0].name if left else None


def _close_others(rig: Rig, stuck: set[str]) -> None:
    """Give back what isn't stuck, so that the rig can be opened anew."""
    for device in _devices(rig):
        if device.name not in stuck and device.state is not LinkState.CLOSED:
            aside(device.close)


def _devices(rig: Rig) -> tuple[Device, ...]:
    try:
        return (rig.projector, *rig.cameras.values())
    except Exception:  # noqa: BLE001  a third party's rig may know its devices only once it is open
        return ()
