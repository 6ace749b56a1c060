"""Take single shots on a rig: show a pattern, trigger the cameras together, fetch their frames.

Milliseconds become the devices' microseconds here. A shot that fails for a passing reason is taken again.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from types import TracebackType
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import DeviceDisconnected, DeviceError, DeviceStalled
from backend.devices.foreign import refuse_other_frame
from backend.devices.protocols import (
    Camera,
    CameraSettings,
    Device,
    Frame,
    LinkState,
    Rig,
    Settles,
    TriggerSource,
)
from backend.jobs.control import JobControl
from backend.jobs.device_threads import DeviceThreads, aside
from backend.jobs.frame_order import FrameOrder

ATTEMPTS = 3
"""How often one shot is tried before the rig counts as failed."""

FRAME_TIMEOUT_S = 5.0
"""How long a frame may take after the end of its exposure."""

RECONNECTS = 2
"""How often a lost device is fetched back for one shot."""

RECONNECT_S = 20.0
"""How long a lost device is waited for: longer than a camera's heartbeat, within which its dead owner keeps control."""

_RECONNECT_SLICE_S = 2.0
"""So often whoever waits for a device looks whether the job is to end."""

STEADY_S = 0.5
"""After that any display shows what it was asked to."""

_ON_GRID = 0.01
"""Of an exposure may lie beside the grid of refresh periods: less changes a frame by less than any check tells."""

T = TypeVar("T")


@dataclass(frozen=True)
class Take:
    """One exposure of a loaded pattern."""

    index: int
    exposure_ms: float
    gain_db: float
    cameras: tuple[str, ...]
    steady: bool = False
    """Wait until any display has come to rest before the exposure."""


