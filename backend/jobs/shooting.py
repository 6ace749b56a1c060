"""Take single shots on a rig: show a pattern, trigger the cameras together, fetch their frames.

Milliseconds become the devices' microseconds here. A shot that fails for a passing reason is taken again.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import DeviceError
from backend.devices.protocols import Camera, CameraSettings, Frame, LinkState, Rig
from backend.jobs.control import JobControl

ATTEMPTS = 3
"""How often one shot is tried before the rig counts as failed."""

FRAME_TIMEOUT_S = 5.0
"""How long a frame may take after the end of its exposure."""

T = TypeVar("T")


class Shooter:
    """Software-triggered shots on one rig, from the first to the last of a capturing stage.

    Every camera is used by one thread only, so that cameras expose at the same time and drivers see one
    thread. Leaving the block disarms the cameras and darkens the projector, whatever happened inside.

    A projector that runs its own sequence (`SequenceProjector`) can be given whole bursts; that takes another
    class with `load` and a `burst` beside this one, chosen by `CaptureSession`.
    """

    def __init__(self, rig: Rig, control: JobControl) -> None:
        self._rig = rig
        self._control = control
        self._threads = {
            name: ThreadPoolExecutor(1, thread_name_prefix=f"camera-{name}") for name in rig.cameras
        }
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
            self._rig.projector.load(pictures)

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
                self._each(cameras, _disarm)
        raise AssertionError("the last attempt returns or raises")

    def _once(
        self, index: int, settings: CameraSettings, cameras: Sequence[str]
    ) -> dict[str, Frame]:
        with self._waiting():
            self._each(cameras, lambda camera: self._prepare(camera, settings))
            self._show(index)
            return self._each(cameras, _expose)

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
        presented = self._rig.projector.show(index)
        refresh_hz = self._rig.projector.capabilities.refresh_hz
        if not presented.confirmed and refresh_hz:
            self._control.pause(1.0 / refresh_hz)

    def _each(self, cameras: Sequence[str], work: Callable[[Camera], T]) -> dict[str, T]:
        """Do the same with several cameras at once; raise the first error when all have returned."""
        futures: Mapping[str, Future[T]] = {
            name: self._threads[name].submit(work, self._rig.cameras[name]) for name in cameras
        }
        errors = [error for future in futures.values() if (error := future.exception())]
        if errors:
            raise errors[0]
        return {name: future.result() for name, future in futures.items()}

    def _abort(self) -> None:
        for camera in self._rig.cameras.values():
            camera.abort()

    def _release(self) -> None:
        try:
            for name, thread in self._threads.items():
                thread.submit(_disarm, self._rig.cameras[name]).result()
            if self._rig.projector.state is not LinkState.LOST:
                self._rig.projector.blank()
        except DeviceError:
            # The error that ended the shot says more; the pool opens the rig anew after it.
            return
        finally:
            for thread in self._threads.values():
                thread.shutdown()


def _expose(camera: Camera) -> Frame:
    camera.trigger()
    return camera.get_frame(FRAME_TIMEOUT_S)


def _disarm(camera: Camera) -> None:
    if camera.state is LinkState.ARMED:
        camera.disarm()
