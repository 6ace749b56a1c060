"""Measure how long after its acknowledgement a projector really shows a pattern, by the cameras of its rig."""

import json
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from pydantic import TypeAdapter

from backend.devices.errors import DeviceError
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    Frame,
    Presented,
    ProjectorCapabilities,
    TriggerSource,
)
from backend.devices.rig_shelf import ASSUMED_REFRESH_HZ, LATENCY_SUFFIX
from backend.devices.whole_files import write_whole
from backend.domain.errors import StageFailedError
from backend.domain.shots import Progress
from backend.jobs.rigs import Owner
from backend.jobs.shooting import ATTEMPTS
from backend.numerics.settling import COMPLETE, Settling, changing_pixels, share_of_change
from backend.services.context import Context

Gray = Float[np.ndarray, "h w"]
REPETITIONS = 10
_LONGEST_MS = 400.0
_AGREEING = 3
"""So many delays in a row have to be complete before a longer one isn't tried."""
_FULL_SCALE_GRAY = 255.0
_STEADY_S = 0.6
"""After that any display shows what it was asked to."""
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


class _RealTime:
    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)


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
class Latency:
    """What was measured; kept beside the rig's file."""

    settle_ms: float
    """From the acknowledgement on: the slowest change, and one frame period more."""
    refresh_hz: float
    size: tuple[int, int]
    exposure_ms: float
    delays_ms: tuple[float, ...]
    up: tuple[float, ...]
    """Smallest share of the change from black to white that any camera saw at any repetition, for each delay."""
    down: tuple[float, ...]
    """The same from white to black."""
    measured: str
    """When, in UTC."""
    screen: str = ""
    """Which screen; empty where the projector doesn't know."""

    def keep(self, folder: Path, rig: str) -> Path:
        """Write it where the rig's file is."""
        text = json.dumps(asdict(self), indent=1) + "\n"
        return write_whole(folder / f"{rig}{LATENCY_SUFFIX}", text)

    @classmethod
    def kept(cls, folder: Path, rig: str) -> "Latency | None":
        """Read what was kept for a rig; None if nothing was, or it can't be read."""
        try:
            text = (folder / f"{rig}{LATENCY_SUFFIX}").read_text("utf-8")
            return TypeAdapter(cls).validate_json(text)
        except (OSError, ValueError):
            return None


def measure_latency(
    context: Context,
    name: str,
    options: Mapping[str, Any],
    progress: Progress,
    *,
    repetitions: int = REPETITIONS,
    who: str = "rigs latency",
    clock: Clock | None = None,
) -> Latency:
    """Measure the latency of a rig's projector, from black to white and back.

    `who` owns the rig meanwhile. It can be cancelled by whatever `progress` or the clock's `sleep` raises.

    Raises
    ------
    RigBusyError
        If a capture owns the rig.
    StageFailedError
        If the cameras don't see the projector's light, or it doesn't settle at all.
    """
    with context.rigs.lease(name, options, Owner("", "latency calibration", who)) as lease:
        return lease.call(
            lambda rig: latency_of(
                rig.projector,
                tuple(rig.cameras.values()),
                progress,
                repetitions=repetitions,
                clock=clock,
                ask=lease.threads.call,
            )
        )


def latency_of(
    projector: Flashing,
    cameras: Sequence[Taking],
    progress: Progress,
    *,
    repetitions: int,
    clock: Clock | None = None,
    ask: Callable[[str, str, Callable[[], Any]], Any] = lambda device, doing, call: call(),
) -> Latency:
    """Measure the latency of an opened projector by opened cameras that see its light.

    `ask` calls their drivers: on threads of their own where a call may never return.
    """
    return _Bench(projector, cameras, clock or _RealTime(), ask).measure(repetitions, progress)