class Shooter:
    """Software-triggered shots on one rig, from the first to the last of a capturing stage.

    Every device is used by one thread only, so that cameras expose at the same time and drivers see one
    thread; a call that doesn't return in time ends the shot (`DeviceStalled`). A device that is lost is fetched back
    and the shot taken again. Cameras that can't be triggered run freely: frames that were exposed too early are thrown
    away. Leaving the block disarms the cameras and darkens the projector, whatever happened inside.

    `backend.jobs.sequence_shooting` has the one for projectors that run their own sequences.
    """

    def __init__(self, rig: Rig, control: JobControl, threads: DeviceThreads | None = None) -> None:
        self._rig = rig
        self._control = control
        self._threads = threads or DeviceThreads((*rig.cameras.values(), rig.projector))
        self._own_threads = threads is None
        self._asked: dict[str, CameraSettings] = {}
        self._pictures: tuple[UInt8[np.ndarray, "h w"], ...] = ()
        self._order = FrameOrder()
        self._stack = ExitStack()
        self.waited_s = 0.0
        """Time spent waiting for the devices, exposures included (a simulated rig's: its computing)."""

    @property
    def projector_size(self) -> tuple[int, int]:
        """Width and height in [px] that patterns must have."""
        return self._rig.projector.capabilities.size

    @property
    def certain(self) -> bool:
        """Whether a pattern is lit by construction when the projector says so."""
        return self._rig.projector.capabilities.certain

    @property
    def way_out(self) -> str:
        """What helps if frames don't show what they were taken for."""
        return (
            f"measure the latency of its display (`unglare rigs latency --rig {self._rig.name}`) or raise the projector's"
            " settle_ms"
        )

    def off_grid(self, cameras: Sequence[str], exposure_ms: float) -> str:
        """Say that an exposure sees a part of a display's frame that is another one each time; empty: it doesn't."""
        refresh_hz = self._rig.projector.capabilities.refresh_hz
        if not refresh_hz or not is_off_grid(exposure_ms, 1000.0 / refresh_hz):
            return ""
        period_ms = 1000.0 / refresh_hz
        return (
            f"{exposure_ms:.4g} ms is no multiple of the projector's refresh period of {period_ms:.4g} ms, so each frame sees"
            " another part of it; expose for whole periods ('Whole projector frames' of the stages, snap_exposures of the rig's"
            " file) or correct the projector's refresh_hz"
        )

    def __enter__(self) -> "Shooter":
        """Let whoever cancels unblock the cameras."""
        self._stack.callback(self._release)
        self._stack.enter_context(self._control.when_stopped(self._abort))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the rig usable."""
        self._stack.close()

    def load(self, pictures: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        """Hand over the patterns of a burst."""
        self._pictures = tuple(pictures)
        self._persistently((), self._load)

    def chunks(self, takes: Sequence[Take]) -> Iterator[Sequence[Take]]:
        """Cut exposures into what is taken at once."""
        for take in takes:
            yield (take,)

    def take_all(self, takes: Sequence[Take]) -> list[dict[str, Frame]]:
        """Take one of the `chunks`; raises what `take` does."""
        return [
            self.take(
                take.index,
                exposure_ms=take.exposure_ms,
                gain_db=take.gain_db,
                cameras=take.cameras,
                steady=take.steady,
            )
            for take in takes
        ]

    def take(
        self,
        index: int,
        *,
        exposure_ms: float,
        gain_db: float,
        cameras: Sequence[str],
        steady: bool = False,
    ) -> dict[str, Frame]:
        """Take one shot of a loaded pattern, again if it fails for a passing reason or a device is lost.

        Raises
        ------
        CancelledError
            If the job is stopped.
        DeviceError
            If the shot failed for good; nothing of it is returned.
        """
        settings = settings_of(exposure_ms, gain_db)
        return self._persistently(
            cameras, lambda: self._once(index, settings, cameras, steady=steady)
        )

    def _persistently(self, cameras: Sequence[str], work: Callable[[], T]) -> T:
        """Do something again if it fails for a passing reason, or a device that was lost is back."""
        failures = losses = 0
        while True:
            self._control.check()
            try:
                return work()
            except DeviceDisconnected as error:
                self._control.check()
                losses += 1
                if losses > RECONNECTS:
                    raise
                self._fetch_back(error)
            except DeviceError as error:
                # A camera that was aborted says that it timed out: the job is cancelled, not the camera broken.
                self._control.check()
                failures += 1
                if not error.retryable or failures == ATTEMPTS:
                    raise
            self._begin_anew(cameras)

    def _begin_anew(self, cameras: Sequence[str]) -> None:
        self._asked.clear()
        for camera in cameras:
            self._order.forget(camera)
        with suppress(DeviceDisconnected):  # the next attempt finds it lost, and fetches it back
            self._each(cameras, "disarming", disarm)

    def _once(
        self, index: int, settings: CameraSettings, cameras: Sequence[str], *, steady: bool
    ) -> dict[str, Frame]:
        with self._waiting():
            self._each(cameras, "arming", lambda camera: self._prepare(camera, settings))
            self._show(index, settings.exposure_us / 1000.0)
            if steady:
                self._control.pause(STEADY_S)
            frames = self._each(
                cameras, "taking a picture", _expose, self._patience_s(cameras, settings)
            )
        for name, frame in frames.items():
            self._order.check(name, frame, gaps=_runs_freely(self._rig.cameras[name]))
        return frames

    def _patience_s(self, cameras: Sequence[str], settings: CameraSettings) -> float:
        """Return how long cameras are told to wait for a shot."""
        waiting = [_thrown_away(self._rig.cameras[name]) for name in cameras]
        return (1 + max(waiting, default=0)) * (settings.exposure_us * 1e-6 + FRAME_TIMEOUT_S)

    # lost devices

    def _fetch_back(self, loss: DeviceDisconnected) -> None:
        """Wait for a device that is lost.

        Raises
        ------
        DeviceDisconnected
            If it doesn't come back in time, or it is none of this rig.
        """
        device = self._device(loss.device)
        if device is None:
            raise loss
        deadline_s = time.monotonic() + RECONNECT_S
        while True:
            left_s = deadline_s - time.monotonic()
            self._control.note(
                f"{device.name} is lost, waiting for it up to {max(left_s, 0):.0f} s"
            )
            try:
                self._reconnect(device, min(_RECONNECT_SLICE_S, max(left_s, 0.0)))
                break
            except DeviceError:
                self._control.check()
                if time.monotonic() >= deadline_s:
                    raise
                self._control.pause(0.1)
        self._asked.pop(device.name, None)
        if device is self._rig.projector and self._pictures:
            self._load()

    def _reconnect(self, device: Device, timeout_s: float) -> None:
        self._threads.call(
            device.name,
            "reconnecting",
            lambda: device.reconnect(timeout_s),
            control=self._control,
            wait_s=timeout_s,
        )

    def _device(self, name: str) -> Device | None:
        if name == self._rig.projector.name:
            return self._rig.projector
        return self._rig.cameras.get(name)

    # what the devices are asked

    def _load(self) -> None:
        with self._waiting():
            self._ask_projector(
                "loading patterns", lambda: self._rig.projector.load(self._pictures)
            )

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.waited_s += time.perf_counter() - began

    def _prepare(self, camera: Camera, settings: CameraSettings) -> None:
        """Set and arm what isn't set and armed yet.

        Compared with what was asked for before: what the camera made of it may be rounded.
        """
        wanted = replace(settings, trigger=_trigger(camera))
        known = self._asked.get(camera.name)
        if known != wanted:
            if known is not None and known.trigger is not wanted.trigger:
                disarm(camera)  # the trigger is locked while armed
            camera.configure(wanted)
            self._asked[camera.name] = wanted
        if camera.state is not LinkState.ARMED:
            self._order.forget(camera.name)
            camera.arm()

    def _show(self, index: int, exposure_ms: float) -> None:
        projector = self._rig.projector
        presented = self._ask_projector("showing a pattern", lambda: projector.show(index))
        refresh_hz = projector.capabilities.refresh_hz
        if not presented.confirmed and refresh_hz:
            self._control.pause(1.0 / refresh_hz)
        if isinstance(projector, Settles):
            known_ms = projector.settle_exposure_ms
            if known_ms is not None and exposure_ms < known_ms - 1e-3:
                # Of the change, a shorter exposure sees more than the one that the latency was measured with:
                # once that one would be over, nothing is left to be seen (decision 0007).
                self._control.pause(known_ms / 1000.0)

    def _ask_projector(self, doing: str, work: Callable[[], T]) -> T:
        return self._threads.call(self._rig.projector.name, doing, work, control=self._control)

    def _each(
        self, cameras: Sequence[str], doing: str, work: Callable[[Camera], T], wait_s: float = 0.0
    ) -> dict[str, T]:
        """Do the same with several cameras at once; raise the first error when all have returned."""
        return self._threads.each(
            cameras,
            doing,
            lambda name: work(self._rig.cameras[name]),
            control=self._control,
            wait_s=wait_s,
        )

    def _abort(self) -> None:
        """Unblock the cameras. Whoever cancels doesn't wait for one that hangs here, too."""
        for camera in self._rig.cameras.values():
            aside(camera.abort)

    def _release(self) -> None:
        try:
            self._each([*self._rig.cameras], "disarming", disarm)
            if self._rig.projector.state is not LinkState.LOST:
                self._ask_projector("going dark", self._darken)
        except DeviceError:
            # The error that ended the shot says more; the pool opens the rig anew after it.
            return
        finally:
            if self._own_threads:
                self._threads.leave(DeviceStalled(self._rig.name, "the capture is over"), _nothing)

    def _darken(self) -> None:
        self._rig.projector.blank()


