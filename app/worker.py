"""A thread that does one thing after the other, so that viser's own threads never wait."""

import logging
import threading
from collections.abc import Callable

_LOG = logging.getLogger(__name__)

Work = Callable[[], None]


class Worker:
    """Does what it is given, in order; work with a key replaces waiting work with the same key.

    Parameters
    ----------
    name
        Name of the thread.
    on_error
        Called, on the worker's thread, with whatever an item of work raised.
    """

    def __init__(self, name: str, on_error: Callable[[Exception], None]) -> None:
        self._on_error = on_error
        self._waiting: list[tuple[str | None, Work]] = []
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, work: Work, *, key: str | None = None) -> None:
        """Put work at the end of the queue; returns at once."""
        with self._changed:
            if key is not None:
                self._waiting = [(k, w) for k, w in self._waiting if k != key]
            self._waiting.append((key, work))
            self._changed.notify()

    def close(self) -> None:
        """Drop what is waiting and end after the present work."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread's end."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                _, work = self._waiting.pop(0)
            try:
                work()
            except Exception as error:  # noqa: BLE001 - the thread has to outlive any defect; handed on
                self._report(error)

    def _report(self, error: Exception) -> None:
        if self._closed:
            return  # the browser is gone, so is whatever the work wanted to draw on
        try:
            self._on_error(error)
        except Exception:  # noqa: BLE001 - the last resort of the line above
            _LOG.exception("could not report an error")