class _Bench:
    """Projector and cameras while the latency is measured."""

    def __init__(
        self,
        projector: Flashing,
        cameras: Sequence[Taking],
        clock: Clock,
        ask: Callable[[str, str, Callable[[], Any]], Any],
    ) -> None:
        self._projector = projector
        self._clock = clock
        self._ask = ask
        self._cameras = tuple(cameras)
        # As the projector tells it: the rig's file is compared with what is kept, to the last bit.
        self._refresh_hz = projector.capabilities.refresh_hz or ASSUMED_REFRESH_HZ
        self._period_ms = 1000.0 / self._refresh_hz
        self._exposure_ms = self._shortest_exposure()

    def measure(self, repetitions: int, progress: Progress) -> Latency:
        """Take the pictures and judge them."""
        projector = self._projector
        known = getattr(projector, "settle_ms", None)
        if hasattr(projector, "settle_ms"):
            projector.settle_ms = 0.0
        try:
            self._arm()
            steady = {level: self._changed(level, 0.0, level, _STEADY_S) for level in (0, 255)}
            self._refuse_darkness(steady)
            changes = {
                target: self._settling(target, steady, repetitions, progress) for target in (255, 0)
            }
        finally:
            if hasattr(projector, "settle_ms"):
                projector.settle_ms = known
            self._disarm()
            self._blank(0)
        return self._latency(changes[255], changes[0])

    def _shortest_exposure(self) -> float:
        """Return the fewest whole periods that the cameras allow."""
        low_ms = max(c.capabilities.exposure_us.min for c in self._cameras) / 1000.0
        return self._period_ms * max(1, int(np.ceil(low_ms / self._period_ms - 1e-9)))

    def _arm(self) -> None:
        for camera in self._cameras:
            wanted = replace(
                camera.settings,
                exposure_us=round(self._exposure_ms * 1000.0, 3),
                trigger=TriggerSource.SOFTWARE,
            )
            self._ask(camera.name, "setting its exposure", partial(camera.configure, wanted))
            self._ask(camera.name, "arming", camera.arm)

    def _disarm(self) -> None:
        for camera in self._cameras:
            self._ask(camera.name, "disarming", camera.disarm)

    def _changed(self, start: int, steady_s: float, target: int, delay_s: float) -> list[Gray]:
        """Change from one level to another and take the pictures; again where one is lost on its way."""
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._blank(start)
                self._clock.sleep(steady_s)
                return self._pictures(target, delay_s)
            except DeviceError as error:
                if not error.retryable or attempt == ATTEMPTS:
                    raise
                self._disarm()
                self._arm()  # throws away what the other cameras took
        raise AssertionError("the last attempt returns or raises")

    def _blank(self, level: int) -> None:
        self._ask(self._projector.name, "showing a pattern", lambda: self._projector.blank(level))

    def _pictures(self, level: int, delay_s: float) -> list[Gray]:
        """Show a level, wait from its acknowledgement on, and take one picture with each camera."""
        self._blank(level)
        acknowledged_s = self._clock.now_s()
        self._clock.sleep(max(0.0, delay_s - (self._clock.now_s() - acknowledged_s)))
        for camera in self._cameras:
            self._ask(camera.name, "being triggered", camera.trigger)
        return [
            _gray(self._ask(camera.name, "taking a picture", camera.get_frame))
            for camera in self._cameras
        ]

    def _refuse_darkness(self, steady: Mapping[int, list[Gray]]) -> None:
        for camera, dark, bright in zip(self._cameras, steady[0], steady[255], strict=True):
            if np.count_nonzero(_lit(dark, bright)) < 100:
                raise StageFailedError(
                    f"Camera {camera.name} doesn't see the projector's light at {self._exposure_ms:.1f} ms: put a bright"
                    " surface before it, open the aperture, or check what the projector shows."
                )

    def _settling(
        self,
        target: int,
        steady: Mapping[int, list[Gray]],
        repetitions: int,
        progress: Progress,
    ) -> Settling:
        """Try longer and longer delays once each until the change is over, then those again many times.

        A delay that was too short once is too short: only those that looked long enough are worth repeating.
        """
        step_ms = self._period_ms / 2
        found: dict[int, list[list[float]]] = defaultdict(list)
        what = "black to white" if target else "white to black"

        def complete(step: int, *, times: int, steady_s: float, done: float) -> bool:
            delay_ms = step * step_ms
            _refuse_endless(delay_ms, what)
            share = min(done, 0.98) / 2 + (0.0 if target else 0.5)
            progress(share, f"{what}, {delay_ms:.0f} ms after the acknowledgement")
            for _ in range(times):
                found[step].append(self._shares(target, steady, delay_ms, steady_s))
            return min(map(min, found[step])) >= COMPLETE

        def once(step: int) -> bool:
            return complete(step, times=1, steady_s=_STEADY_S, done=step * step_ms / 1000.0)

        first = _first_agreeing(once, 0)
        steady_s = min(_STEADY_S, _LEAST_STEADY_S + _STEADY_CHANGES * first * step_ms / 1000.0)

        def often(step: int) -> bool:
            done = 0.4 + 0.6 * (step - first) / _AGREEING
            return complete(step, times=repetitions, steady_s=steady_s, done=done)

        _first_agreeing(often, first)
        return _settling_of(found, step_ms)

    def _shares(
        self, target: int, steady: Mapping[int, list[Gray]], delay_ms: float, steady_s: float
    ) -> list[float]:
        start = 255 - target
        pictures = self._changed(start, steady_s, target, delay_ms / 1000.0)
        return [
            share_of_change(gray, before, after, _lit(dark, bright))
            for gray, before, after, dark, bright in zip(
                pictures, steady[start], steady[target], steady[0], steady[255], strict=True
            )
        ]

    def _latency(self, up: Settling, down: Settling) -> Latency:
        longest = max(up.delays_ms, down.delays_ms, key=len)
        return Latency(
            settle_ms=max(up.over_ms, down.over_ms) + self._period_ms,
            refresh_hz=self._refresh_hz,
            size=self._projector.capabilities.size,
            exposure_ms=self._exposure_ms,
            delays_ms=tuple(longest.tolist()),
            up=_smallest(up, longest.size),
            down=_smallest(down, longest.size),
            measured=datetime.now(UTC).isoformat(timespec="seconds"),
            screen=str(getattr(self._projector, "screen", "")),
        )


