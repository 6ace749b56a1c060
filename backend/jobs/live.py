"""Live pictures of a rig that nobody captures with: cameras stay armed from one picture to the next."""

import contextlib
import itertools
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import DeviceError
from backend.devices.protocols import (
    Camera,
    CameraSettings,
    Frame,
    LinkState,
    Projector,
    Range,
    Rig,
    TriggerSource,
)
from backend.devices.rig_shelf import ASSUMED_REFRESH_HZ
from backend.domain.errors import InvalidSettingError
from backend.jobs.device_threads import DeviceThreads
from backend.numerics.errors import NumericsError
from backend.numerics.test_patterns import TEST_PATTERNS, test_pattern

GRAY = "gray"
"""The pattern that is one gray level everywhere; all others are test patterns."""
PATTERNS = (
    "black",
    "white",
    GRAY,
    *(kind for kind in TEST_PATTERNS if kind not in ("black", "white")),
)
"""What can be projected while pictures are live."""

_EVEN = {"black": 0, "white": 255}
_FRAME_TIMEOUT_S = 3.0


@dataclass(frozen=True)
class LiveWish:
    """How live pictures are taken, by all cameras alike."""

    exposure_ms: float
    gain_db: float = 0.0
    pattern: str = "white"
    """One of `PATTERNS`."""
    level: int = 128
    """Code of the pattern `gray`, 0..255."""


@dataclass(frozen=True)
class LivePicture:
    """The newest picture of a camera; never stored."""

    gray: np.ndarray[Any, np.dtype[Any]]
    bit_depth: int
    exposure_ms: float | None = None
    gain_db: float | None = None
    taken_s: float = field(default_factory=time.monotonic)
    """time.monotonic() when it was there."""
    number: int = field(default_factory=itertools.count().__next__)
    """Tells two pictures apart."""

    @classmethod
    def of(cls, frame: Frame) -> "LivePicture":
        """Keep what is shown of a frame."""
        return cls(frame.data, frame.bits, frame.exposure_us / 1000.0, frame.gain_db)


class LiveBench:
    """A rig's devices while pictures are live. Used on the rig's own thread only.

    Parameters
    ----------
    rig
        An opened rig.
    threads
        Those of its devices.
    """

    def __init__(self, rig: Rig, threads: DeviceThreads) -> None:
        self._rig = rig
        self._threads = threads
        self._asked: dict[str, CameraSettings] = {}
        self._lit: tuple[str, int] | None = None

    def take(self, wish: LiveWish) -> dict[str, LivePicture]:
        """Take one picture with each camera; arms them and lights the scene where that isn't done yet.

        Raises
        ------
        DeviceError
            If a device fails or never answers. The next call arms afresh.
        """
        cameras = self._rig.cameras
        waiting = max(camera.capabilities.buffered_frames for camera in cameras.values())
        wait_s = (1 + waiting) * (wish.exposure_ms / 1000.0 + _FRAME_TIMEOUT_S)
        try:
            self._light(wish)
            self._threads.each(
                list(cameras), "setting it up", lambda name: self._prepare(cameras[name], wish)
            )
            frames = self._threads.each(
                list(cameras),
                "taking a picture",
                lambda name: _picture(cameras[name]),
                wait_s=wait_s,
            )
        except DeviceError:
            self._forget()
            raise
        return {name: LivePicture.of(frame) for name, frame in frames.items()}

    def rest(self) -> None:
        """Disarm the cameras and darken the projector; a device that fails at that is noticed by its next user."""
        self._forget()
        projector = self._rig.projector
        if projector.state is LinkState.READY:
            with contextlib.suppress(DeviceError):
                self._threads.call(projector.name, "darkening", projector.blank)

    def _light(self, wish: LiveWish) -> None:
        lit = (wish.pattern, wish.level if wish.pattern == GRAY else 0)
        if lit != self._lit:
            projector = self._rig.projector
            self._threads.call(projector.name, "showing a pattern", lambda: _show(projector, wish))
            self._lit = lit

    def _prepare(self, camera: Camera, wish: LiveWish) -> None:
        can = camera.capabilities
        settings = CameraSettings(
            # To the nanosecond: 240 periods of 1000/120 ms are 2000000.0000000002 us, beyond a limit of 2 s.
            exposure_us=_within(can.exposure_us, round(wish.exposure_ms * 1000.0, 3)),
            gain_db=_within(can.gain_db, wish.gain_db),
            trigger=_trigger(camera),
        )
        if self._asked.get(camera.name) != settings:
            if camera.state is LinkState.ARMED and camera.settings.trigger != settings.trigger:
                camera.disarm()
            camera.configure(settings)
            self._asked[camera.name] = settings
        if camera.state is not LinkState.ARMED:
            camera.arm()

    def _forget(self) -> None:
        self._asked, self._lit = {}, None
        for camera in self._rig.cameras.values():
            if camera.state is LinkState.ARMED:
                with contextlib.suppress(DeviceError):  # it is lost, its state says so
                    self._threads.call(camera.name, "disarming", camera.disarm)


def _show(projector: Projector, wish: LiveWish) -> None:
    if wish.pattern == GRAY or wish.pattern in _EVEN:
        presented = projector.blank(_EVEN.get(wish.pattern, wish.level))
    else:
        width_px, height_px = projector.capabilities.size
        projector.load([picture_of(wish.pattern, width_px, height_px, projector.name)])
        presented = projector.show(0)
    if not presented.confirmed:
        time.sleep(1.0 / (projector.capabilities.refresh_hz or ASSUMED_REFRESH_HZ))


def picture_of(pattern: str, width_px: int, height_px: int, label: str) -> UInt8[np.ndarray, "h w"]:
    """Draw a test pattern for a projector.

    Raises
    ------
    InvalidSettingError
        If there is no such pattern, or the projector is too small for it.
    """
    try:
        drawn: UInt8[np.ndarray, "h w"] = test_pattern(pattern, width_px, height_px, label=label)
    except NumericsError as error:
        text = str(error)
        raise InvalidSettingError(f"{text[:1].upper()}{text[1:]}.") from error
    return drawn


def refuse_pattern(pattern: str, size_px: tuple[int, int]) -> None:
    """Refuse what a projector of this size can't show; InvalidSettingError."""
    if pattern not in PATTERNS:
        raise InvalidSettingError(f"There is no pattern {pattern!r}: choose {', '.join(PATTERNS)}.")
    if pattern not in (*_EVEN, GRAY):
        picture_of(pattern, *size_px, "")


def _within(limits: Range, value: float) -> float:
    return min(max(value, limits.min), limits.max)


def _trigger(camera: Camera) -> TriggerSource:
    known = camera.capabilities.trigger_sources
    return TriggerSource.SOFTWARE if TriggerSource.SOFTWARE in known else TriggerSource.FREE_RUN


def _picture(camera: Camera) -> Frame:
    """Take a picture; of a camera that runs freely, one that was exposed after those that may be waiting."""
    if _trigger(camera) is TriggerSource.SOFTWARE:
        camera.trigger()
        return camera.get_frame(_FRAME_TIMEOUT_S)
    for _ in range(camera.capabilities.buffered_frames):
        camera.get_frame(_FRAME_TIMEOUT_S)
    return camera.get_frame(_FRAME_TIMEOUT_S)