def is_off_grid(exposure_ms: float, period_ms: float) -> bool:
    """Tell whether what an exposure sees of a period that it doesn't see whole is more than a hundredth of it."""
    periods = exposure_ms / period_ms
    return abs(periods - round(periods)) > _ON_GRID * periods


def settings_of(exposure_ms: float, gain_db: float) -> CameraSettings:
    """Return a shot's settings in the devices' units."""
    # To the nanosecond: 240 periods of 1000/120 ms are 2000000.0000000002 us, beyond a limit of 2 s.
    return CameraSettings(exposure_us=round(exposure_ms * 1000.0, 3), gain_db=gain_db)


def _trigger(camera: Camera) -> TriggerSource:
    """Return how a camera is told when to expose: by software where it can be."""
    free_only = camera.capabilities.only_runs_freely
    return TriggerSource.FREE_RUN if free_only else TriggerSource.SOFTWARE


def _runs_freely(camera: Camera) -> bool:
    return _trigger(camera) is TriggerSource.FREE_RUN


def _thrown_away(camera: Camera) -> int:
    """Return how many frames of a camera may have been exposed before the pattern was lit."""
    return camera.capabilities.buffered_frames + 1 if _runs_freely(camera) else 0


def _expose(camera: Camera) -> Frame:
    if not _runs_freely(camera):
        camera.trigger()
    for _ in range(_thrown_away(camera)):
        camera.get_frame(FRAME_TIMEOUT_S)
    frame = camera.get_frame(FRAME_TIMEOUT_S)
    refuse_other_frame(camera.name, frame)
    return frame


def disarm(camera: Camera) -> None:
    """Stop a camera's acquisition if it runs."""
    if camera.state is LinkState.ARMED:
        camera.disarm()


def _nothing() -> None:
    """Leave the device as it is."""
