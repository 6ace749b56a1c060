"""Take single shots on a rig: show a pattern, trigger the cameras together, fetch their frames.

Milliseconds become the devices' microseconds here. A shot that fails for a passing reason is taken again.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import DeviceError, DeviceStalled
from backend.devices.protocols import Camera, CameraSettings, Frame, LinkState, Rig
from backend.jobs.control import JobControl
from backend.jobs.device_threads import DeviceThreads, aside

ATTEMPTS = 3
"""How often one shot is tried before the rig counts as failed."""

FRAME_TIMEOUT_S = 5.0
"""How long a frame may take after the end of its exposure."""

T = TypeVar("T")


class Shooter:
    """Software-triggered shots on one rig, from the first to the last of a capturing stage.

    Every device is used by one thread only, so that cameras expose at the same time and drivers see one
    thread; a call that doesn't return in time ends the shot (`DeviceStalled`). Leaving the block disarms the cameras and darkens the projector, whatever happened inside.

    A projector that runs its own sequence (`SequenceProjector`) can be given whole bursts; that takes another
    class with `load` and a `burst` beside this one, chosen by `CaptureSession`.
    """

    def __init__(self, rig: Rig, control: JobControl, threads: DeviceThreads | None = None) -> None:
        self._rig = rig
        self._control = control
        self._threads = threads or DeviceThreads((*rig.cameras.values(), rig.projector))
        self._own_threads = threads is None
        self._asked: dict[str, CameraSettings] = {}
        self._stack = ExitStack()
        self.waited_s = 0.0
        """Time spent waiting for the devices, exposures included (a simulated rig's: its computing)."""

    @property
    def projector_size(self) -> tuple[int, int]:
        """Width and height in [px] that patterns must have."""
        return self._rig.projector.capabilities.size

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
        with self._waiting():
            self._ask_projector("loading patterns", lambda: self._rig.projector.load(pictures))

    def take(
        self, index: int, *, exposure_ms: float, gain_db: float, cameras: Sequence[str]
    ) -> dict[str, Frame]:
        """Take one shot of a loaded pattern, again if it fails for a passing reason.

        Raises
        ------
        CancelledError
            If the job is stopped.
        DeviceError
            If the shot failed for good; nothing of it is returned.
        """
        # To the nanosecond: 240 periods of 1000/120 ms are 2000000.0000000002 us, beyond a limit of 2 s.
        settings = CameraSettings(exposure_us=round(exposure_ms * 1000.0, 3), gain_db=gain_db)
        for attempt in range(1, ATTEMPTS + 1):
            self._control.check()
            try:
                return self._once(index, settings, cameras)
            except DeviceError as error:
                # A camera that was aborted says that it timed out: the job is cancelled, not the camera broken.
                self._control.check()
                if not error.retryable or attempt == ATTEMPTS:
                    raise
                self._asked.clear()
                self._each(cameras, "disarming", _disarm)
        raise AssertionError("the last attempt returns or raises")

    def _once(
        self, index: int, settings: CameraSettings, cameras: Sequence[str]
    ) -> dict[str, Frame]:
        with self._waiting():
            self._each(cameras, "arming", lambda camera: self._prepare(camera, settings))
            self._show(index)
            wait_s = settings.exposure_us * 1e-6 + FRAME_TIMEOUT_S
            return self._each(cameras, "taking a picture", _expose, wait_s)

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
        if self._asked.get(camera.name) != settings:
            camera.configure(settings)
            self._asked[camera.name] = settings
        if camera.state is not LinkState.ARMED:
            camera.arm()

    def _show(self, index: int) -> None:
        presented = self._ask_projector(
            "showing a pattern", lambda: self._rig.projector.show(index)
        )
        refresh_hz = self._rig.projector.capabilities.refresh_hz
        if not presented.confirmed and refresh_hz:
            self._control.pause(1.0 / refresh_hz)

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
            self._each([*self._rig.cameras], "disarming", _disarm)
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


def _expose(camera: Camera) -> Frame:
    camera.trigger()
    return camera.get_frame(FRAME_TIMEOUT_S)


def _disarm(camera: Camera) -> None:
    if camera.state is LinkState.ARMED:
        camera.disarm()


def _nothing() -> None:
    """Leave the device as it is."""
