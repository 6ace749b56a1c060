"""The simulated camera: triggers, exposures and frames, with everything that can go wrong on request."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8, UInt16

from backend.devices.errors import (
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
)
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
    LinkState,
    Range,
    TriggerSource,
)
from backend.devices.refusals import (
    cure_of_silence,
    refuse_impossible,
    refuse_locked,
    refuse_trigger,
)
from backend.devices.sim.clock import Clock
from backend.devices.sim.link import SimulatedLink
from backend.devices.sim.renderer import Light

_READOUT_S = 0.004
_FORMATS = {"Mono8": 8, "Mono12": 12}


@runtime_checkable
class CameraOptions(Protocol):
    """What a rig's options say of its cameras; `SimulatedRigConfig` explains them."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in [px]."""
        ...

    @property
    def bit_depth(self) -> int:
        """Bits per pixel at the start."""
        ...

    @property
    def exposure_min_ms(self) -> float:
        """Shortest exposure."""
        ...

    @property
    def exposure_max_ms(self) -> float:
        """Longest exposure."""
        ...

    @property
    def gain_max_db(self) -> float:
        """Largest gain."""
        ...

    @property
    def fault_device(self) -> str:
        """Name of the camera that the faults befall."""
        ...

    @property
    def fail_after_frames(self) -> int | None:
        """It is disconnected after so many frames."""
        ...

    @property
    def fail_for_good(self) -> bool:
        """It can't be reconnected then."""
        ...

    @property
    def drop_every(self) -> int | None:
        """Every so many frames arrive incomplete."""
        ...

    @property
    def hang_at_frame(self) -> int | None:
        """The frame that is never delivered."""
        ...


@dataclass(frozen=True)
class Exposure:
    """One frame to be: what was lit, from when, with which settings."""

    shown: Light
    settings: CameraSettings
    start_s: float
    frame_id: int
    phase: float
    """Where in its frame period the projector was at the start, in [0, 1)."""

    @property
    def bits(self) -> int:
        """Bits per pixel."""
        return _FORMATS[self.settings.pixel_format or "Mono8"]

    @property
    def end_s(self) -> float:
        """When the exposure ends."""
        return self.start_s + self.settings.exposure_us * 1e-6


Develop = Callable[[Exposure], UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]]
"""Makes the picture of an exposure."""


