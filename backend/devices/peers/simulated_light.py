"""What lights simulated hardware: a monitor that is watched, or a simulated LightCrafter that fires the cameras."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from backend.devices import dlpc350_protocol
from backend.devices.pattern_set import PatternSet
from backend.devices.peers.dlpc350 import SimulatedDlpc350
from backend.devices.peers.monitor_display import MonitorHistory, Region, Screen, watch
from backend.domain.errors import StartupError

Fire = Callable[[int, float, float], None]
"""Fires all trigger lines: number of the frame, time in [s], how long it is shown in [us]."""
Ended = Callable[[float], bool]
"""Waits for so many seconds at most and says whether to end, e.g. `Event.wait`."""

_TICK_S = 0.002


@runtime_checkable
class LightSource(Protocol):
    """What lights the scene, and what a rig file says of it."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in [px]."""
        ...

    @property
    def words(self) -> str:
        """What it is, for an operator."""
        ...

    @property
    def entry(self) -> dict[str, Any]:
        """Return the projector's entry in the rig file."""
        ...

    @property
    def trigger_line(self) -> str | None:
        """The cameras' line that it fires; None: cameras are triggered by software."""
        ...

    def run(self, history: MonitorHistory, fire: Fire, ended: Ended) -> None:
        """Tell what is shown, and fire, until told to end."""
        ...


class MonitorLight:
    """A monitor: the projector page on it is the projector.

    Parameters
    ----------
    region, words
        Where it is, and its name.
    page, refresh_hz
        Of the rig file.
    """

    def __init__(
        self,
        region: Region,
        words: str,
        *,
        page: str = "projector",
        refresh_hz: float = 60.0,
        looks_per_s: float = 100.0,
    ) -> None:
        self._region = region
        self._page, self._refresh_hz = page, refresh_hz
        self._looks_per_s = looks_per_s
        self.words = f"monitor {words}"
        self.size = (region.width_px, region.height_px)
        self.trigger_line: str | None = None
        with contextlib.closing(Screen(region)):
            pass  # refused before anything is started

    @property
    def entry(self) -> dict[str, Any]:
        """Return the projector's entry in the rig file."""
        size = f"{self.size[0]}x{self.size[1]}"
        page = {"driver": "page", "page": self._page, "size": size}
        return {**page, "refresh_hz": self._refresh_hz}

    def run(self, history: MonitorHistory, fire: Fire, ended: Ended) -> None:
        """Look at it until told to end."""
        del fire
        with contextlib.closing(Screen(self._region)) as screen:
            watch(screen.gray, history, looks_per_s=self._looks_per_s, ended=ended)


class LightcrafterLight:
    """A simulated LightCrafter 4500 at a socket, with a set of patterns in its flash.

    Parameters
    ----------
    folder
        Of the set, exported with `--pack 24bit`.
    socket_path
        Where the driver finds it: `transport: unix:PATH`.

    Raises
    ------
    RigConfigError
        If there is no set in the folder.
    """

    def __init__(self, folder: Path, socket_path: Path) -> None:
        self._folder, self._path = folder.absolute(), socket_path.absolute()
        self._flash = PatternSet.read(self._folder).image_pictures(self._folder)
        self.words = f"a simulated LightCrafter 4500 at {self._path}"
        self.size = dlpc350_protocol.SIZE_PX
        self.trigger_line: str | None = "Line1"

    @property
    def entry(self) -> dict[str, Any]:
        """Return the projector's entry in the rig file."""
        transport = f"unix:{self._path}"
        return {"driver": "dlpc350", "patterns": str(self._folder), "transport": transport}

    def run(self, history: MonitorHistory, fire: Fire, ended: Ended) -> None:
        """Answer the driver until told to end."""
        lamp = _Lamp(history, fire, self.size)
        with self._listening(lamp):
            while not ended(_TICK_S):
                lamp.go_on()

    @contextlib.contextmanager
    def _listening(self, lamp: "_Lamp") -> Iterator[None]:
        with SimulatedDlpc350(lamp, self._flash) as device:
            try:
                device.listen(str(self._path))
            except OSError as error:
                raise StartupError(
                    f"The simulated LightCrafter can't listen at {self._path} ({error.strerror}): remove that file if no other"
                    " one runs, or choose another with --socket."
                ) from error
            yield


class _Lamp:
    """The LightCrafter's mirrors and its trigger line."""

    def __init__(self, history: MonitorHistory, fire: Fire, size: tuple[int, int]) -> None:
        self._history, self._fire = history, fire
        self._lock = threading.Lock()
        width, height = size
        self._number = history.note(np.zeros((height, width), np.uint8), self.now_s())

    def now_s(self) -> float:
        """Return the machine's time."""
        return time.monotonic()

    def light(self, picture: UInt8[np.ndarray, "h w"]) -> None:
        """Show a picture from now on."""
        with self._lock:
            now_s = self.now_s()
            self._number = self._history.note(picture, now_s, since_s=now_s)

    def edge(self, time_s: float, shown_us: float) -> None:
        """Fire for what is shown."""
        self._fire(self._number, time_s, shown_us)

    def go_on(self) -> None:
        """Note that everything is as it was."""
        with self._lock:
            self._history.unchanged(self.now_s())
