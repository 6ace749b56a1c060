"""What both ways of measuring a projector's latency share: by cameras that are triggered, or that run freely."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from backend.devices.errors import DeviceError
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    Frame,
    Presented,
    ProjectorCapabilities,
    TriggerSource,
)
from backend.devices.rig_shelf import ASSUMED_REFRESH_HZ
from backend.domain.errors import StageFailedError
from backend.domain.shots import Progress
from backend.jobs.shooting import ATTEMPTS
from backend.numerics.settling import Settling, changing_pixels

T = TypeVar("T")
Gray = Float[np.ndarray, "h w"]
Ask = Callable[[str, str, Callable[[], Any]], Any]
"""Calls a device's driver: its name, what it does, the call."""

LONGEST_MS = 400.0
AGREEING = 3
"""So many delays or frames in a row have to be complete before the change counts as over."""
STEADY_S = 0.6
"""After that any display shows what it was asked to."""
_FULL_SCALE_GRAY = 255.0
_LEAST_STEADY_S = 0.1
_STEADY_CHANGES = 3.0
"""Where it is known how long a change takes, the next one may begin after so many times that."""


@runtime_checkable
class Clock(Protocol):
    """Time, and waiting for it."""

    def now_s(self) -> float:
        """Return the time; only differences mean something."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        ...


@runtime_checkable
class Flashing(Protocol):
    """What is asked of a projector here; every `Projector` can do it."""

    @property
    def name(self) -> str:
        """For sentences."""
        ...

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """For its refresh rate and size."""
        ...

    def blank(self, level: int = 0) -> Presented:
        """Show a level, and return when it is acknowledged."""
        ...


@runtime_checkable
class Taking(Protocol):
    """What is asked of a camera here; every `Camera` can do it."""

    @property
    def name(self) -> str:
        """For sentences."""
        ...

    @property
    def capabilities(self) -> CameraCapabilities:
        """For its shortest exposure."""
        ...

    @property
    def settings(self) -> CameraSettings:
        """Those in force."""
        ...

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the exposure."""
        ...

    def arm(self, n_frames: int | None = None) -> None:
        """Start acquisition."""
        ...

    def trigger(self) -> None:
        """Start an exposure."""
        ...

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        """Fetch its picture."""
        ...

    def disarm(self) -> None:
        """Stop acquisition."""
        ...


@dataclass(frozen=True)
class Measured:
    """What was found, both ways."""

    up: Settling
    down: Settling
    resolution_ms: float
    """So much longer than it took a change may be told to take."""


