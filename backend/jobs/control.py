"""The thread-safe side of a running job: how far it is, and how it is stopped."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from backend.domain.errors import CancelledError

REPORT_PERIOD_S = 0.1
"""Progress goes out at most this often: ten times a second is more than an eye wants."""


@dataclass(frozen=True)
class Live:
    """How far a running job is. Kept in memory only: a crash loses nothing worth keeping."""

    stage: str | None = None
    progress: float = 0.0
    """Share of the stage done, 0..1."""
    text: str = ""
    remaining_s: float | None = None
    """Estimate for the stage; None where there is none."""


class JobControl:
    """Connects one running job with those who watch it or stop it.

    Parameters
    ----------
    publish
        Called, at most ten times a second and at every new stage, with the job's state.
    clock
        Seconds that only go forward; only tests pass another one.
    """

    def __init__(
        self,
        publish: Callable[[Live], None] = lambda live: None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._publish = publish
        self._clock = clock
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._on_stop: list[Callable[[], None]] = []
        self._live = Live()
        self._stage_began = clock()
        self._told = clock() - REPORT_PERIOD_S
        self._later: threading.Timer | None = None
        self.stopped_by: str | None = None
        """Who cancelled; None while nobody did, or when the application shuts down."""

    @property
    def live(self) -> Live:
        """The job's state now."""
        return self._live

    @property
    def stopping(self) -> bool:
        """True as soon as somebody wants the job to end."""
        return self._stopping.is_set()

    def stop(self, who: str | None) -> None:
        """Ask the job to end, from any thread; `who` is None when the application shuts down."""
        with self._lock:
            if self._stopping.is_set():
                return
            self.stopped_by = who
            self._stopping.set()
            callbacks = list(self._on_stop)
        for callback in callbacks:
            callback()

    def check(self) -> None:
        """Raise `CancelledError` if the job has to end."""
        if self._stopping.is_set():
            by = f" by {self.stopped_by}" if self.stopped_by else ""
            raise CancelledError(
                f"Cancelled{by}: finished stages and captured frames are kept, run again to go on."
            )

    def pause(self, seconds: float) -> None:
        """Wait; `CancelledError` at once if the job has to end meanwhile."""
        self._stopping.wait(seconds)
        self.check()

    @contextmanager
    def when_stopped(self, callback: Callable[[], None]) -> Iterator[None]:
        """Call back once, from the stopping thread, if the job is stopped inside this block."""
        with self._lock:
            self._on_stop.append(callback)
            late = self._stopping.is_set()
        try:
            if late:
                callback()
            yield
        finally:
            with self._lock:
                self._on_stop.remove(callback)

    def begin_stage(self, stage: str, text: str = "") -> None:
        """Start a stage's progress at 0."""
        self.check()
        self._stage_began = self._clock()
        self._tell(Live(stage, 0.0, text), now=True)

    def note(self, text: str) -> None:
        """Change the text only."""
        self._tell(replace(self._live, text=text), now=True)

    def progress(self, done: float, text: str = "") -> None:
        """Report the share done of the stage; the remaining time is estimated from the pace so far."""
        self.check()
        share = min(max(float(done), 0.0), 1.0)
        elapsed_s = self._clock() - self._stage_began
        remaining_s = elapsed_s * (1 - share) / share if share > 0 else None
        self._tell(replace(self._live, progress=share, text=text, remaining_s=remaining_s))

    def shots(self, done: float | None, text: str, remaining_s: float | None) -> None:
        """Report the progress of a capture, which knows its remaining time itself; None keeps the share."""
        self.check()
        share = self._live.progress if done is None else done
        self._tell(replace(self._live, progress=share, text=text, remaining_s=remaining_s))

    def _tell(self, live: Live, *, now: bool = False) -> None:
        """Publish now, or, if that was done a moment ago, in a moment: the last word before a silence counts."""
        with self._lock:
            self._live = live
            wait_s = self._told + REPORT_PERIOD_S - self._clock()
            if wait_s > 0 and not now:
                if self._later is None:
                    self._later = threading.Timer(wait_s, self._tell_late)
                    self._later.daemon = True
                    self._later.start()
                return
            self._told = self._clock()
        self._publish(live)

    def _tell_late(self) -> None:
        with self._lock:
            self._later = None
            self._told = self._clock()
        self._publish(self._live)
