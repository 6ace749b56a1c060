"""Measure how long after its acknowledgement a projector really shows a pattern, by the cameras of its rig."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from backend.devices.errors import DeviceError
from backend.devices.protocols import Camera, Rig
from backend.devices.rig_shelf import LATENCY_SUFFIX
from backend.devices.whole_files import write_whole
from backend.domain.shots import Progress
from backend.jobs.control import JobControl
from backend.jobs.device_threads import aside
from backend.jobs.rigs import Owner
from backend.numerics.settling import Settling
from backend.services.context import Context
from backend.services.latency_bench import Ask, Bench, Clock, Flashing, Measured, Taking
from backend.services.latency_free_run import FreeRunBench
from backend.services.latency_triggered import TriggeredBench

REPETITIONS = 10


class _RealTime:
    """Waiting for it ends as soon as the work is to end."""

    def __init__(self, control: JobControl) -> None:
        self._control = control

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        self._control.pause(duration_s)


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
    resolution_ms: float | None = None
    """So much shorter the slowest change may have been; None: not known."""
    by_free_run: bool = False
    """Found by cameras that can't be triggered."""

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
    control: JobControl | None = None,
) -> Latency:
    """Measure the latency of a rig's projector, from black to white and back; `who` owns the rig meanwhile.

    Raises
    ------
    CancelledError
        If `control` is stopped, also while the rig opens or waits for a device.
    RigBusyError
        If a capture owns the rig.
    StageFailedError
        If the cameras don't see the projector's light, or it doesn't settle at all.
    """
    control = control or JobControl()
    owner = Owner("", "latency calibration", who)
    with context.rigs.lease(name, options, owner, control) as lease:

        def measure(rig: Rig) -> Latency:
            with control.when_stopped(partial(_abort, tuple(rig.cameras.values()))):
                return latency_of(
                    rig.projector,
                    tuple(rig.cameras.values()),
                    progress,
                    repetitions=repetitions,
                    clock=_RealTime(control),
                    ask=partial(lease.threads.call, control=control),
                )

        try:
            return lease.call(measure)
        except DeviceError:
            control.check()  # an aborted camera says that it timed out: the work is cancelled, not the camera broken
            raise


def latency_of(
    projector: Flashing,
    cameras: Sequence[Taking],
    progress: Progress,
    *,
    repetitions: int,
    clock: Clock | None = None,
    ask: Ask = lambda device, doing, call: call(),
) -> Latency:
    """Measure the latency of an opened projector by opened cameras that see its light.

    By those that can be triggered; where there is none, by frames that come by themselves, more coarsely. `ask`
    calls their drivers: on threads of their own where a call may never return.
    """
    triggered = [camera for camera in cameras if not camera.capabilities.only_runs_freely]
    kind = TriggeredBench if triggered else FreeRunBench
    bench = kind(projector, triggered or cameras, clock or _RealTime(JobControl()), ask)
    return _latency(bench, bench.measure(repetitions, progress), by_free_run=not triggered)


def _abort(cameras: Sequence[Camera]) -> None:
    """Unblock whoever waits for a frame; nobody waits for a driver that hangs in this, too."""
    for camera in cameras:
        aside(camera.abort)


def _latency(bench: Bench, measured: Measured, *, by_free_run: bool) -> Latency:
    up, down = measured.up, measured.down
    longest = max(up.delays_ms, down.delays_ms, key=len)
    return Latency(
        settle_ms=max(up.over_ms, down.over_ms) + bench.period_ms,
        refresh_hz=bench.refresh_hz,
        size=bench.projector.capabilities.size,
        exposure_ms=bench.exposure_ms,
        delays_ms=tuple(longest.tolist()),
        up=_smallest(up, longest.size),
        down=_smallest(down, longest.size),
        measured=datetime.now(UTC).isoformat(timespec="seconds"),
        screen=str(getattr(bench.projector, "screen", "")),
        resolution_ms=measured.resolution_ms,
        by_free_run=by_free_run,
    )


def _smallest(settling: Settling, count: int) -> tuple[float, ...]:
    """Return the smallest share at each delay; after the last one tried, the change is over."""
    worst = settling.shares.min(axis=(0, 1))
    return tuple(np.append(worst, np.ones(count - worst.size)).round(4).tolist())