class Bench:
    """Projector and cameras while the latency is measured; how, is a subclass's matter.

    Parameters
    ----------
    projector
        Opened.
    cameras
        Opened, and seeing its light.
    clock
        What is waited with; whatever its `sleep` raises ends the work.
    ask
        Calls a device's driver, on a thread of its own where a call may never return.
    """

    trigger: TriggerSource
    """How the cameras are told when to expose."""

    def __init__(
        self, projector: Flashing, cameras: Sequence[Taking], clock: Clock, ask: Ask
    ) -> None:
        self.projector = projector
        self.cameras = tuple(cameras)
        self.clock = clock
        self.ask = ask
        # As the projector tells it: the rig's file is compared with what is kept, to the last bit.
        self.refresh_hz = projector.capabilities.refresh_hz or ASSUMED_REFRESH_HZ
        self.period_ms = 1000.0 / self.refresh_hz
        self.exposure_ms = self._shortest_exposure()

    def steady(self, level: int) -> list[Gray]:
        """Return what each camera sees of a level that has come to rest."""
        raise NotImplementedError

    def settling(
        self,
        target: int,
        steady: Mapping[int, list[Gray]],
        repetitions: int,
        progress: Progress,
    ) -> Settling:
        """Change to a level again and again, and say how that went."""
        raise NotImplementedError

    def resolution_ms(self) -> float:
        """Return how much longer than it took a change may be told to take."""
        raise NotImplementedError

    def measure(self, repetitions: int, progress: Progress) -> Measured:
        """Take the pictures and judge them.

        Raises
        ------
        StageFailedError
            If a camera doesn't see the light, or the light doesn't settle.
        """
        projector = self.projector
        known = getattr(projector, "settle_ms", None)
        if hasattr(projector, "settle_ms"):
            projector.settle_ms = 0.0
        try:
            self.arm()
            steady = {level: self.steady(level) for level in (0, 255)}
            self._refuse_darkness(steady)
            up, down = (self.settling(to, steady, repetitions, progress) for to in (255, 0))
            return Measured(up, down, self.resolution_ms())
        finally:
            if hasattr(projector, "settle_ms"):
                projector.settle_ms = known
            self.disarm()
            self.blank(0)

    def _shortest_exposure(self) -> float:
        """Return the fewest whole periods that the cameras allow; what they can do at most where that is less."""
        cans = [camera.capabilities.exposure_us for camera in self.cameras]
        low_ms, high_ms = max(c.min for c in cans) / 1000.0, min(c.max for c in cans) / 1000.0
        whole_ms = self.period_ms * max(1, int(np.ceil(low_ms / self.period_ms - 1e-9)))
        return whole_ms if whole_ms <= high_ms else max(low_ms, high_ms)

    def arm(self) -> None:
        """Set the cameras up and start them."""
        for camera in self.cameras:
            wanted = replace(
                camera.settings,
                exposure_us=round(self.exposure_ms * 1000.0, 3),
                trigger=self.trigger,
            )
            self.ask(camera.name, "setting its exposure", partial(camera.configure, wanted))
            self.ask(camera.name, "arming", camera.arm)

    def disarm(self) -> None:
        """Stop the cameras."""
        for camera in self.cameras:
            self.ask(camera.name, "disarming", camera.disarm)

    def blank(self, level: int) -> None:
        """Show a level; acknowledged when this returns."""
        self.ask(self.projector.name, "showing a pattern", lambda: self.projector.blank(level))

    def picture(self, camera: Taking) -> Gray:
        """Fetch the oldest picture, on the scale of 8 bits, whatever the camera's depth."""
        frame: Frame = self.ask(camera.name, "taking a picture", camera.get_frame)
        return np.asarray(frame.data * (_FULL_SCALE_GRAY / (2**frame.bits - 1)), np.float64)

    def persistently(self, work: Callable[[], T]) -> T:
        """Do something again where a picture is lost on its way."""
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return work()
            except DeviceError as error:
                self.clock.sleep(0.0)  # ends the work that is to end: an aborted camera fails, too
                if not error.retryable or attempt == ATTEMPTS:
                    raise
                self.disarm()
                self.arm()  # throws away what the other cameras took
        raise AssertionError("the last attempt returns or raises")

    def _refuse_darkness(self, steady: Mapping[int, list[Gray]]) -> None:
        for camera, dark, bright in zip(self.cameras, steady[0], steady[255], strict=True):
            if np.count_nonzero(lit(dark, bright)) < 100:
                raise StageFailedError(
                    f"Camera {camera.name} doesn't see the projector's light at {self.exposure_ms:.1f} ms: put a bright"
                    " surface before it, open the aperture, or check what the projector shows."
                )


def lit(dark: Gray, bright: Gray) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that tell black from white."""
    return changing_pixels(dark, bright, full_scale_gray=_FULL_SCALE_GRAY)


def words_of(target: int) -> str:
    """Say which way a change goes."""
    return "black to white" if target else "white to black"


def steady_after_s(change_ms: float) -> float:
    """Return how long to wait between changes of which it is known how long they take."""
    return min(STEADY_S, _LEAST_STEADY_S + _STEADY_CHANGES * change_ms / 1000.0)


def refuse_endless(delay_ms: float, target: int) -> None:
    """Refuse to wait for a change any longer.

    Raises
    ------
    StageFailedError
        If it has taken too long already.
    """
    if delay_ms > LONGEST_MS:
        raise StageFailedError(
            f"The projector doesn't settle within {LONGEST_MS:g} ms from {words_of(target)}: check that the cameras see"
            " its screen and that nothing else changes the light."
        )
