"""A thread that looks at one thing again and again, as long as it is on the screen."""

import threading
from collections.abc import Callable


class Poll:
    """Looks at what it is told to, with a pause in between; nothing is looked at while it has no target.

    Parameters
    ----------
    name
        Name of the thread.
    look
        Called with the target, on the poll's thread.
    on_error
        Told what `look` raised; then it pauses longer.
    pause_s
        Between two looks.
    """

    def __init__(
        self,
        name: str,
        look: Callable[[str], None],
        on_error: Callable[[Exception], None],
        *,
        pause_s: float,
        pause_after_error_s: float = 3.0,
    ) -> None:
        self._look, self._on_error = look, on_error
        self._pause_s, self._pause_after_error_s = pause_s, pause_after_error_s
        self._target: str | None = None
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def target(self) -> str | None:
        """What is looked at."""
        return self._target

    def turn_to(self, target: str | None) -> None:
        """Look at something else from now on; None: at nothing."""
        with self._changed:
            self._target = target
            self._changed.notify()

    def close(self) -> None:
        """End after the present look."""
        with self._changed:
            self._closed, self._target = True, None
            self._changed.notify()

    def _run(self) -> None:
        pause_s = 0.0
        while not self._closed:
            with self._changed:
                if pause_s:
                    self._changed.wait(pause_s)
                self._changed.wait_for(lambda: self._target is not None or self._closed)
                target = self._target
            if target is None:
                return
            pause_s = self._pause_s
            try:
                self._look(target)
            except Exception as error:  # noqa: BLE001 - the thread has to outlive any defect; handed on
                pause_s = self._pause_after_error_s
                if not self._closed:
                    self._on_error(error)