class SimulatedCamera(SimulatedLink):
    """A `Camera`. Exposures queue up when triggered and are rendered when their frame is fetched."""

    def __init__(
        self,
        name: str,
        config: CameraOptions,
        clock: Clock,
        *,
        look: Callable[[], Light],
        develop: Develop,
        trigger_phase: Callable[[int], float],
    ) -> None:
        info = DeviceInfo(
            "unglare", "simulated camera", serial=f"SIM-{name[0].upper()}", simulated=True
        )
        super().__init__(name, info)
        self._config = config
        self._clock = clock
        self._look = look
        self._develop = develop
        self._trigger_phase = trigger_phase
        self._settings = CameraSettings(
            exposure_us=self._exposure_range().nearest(max(10_000.0, 1e3 * config.exposure_min_ms)),
            pixel_format=f"Mono{config.bit_depth}",
        )
        self._queue: deque[Exposure] = deque()
        self._changed = threading.Condition()
        self._aborted = threading.Event()
        self._next_id = 0
        self._busy_until_s = 0.0
        self._faults = _Faults(config, name)

    def _exposure_range(self) -> Range:
        return Range(
            1e3 * self._config.exposure_min_ms, 1e3 * self._config.exposure_max_ms, 1.0, "us"
        )

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can be set to."""
        return CameraCapabilities(
            sensor_size=self._config.size,
            pixel_formats=tuple(_FORMATS),
            exposure_us=self._exposure_range(),
            gain_db=Range(0.0, self._config.gain_max_db, 0.0, "dB"),
            trigger_sources=(TriggerSource.SOFTWARE, TriggerSource.LINE1),
            hardware_timestamp=True,
            min_frame_period_s=_READOUT_S,
        )

    @property
    def settings(self) -> CameraSettings:
        """The settings in force."""
        return self._settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Check and apply settings."""
        self._need_link()
        wanted = replace(
            settings, pixel_format=settings.pixel_format or self._settings.pixel_format
        )
        can = self.capabilities
        refuse_impossible(self.name, wanted, can)
        if self._state is LinkState.ARMED:
            refuse_locked(self.name, self._settings, wanted)
        self._settings = replace(
            wanted,
            exposure_us=can.exposure_us.nearest(wanted.exposure_us),
            gain_db=can.gain_db.nearest(wanted.gain_db),
        )
        return self._settings

    def arm(self, n_frames: int | None = None) -> None:
        """Start acquisition."""
        del n_frames  # memory is the only limit
        self._need_link()
        with self._changed:
            self._queue.clear()
            self._aborted.clear()
            self._busy_until_s = 0.0
            self._state = LinkState.ARMED

    def disarm(self) -> None:
        """Stop acquisition."""
        if self._state is LinkState.ARMED:
            self._state = LinkState.READY

    def abort(self) -> None:
        """Stop waiting; thread-safe."""
        with self._changed:
            self._aborted.set()
            self._queue.clear()
            self.disarm()
            self._changed.notify_all()

    def close(self) -> None:
        """Give the camera back; whoever waits for a frame stops waiting."""
        self.abort()
        super().close()

    def trigger(self) -> None:
        """Expose what the projector shows now."""
        self._need_link()
        refuse_trigger(self.name, self._settings, armed=self._state is LinkState.ARMED)
        self._clock.wait_until(self._busy_until_s, self._aborted)
        self._expose(self._look(), self._clock.now_s(), self._trigger_phase(self._next_id))

    def line_edge(self, shown: Light, time_s: float, shown_us: float) -> None:
        """Expose on an edge of the trigger line; an edge during an exposure is lost, as on real cameras.

        Raises
        ------
        FeatureError
            If the exposure outlasts the pattern: the frame would mix it with the next one.
        """
        waiting = self._state is LinkState.ARMED and self._settings.trigger is TriggerSource.LINE1
        if not waiting or time_s < self._busy_until_s:
            return
        if self._settings.exposure_us > shown_us + 1:
            raise FeatureError(
                self.name,
                f"ExposureTime {self._settings.exposure_us:g} us outlasts the pattern's"
                f" {shown_us:g} us; expose for less or show for longer",
            )
        self._expose(shown, time_s, 0.0)

    def _expose(self, shown: Light, start_s: float, phase: float) -> None:
        exposure = Exposure(shown, self._settings, start_s, self._next_id, phase)
        with self._changed:
            self._next_id += 1
            self._busy_until_s = exposure.end_s + _READOUT_S
            self._queue.append(exposure)
            self._changed.notify_all()

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        """Fetch the oldest frame."""
        self._need_link()
        exposure = self._next_exposure(timeout_s)
        self._clock.wait_until(exposure.end_s, self._aborted)
        if self._aborted.is_set():
            raise DeviceTimeout(self.name, "waiting for a frame was aborted; arm again")
        reason = self._faults.disconnects(exposure.frame_id)
        if reason:
            raise self._lose_cable(reason, for_good=self._config.fail_for_good)
        if self._faults.hangs(exposure.frame_id):
            self._clock.wait_until(self._clock.now_s() + timeout_s, self._aborted)
            raise DeviceTimeout(
                self.name,
                f"frame {exposure.frame_id} wasn't delivered within {timeout_s:g} s; take it again",
            )
        if self._faults.drops(exposure.frame_id):
            raise IncompleteFrame(
                self.name, f"frame {exposure.frame_id} arrived with packets missing; take it again"
            )
        return Frame(
            data=self._develop(exposure),
            pixel_format=exposure.settings.pixel_format or "Mono8",
            bits=exposure.bits,
            frame_id=exposure.frame_id,
            exposure_us=exposure.settings.exposure_us,
            gain_db=exposure.settings.gain_db,
            timestamp_s=exposure.start_s,
            host_time_s=time.monotonic(),
        )

    def _next_exposure(self, timeout_s: float) -> Exposure:
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._aborted.is_set(), timeout_s)
            if self._aborted.is_set():
                raise DeviceTimeout(self.name, "waiting for a frame was aborted; arm again")
            if not self._queue:
                cure = cure_of_silence(self._settings.trigger, triggered=False)
                raise DeviceTimeout(self.name, f"no frame came within {timeout_s:g} s; {cure}")
            return self._queue.popleft()


class _Faults:
    """What the configuration wants to go wrong with one camera."""

    def __init__(self, config: CameraOptions, name: str) -> None:
        mine = config.fault_device == name
        self._fail_after = config.fail_after_frames if mine else None
        self._drop_every = config.drop_every if mine else None
        self._hang_at = config.hang_at_frame if mine else None

    def disconnects(self, frame_id: int) -> str:
        """Return why the camera is lost at this frame, once; empty: it isn't."""
        if self._fail_after is None or frame_id < self._fail_after:
            return ""
        frames, self._fail_after = self._fail_after, None
        return f"control was lost after {frames} frames"

    def drops(self, frame_id: int) -> bool:
        return self._drop_every is not None and (frame_id + 1) % self._drop_every == 0

    def hangs(self, frame_id: int) -> bool:
        return frame_id == self._hang_at
