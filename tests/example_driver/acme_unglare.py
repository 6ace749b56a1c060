"""Acme's camera and projector for unglare: an example to begin a driver with.

A driver has the methods of `backend.devices.protocols`. Nothing has to be inherited, but `Link` brings a device's
life, and `refusals` says in everybody's words what can't be done. `_Cell` stands where Acme's library would be
called: a dark box in which the camera sees what the projector shows, enlarged or reduced.
"""

import queue
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from backend.devices import refusals
from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.errors import DeviceTimeout
from backend.devices.link import Link
from backend.devices.options import DeviceOptions, Size, read_options, takes
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
    LinkState,
    Presented,
    ProjectorCapabilities,
    Range,
    TriggerSource,
)

FULL_SCALE_US = 100_000.0  # white gives the largest gray level at this exposure


class _Cell:
    shown = np.zeros((1, 1), np.uint8)


_CELLS: dict[str, _Cell] = {}


class Options(DeviceOptions):
    """A camera or projector in one of Acme's boxes."""  # `unglare drivers acme` shows these sentences

    cell: str = Field("1", description="Which box it is in.")
    size: Size = Field((64, 48), description="Width and height of its pictures or patterns [px].")


def _seen(shown: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    rows, columns = (np.arange(n) * m // n for n, m in zip(size[::-1], shown.shape, strict=True))
    return shown[np.ix_(rows, columns)].astype(float)


class AcmeLink(Link):
    """What both have in common: they are there or not."""

    def __init__(self, name: str, model: str, options: Options) -> None:
        super().__init__(name, DeviceInfo("Acme", model, driver="acme 1.0", simulated=True))
        self._cell, self._size = _CELLS.setdefault(options.cell, _Cell()), options.size

    def open(self) -> None:
        """Connect; say `DeviceNotFound` or `DeviceBusy` where that can't be. A second time changes nothing."""
        if self._state in (LinkState.CLOSED, LinkState.LOST):
            self._state = LinkState.READY

    def close(self) -> None:
        """Give the device back: in any state, any number of times, without raising."""
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Real hardware: again and again until the time is over, then settings and patterns once more."""
        self.close()
        self.open()


class AcmeCamera(AcmeLink):
    """Returns from every call in the time it was given, or raises one of `backend.devices.errors`."""

    def __init__(self, name: str, options: Options) -> None:
        super().__init__(name, "Eye", options)
        self._frames: queue.SimpleQueue[Frame | None] = queue.SimpleQueue()  # None: `abort`
        self._count = 0
        self.settings = CameraSettings(20_000.0, pixel_format="Mono8")

    @property
    def capabilities(self) -> CameraCapabilities:
        exposures, gains = Range(10.0, 2_000_000.0, 1.0, "us"), Range(0.0, 12.0, 0.0, "dB")
        triggers = (TriggerSource.SOFTWARE,)
        return CameraCapabilities(self._size, ("Mono8",), exposures, gains, triggers)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Check everything before anything is set, and return what the camera made of it."""
        self._need_link()
        wanted = replace(settings, pixel_format=settings.pixel_format or self.settings.pixel_format)
        refusals.refuse_impossible(self.name, wanted, self.capabilities)
        if self.state is LinkState.ARMED:
            refusals.refuse_locked(self.name, self.settings, wanted)
        exposure_us = self.capabilities.exposure_us.nearest(wanted.exposure_us)
        self.settings = replace(wanted, exposure_us=exposure_us)
        return self.settings

    def arm(self, n_frames: int | None = None) -> None:
        self._need_link()
        self._frames = queue.SimpleQueue()
        self._state = LinkState.ARMED

    def disarm(self) -> None:
        if self._state is LinkState.ARMED:
            self._state = LinkState.READY

    def abort(self) -> None:
        """From any thread: whoever waits for a frame stops waiting."""
        self._frames.put(None)
        self.disarm()

    def trigger(self) -> None:
        self._need_link()
        refusals.refuse_trigger(self.name, self.settings, armed=self.state is LinkState.ARMED)
        exposure_us, gain_db = self.settings.exposure_us, self.settings.gain_db
        light = _seen(self._cell.shown, self._size) * (exposure_us / FULL_SCALE_US)
        light *= 10 ** (gain_db / 20)
        gray = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        now_s = time.monotonic()
        self._frames.put(Frame(gray, "Mono8", 8, self._count, exposure_us, gain_db, None, now_s))
        self._count += 1

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        self._need_link()
        try:
            frame = self._frames.get(timeout=timeout_s)
        except queue.Empty:
            frame = None
        if frame is None:
            raise DeviceTimeout(self.name, f"no frame came in {timeout_s:g} s; look at its cable")
        return frame


class AcmeProjector(AcmeLink):
    """Shows patterns pixel by pixel, never scaled, and returns when they are lit."""

    _patterns: tuple[np.ndarray, ...] = ()

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(self._size, linear=True)

    def load(self, patterns: Sequence[np.ndarray]) -> None:
        self._need_link()
        refusals.refuse_other_sizes(self.name, patterns, self._size)
        self._patterns = tuple(pattern.copy() for pattern in patterns)

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        self._need_link()
        refusals.refuse_unloaded(self.name, index, len(self._patterns))
        return self._light(self._patterns[index], index)

    def blank(self, level: int = 0) -> Presented:
        self._need_link()
        refusals.refuse_level(self.name, level)
        return self._light(np.full(self._size[::-1], level, np.uint8), -1)

    def _light(self, pattern: np.ndarray, index: int) -> Presented:
        self._cell.shown = pattern
        return Presented(index, time.monotonic(), None, confirmed=True)


@takes(Options)
def create_camera(name: str, options: Mapping[str, Any]) -> AcmeCamera:
    """Make a camera of a rig file's entry; nothing is opened yet."""
    return AcmeCamera(name, read_options(Options, name, options))


@takes(Options)
def create_projector(name: str, options: Mapping[str, Any]) -> AcmeProjector:
    """Make a projector of a rig file's entry; nothing is opened yet."""
    return AcmeProjector(name, "Lamp", read_options(Options, name, options))


@takes(Options)
def create_rig(options: Mapping[str, Any]) -> AssembledRig:
    """Make Acme's whole cell, for those who don't want to write a rig file."""
    eye, lamp = create_camera("left", options), create_projector("projector", options)
    return AssembledRig("acme-cell", {"left": eye}, lamp, sensors={"left": SensorFacts()})
