"""The simulated rig's time: real, or as fast as frames are computed."""

import threading
import time


class Clock:
    """Time in [s] since the clock was made, shared by the devices of a rig."""

    def __init__(self, *, realtime: bool) -> None:
        self._realtime = realtime
        self._start_s = time.monotonic()
        self._virtual_s = 0.0
        self._lock = threading.Lock()

    def now_s(self) -> float:
        """Return the time."""
        if self._realtime:
            return time.monotonic() - self._start_s
        with self._lock:
            return self._virtual_s

    def wait_until(self, time_s: float, cancelled: threading.Event) -> None:
        """Wait for a time, or until cancelled; a virtual clock is put forward instead."""
        if self._realtime:
            cancelled.wait(max(0.0, time_s - self.now_s()))
            return
        with self._lock:
            self._virtual_s = max(self._virtual_s, time_s)


class MachineClock(Clock):
    """The machine's own monotonic time, for what happens outside the simulation."""

    def __init__(self) -> None:
        super().__init__(realtime=True)
        self._start_s = 0.0
