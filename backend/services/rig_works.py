"""Work at rigs that takes longer than an answer may: one piece at a time for each rig, with progress and cancel."""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from backend.contract.events import Event, RigChanged
from backend.contract.rigs import LatencyView, WorkStatus
from backend.domain.errors import CancelledError, ConflictError, UnglareError
from backend.jobs.control import JobControl, Live

_log = logging.getLogger(__name__)
_ENDING_S = 10.0
"""How long the application waits for work when it ends."""


@dataclass(frozen=True)
class Found:
    """What came of it."""

    latency: LatencyView | None = None
    lines: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class Work:
    """A piece of work as it stands."""

    kind: str
    who: str
    status: WorkStatus = WorkStatus.RUNNING
    live: Live = field(default_factory=Live)
    error: str | None = None
    found: Found = field(default_factory=Found)


class RigWorks:
    """The last piece of work of each rig.

    Parameters
    ----------
    publish
        Told when one begins, gets further and ends.
    """

    def __init__(self, publish: Callable[[Event], None]) -> None:
        self._publish = publish
        self._lock = threading.Lock()
        self._works: dict[str, Work] = {}
        self._running: dict[str, tuple[JobControl, threading.Thread]] = {}

    def of(self, rig: str) -> Work | None:
        """Return the running or last piece of work of a rig."""
        return self._works.get(rig)

    def start(self, rig: str, kind: str, who: str, do: Callable[[JobControl], Found]) -> None:
        """Begin; returns at once.

        Raises
        ------
        ConflictError
            If something runs at this rig.
        """
        control = JobControl(lambda live: self._note(rig, live))
        thread = threading.Thread(
            target=self._run, args=(rig, control, do), name=f"{kind} of {rig}", daemon=True
        )
        with self._lock:
            before = self._works.get(rig)
            if before is not None and before.status is WorkStatus.RUNNING:
                raise ConflictError(
                    f"{before.who} runs the {before.kind} of rig {rig!r}: wait for its end or cancel it."
                )
            self._works[rig] = Work(kind, who)
            self._running[rig] = control, thread
        thread.start()
        self._publish(RigChanged(rig=rig))

    def cancel(self, rig: str, who: str) -> None:
        """Have the running work ended.

        Raises
        ------
        ConflictError
            If nothing runs.
        """
        work, running = self._works.get(rig), self._running.get(rig)
        if work is None or running is None or work.status is not WorkStatus.RUNNING:
            raise ConflictError(f"Nothing runs at rig {rig!r} that could be cancelled.")
        running[0].stop(who)

    def close(self) -> None:
        """Cancel everything and wait a moment for its end."""
        running = list(self._running.values())
        for control, _ in running:
            control.stop(None)
        for _, thread in running:
            thread.join(_ENDING_S)

    def _run(self, rig: str, control: JobControl, do: Callable[[JobControl], Found]) -> None:
        try:
            self._end(rig, status=WorkStatus.FINISHED, found=do(control))
        except CancelledError:
            self._end(rig, status=WorkStatus.CANCELLED)
        except UnglareError as error:
            self._end(rig, status=WorkStatus.FAILED, error=error.sentence)
        except Exception as error:  # noqa: BLE001 - a defect, kept with its traceback; the operator is told
            _log.exception("Work at rig %r failed.", rig)
            sentence = f"It failed with {type(error).__name__}: {error}; see the server's log."
            self._end(rig, status=WorkStatus.FAILED, error=sentence)

    def _end(
        self, rig: str, *, status: WorkStatus, error: str | None = None, found: Found | None = None
    ) -> None:
        with self._lock:
            self._works[rig] = replace(
                self._works[rig], status=status, error=error, found=found or Found()
            )
            self._running.pop(rig, None)
        self._publish(RigChanged(rig=rig))

    def _note(self, rig: str, live: Live) -> None:
        with self._lock:
            work = self._works[rig]
            if work.status is WorkStatus.RUNNING:
                self._works[rig] = replace(work, live=live)
