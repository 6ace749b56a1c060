"""A monitor as light: what it really showed, and when, for simulated cameras that look at it.

One process looks at the monitor many times a second and keeps the frames that differ; the cameras' processes
ask it what was lit while they exposed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.shared_memory import SharedMemory
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import DeviceDisconnected, DeviceNotFound
from backend.devices.sim.renderer import Shown

if TYPE_CHECKING:
    import mss

_KEPT = 12
"""Frames that are remembered: more than an exposure sees unless something moves on the monitor."""
_NAME = "monitor"
_HEADER = np.dtype(
    [("looked_s", "f8"), ("count", "i8"), ("since_s", "f8", (_KEPT,)), ("numbers", "i8", (_KEPT,))]
)
_PATIENCE_S = 5.0
"""So long the monitor may go without being looked at before whoever exposes gives up."""
_POLL_S = 0.002


@dataclass(frozen=True)
class Region:
    """Part of the desktop, in [px]."""

    left_px: int
    top_px: int
    width_px: int
    height_px: int


class Screen:
    """Reads a region of the desktop.

    Raises
    ------
    DeviceNotFound
        If the package that reads it isn't installed, or there is no desktop.
    """

    def __init__(self, region: Region) -> None:
        self._region = region
        self._desktop = self._connected()

    def gray(self) -> UInt8[np.ndarray, "h w"]:
        """Return what the region shows now; black where there is no monitor any more."""
        from mss.exception import ScreenShotError

        region = self._region
        try:
            shot = self._desktop.grab(
                {"left": region.left_px, "top": region.top_px, "width": region.width_px, "height": region.height_px}
            )  # fmt: skip
        except ScreenShotError:
            self.close()
            self._desktop = self._connected()
            return np.zeros((region.height_px, region.width_px), np.uint8)
        colours = np.frombuffer(shot.raw, np.uint8).reshape(region.height_px, region.width_px, 4)
        return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGRA2GRAY), np.uint8)

    def close(self) -> None:
        """Let the desktop go."""
        self._desktop.close()

    def _connected(self) -> "mss.MSS":
        try:
            import mss
            from mss.exception import ScreenShotError
        except ImportError as error:
            raise DeviceNotFound(
                _NAME, "what reads it isn't installed; run: pip install 'unglare[monitor]'"
            ) from error
        try:
            return mss.MSS()
        except ScreenShotError as error:
            raise DeviceNotFound(
                _NAME, f"there is no desktop to look at ({error}); set DISPLAY"
            ) from error


class MonitorHistory:
    """What a monitor showed lately, in memory that processes share.

    Made by who looks; handed to other processes as an argument when they are started. Bounded: some frames,
    whatever happens on the monitor.

    Parameters
    ----------
    width_px, height_px
        Size of the monitor.
    """

    def __init__(self, width_px: int, height_px: int) -> None:
        self._shape = (_KEPT, height_px, width_px)
        self._memory = SharedMemory(create=True, size=_HEADER.itemsize + int(np.prod(self._shape)))
        self._map()
        self._header["looked_s"], self._header["count"] = -np.inf, 0

    def _map(self) -> None:
        self._header: Any = np.ndarray((), _HEADER, self._memory.buf)
        self._frames: UInt8[np.ndarray, "kept h w"] = np.ndarray(
            self._shape, np.uint8, self._memory.buf, _HEADER.itemsize
        )

    def __getstate__(self) -> dict[str, Any]:
        """Hand the memory over by its name."""
        return {"_shape": self._shape, "_memory": self._memory}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Find the same memory."""
        self.__dict__.update(state)
        self._map()

    def note(
        self, gray: UInt8[np.ndarray, "h w"], time_s: float, since_s: float | None = None
    ) -> int:
        """Take one look: kept if it differs from the last one. Only one process does this. Return the frame's number.

        Parameters
        ----------
        gray
            What is shown.
        time_s
            When it was looked at, in [s] of `time.monotonic()`.
        since_s
            Since when it is shown; None: not known, then half way between the two looks, which is right on average.
        """
        count, before_s = int(self._header["count"]), float(self._header["looked_s"])
        if count == 0 or not np.array_equal(self._frames[(count - 1) % _KEPT], gray):
            slot = count % _KEPT
            self._header["numbers"][slot] = -1  # whoever reads it now notices
            self._frames[slot] = gray
            middle_s = time_s if count == 0 else (before_s + time_s) / 2
            self._header["since_s"][slot] = middle_s if since_s is None else since_s
            self._header["numbers"][slot] = count
            self._header["count"] = count + 1
        self._header["looked_s"] = time_s
        return int(self._header["count"]) - 1

    def unchanged(self, time_s: float) -> None:
        """Note that nothing has changed until now."""
        self._header["looked_s"] = time_s

    @property
    def looked_s(self) -> float:
        """When the monitor was looked at last."""
        return float(self._header["looked_s"])

    def shown(self, start_s: float, end_s: float) -> list[tuple[int, float]]:
        """Return the numbers of the frames that were lit between two times, with their shares, oldest first.

        What was before the first frame that is still remembered counts as that one.
        """
        count = int(self._header["count"])
        numbers = range(max(0, count - _KEPT + 1), count)
        since_s = np.array([float(self._header["since_s"][n % _KEPT]) for n in numbers])
        since_s[0] = -np.inf
        begins = np.clip(since_s, start_s, end_s)
        ends = np.append(begins[1:], end_s)
        shares = (ends - begins) / (end_s - start_s)
        return [(n, float(s)) for n, s in zip(numbers, shares, strict=True) if s > 0]

    def frame(self, number: int) -> UInt8[np.ndarray, "h w"] | None:
        """Return a copy of a frame; None if it isn't remembered any more."""
        slot = number % _KEPT
        copy: UInt8[np.ndarray, "h w"] = self._frames[slot].copy()
        copy.setflags(write=False)
        return copy if int(self._header["numbers"][slot]) == number else None

    def close(self) -> None:
        """Let the memory go."""
        del self._header, self._frames
        self._memory.close()

    def destroy(self) -> None:
        """Give the memory back; for who made it, when the others are gone."""
        self.close()
        self._memory.unlink()