def _gray(frame: Frame) -> Gray:
    """Return a picture on the scale of 8 bits, whatever the camera's depth."""
    return np.asarray(frame.data * (_FULL_SCALE_GRAY / (2**frame.bits - 1)), np.float64)


def _lit(dark: Gray, bright: Gray) -> Bool[np.ndarray, "h w"]:
    return changing_pixels(dark, bright, full_scale_gray=_FULL_SCALE_GRAY)


def _first_agreeing(complete: Callable[[int], bool], start: int) -> int:
    """Try step after step until several in a row are complete, and return the first of these."""
    step, agreeing = start, 0
    while agreeing < _AGREEING:
        agreeing = agreeing + 1 if complete(step) else 0
        step += 1
    return step - _AGREEING


def _refuse_endless(delay_ms: float, what: str) -> None:
    if delay_ms > _LONGEST_MS:
        raise StageFailedError(
            f"The projector doesn't settle within {_LONGEST_MS:g} ms from {what}: check that the cameras see its"
            " screen and that nothing else changes the light."
        )


def _settling_of(found: Mapping[int, list[list[float]]], step_ms: float) -> Settling:
    """Write what was found, steps that were tried less often filled up with what they gave."""
    most = max(map(len, found.values()))
    cameras = len(found[0][0])
    shares = [np.resize(np.array(found[step]), (most, cameras)) for step in range(len(found))]
    return Settling(np.arange(len(found)) * step_ms, np.stack(shares, axis=-1))


def _smallest(settling: Settling, count: int) -> tuple[float, ...]:
    """Return the smallest share at each delay; after the last one tried, the change is over."""
    worst = settling.shares.min(axis=(0, 1))
    return tuple(np.append(worst, np.ones(count - worst.size)).round(4).tolist())