class MonitorDisplay:
    """A `Light`: the monitor, as cameras see it.

    Parameters
    ----------
    history
        What is known of the monitor.
    lag_s
        So much later than on the monitor everything comes to light, as on projectors that process their input.
    """

    def __init__(self, history: MonitorHistory, *, lag_s: float = 0.0) -> None:
        self._history = history
        self._lag_s = lag_s
        self._known: dict[int, Shown] = {}

    def during(self, start_s: float, end_s: float) -> tuple[tuple[Shown, float], ...]:
        """Return the frames lit meanwhile; waits until the monitor was looked at after `end_s`.

        Raises
        ------
        DeviceDisconnected
            If nobody looks at the monitor any more.
        """
        start_s, end_s = start_s - self._lag_s, end_s - self._lag_s
        self._wait_until(end_s)
        known: dict[int, Shown] = {}
        parts: list[tuple[Shown, float]] = []
        for number, share in self._history.shown(start_s, end_s):
            known[number] = self._known.get(number) or self.held(number)
            parts.append((known[number], share))
        self._known = known
        return tuple(parts)

    def held(self, number: int) -> Shown:
        """Return one frame that stays, whatever is shown next: what a trigger line fired for.

        Raises
        ------
        DeviceDisconnected
            If it isn't remembered any more.
        """
        frame = self._history.frame(number)
        if frame is None:
            raise DeviceDisconnected(
                _NAME, "it changes faster than it can be looked at; show still patterns on it"
            )
        return Shown(frame, number)

    def _wait_until(self, time_s: float) -> None:
        deadline_s = time.monotonic() + _PATIENCE_S
        while self._history.looked_s < time_s:
            if time.monotonic() > deadline_s:
                raise DeviceDisconnected(_NAME, "nobody looks at it any more; start again")
            time.sleep(_POLL_S)


def watch(
    gray: Callable[[], UInt8[np.ndarray, "h w"]],
    history: MonitorHistory,
    *,
    looks_per_s: float,
    ended: Callable[[float], bool],
) -> None:
    """Look at a monitor until told to end.

    Parameters
    ----------
    gray
        Reads the monitor.
    history
        Takes what was seen.
    looks_per_s
        How often; what changes between two looks is known to half of that.
    ended
        Waits for so many seconds at most and says whether to end, e.g. `Event.wait`.
    """
    period_s = 1.0 / looks_per_s
    due_s = time.monotonic()
    while not ended(max(0.0, due_s - time.monotonic())):
        seen_s = time.monotonic()
        history.note(gray(), seen_s)
        due_s = max(
            due_s + period_s, seen_s + period_s / 4
        )  # late: catch up, but leave time for others
