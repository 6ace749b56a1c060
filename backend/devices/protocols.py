"""What every camera, projector and rig can do: the edge between the application and hardware.

Synchronous, because vendor libraries block, and confined to one thread per device except where a
method says otherwise. Names and units are GenICam SFNC's at this edge: exposure in us, gain in dB.
A driver implements these protocols by having the methods; nothing has to be inherited.
Every refusal is one of the classes in `backend.devices.errors`.

A camera's life::

    CLOSED --open()--> READY --arm()--> ARMED --disarm() / abort()--> READY --close()--> CLOSED
       ^                                  |
       '-------- reconnect() <---------- LOST   (any call may find the device gone)
"""

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8, UInt16

from backend.domain.rig import RigCalibration, RigFacts
from backend.numerics.mirror_scoring import MirrorTruth
from backend.numerics.scoring import Truth


class TriggerSource(enum.StrEnum):
    """What starts an exposure (SFNC TriggerSource)."""

    SOFTWARE = "Software"
    LINE0 = "Line0"
    LINE1 = "Line1"
    LINE2 = "Line2"
    LINE3 = "Line3"
    LINE4 = "Line4"
    FREE_RUN = "Off"


class LinkState(enum.StrEnum):
    """Where a device is in its life; the module's docstring draws it."""

    CLOSED = "closed"
    READY = "ready"
    ARMED = "armed"
    LOST = "lost"


@dataclass(frozen=True)
class Range:
    """What a number may be: `min`..`max`, in steps of `inc` from `min` (0: any value)."""

    min: float
    max: float
    inc: float = 0.0
    unit: str = ""

    def __contains__(self, value: float) -> bool:
        """Tell whether a value lies between the limits; NaN doesn't."""
        return self.min <= value <= self.max

    def __str__(self) -> str:
        """Write the range as an operator reads it."""
        return f"{self.min:.10g} to {self.max:.10g} {self.unit}".rstrip()

    def nearest(self, value: float) -> float:
        """Return the allowed value next to one that lies between the limits."""
        if self.inc <= 0:
            return value
        return min(self.min + round((value - self.min) / self.inc) * self.inc, self.max)


@dataclass(frozen=True)
class DeviceInfo:
    """Who a device is; recorded with every scan."""

    vendor: str
    model: str
    serial: str = ""
    driver: str = ""
    """Which of our drivers talks to it, with version."""
    firmware: str = ""
    address: str = ""
    simulated: bool = False


@dataclass(frozen=True)
class CameraCapabilities:
    """What a camera can be set to; known after `open`."""

    sensor_size: tuple[int, int]
    """Width and height in [px]."""
    pixel_formats: tuple[str, ...]
    """SFNC PixelFormat names, e.g. Mono8, Mono12 (delivered as uint16, 0..4095)."""
    exposure_us: Range
    gain_db: Range
    trigger_sources: tuple[TriggerSource, ...]
    roi: bool = False
    hardware_timestamp: bool = False
    min_frame_period_s: float = 0.0
    """Shortest time between two frames at the shortest exposure (readout)."""
    buffered_frames: int = 0
    """In free run: how many frames may wait that were exposed already. After a pattern is lit so many are thrown
    away, and the one that is being exposed then."""

    @property
    def only_runs_freely(self) -> bool:
        """Whether frames come by themselves and can't be asked for: neither a webcam nor a file takes triggers."""
        there = self.trigger_sources
        return TriggerSource.SOFTWARE not in there and TriggerSource.FREE_RUN in there


@dataclass(frozen=True)
class CameraSettings:
    """How the next frames are taken."""

    exposure_us: float
    gain_db: float = 0.0
    pixel_format: str | None = None
    """None keeps what the camera has; settings that are read back never hold None."""
    roi: tuple[int, int, int, int] | None = None
    """Left, top, width, height in [px]; None is the whole sensor."""
    trigger: TriggerSource = TriggerSource.SOFTWARE


@dataclass(frozen=True)
class Frame:
    """One picture as a camera delivered it, with the settings it was really taken with."""

    data: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]
    pixel_format: str
    bits: int
    """Significant bits: the largest gray level is 2**bits - 1."""
    frame_id: int
    """Counts up by one for every frame that the camera exposed; a gap is a lost frame."""
    exposure_us: float
    gain_db: float
    timestamp_s: float | None
    """The camera's clock at the start of exposure; None where it has none."""
    host_time_s: float
    """time.monotonic() when the frame was complete."""
    metadata: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class ProjectorCapabilities:
    """What a projector (or screen) can do; known after `open`."""

    size: tuple[int, int]
    """Width and height in [px]; patterns have exactly this size."""
    bit_depths: tuple[int, ...] = (8,)
    refresh_hz: float | None = None
    """Frame rate of its light modulation; exposures are multiples of its period. None: steady or unknown."""
    sequence: bool = False
    """Whether it is a `SequenceProjector`."""
    max_sequence: int = 0
    """How many patterns one hardware-timed sequence may hold; 0 where `sequence` is False."""
    linear: bool = False
    """Whether light is proportional to the code (no gamma)."""
    pixel_layout: str = "square"
    """`square`, or `diamond` for DLP chips with rotated mirrors."""
    trigger_out: bool = False
    min_exposure_us: float = 0.0
    """How long a pattern of a hardware-timed sequence has to be shown at least."""
    certain: bool = False
    """Whether a pattern is lit by construction when `show` returns. False: electronics that nobody has looked into
    stand between, and every scan verifies by its frames that the light followed."""


@dataclass(frozen=True)
class Presented:
    """What a projector says of a pattern that it was asked to show."""

    index: int
    """Index into the loaded patterns; -1 after `blank`."""
    host_time_s: float
    """time.monotonic() when the answer came."""
    device_time_s: float | None
    confirmed: bool
    """False: submitted, not known to be lit. Wait at least a frame period before exposing."""


@runtime_checkable
class Device(Protocol):
    """What cameras and projectors have in common. One thread at a time, except where noted."""

    @property
    def name(self) -> str:
        """The device's name in its rig; stands at the head of every error. Known before `open`."""
        ...

    @property
    def info(self) -> DeviceInfo:
        """Who the device is; complete after `open`."""
        ...

    @property
    def state(self) -> LinkState:
        """Where the device is in its life. May be asked from any thread, never blocks."""
        ...

    def open(self) -> None:
        """Take control of the device. Afterwards it is READY and its capabilities are known.

        A second `open` changes nothing. Refuse with `DeviceNotFound` or `DeviceBusy`.
        """
        ...

    def close(self) -> None:
        """Give the device back. Called in any state, any number of times; never raises."""
        ...

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Close, open with retries and apply the last settings again; patterns are loaded again too.

        Called after `DeviceDisconnected`; afterwards the device is READY. A camera whose former
        owner died keeps its control until the heartbeat ends: retry for at least that long, then
        raise `DeviceDisconnected`.
        """
        ...

    def __enter__(self) -> "Device":
        """Open."""
        ...

    def __exit__(self, *exc: object) -> None:
        """Close."""
        ...


@runtime_checkable
class Camera(Device, Protocol):
    """A camera. `configure` and `arm`, then `trigger` and `get_frame` once per picture."""

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can be set to; after `open`."""
        ...

    @property
    def settings(self) -> CameraSettings:
        """The settings as read back from the device, not as asked for."""
        ...

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Check, apply and return what the device took (rounded to its increments).

        Everything is checked before anything is applied: after a `FeatureError` the old settings
        hold. Exposure and gain may change while armed; pixel format, region and trigger are locked
        then. Frames triggered afterwards use the new settings.
        """
        ...

    def arm(self, n_frames: int | None = None) -> None:
        """Provide buffers and start acquisition; afterwards the camera is ARMED and waits for triggers.

        `n_frames` is how many frames will come before `disarm` (None: unknown): a hardware-timed
        burst needs buffers for all of them. Frames left from before are thrown away.
        """
        ...

    def trigger(self) -> None:
        """Wait until the camera is ready for it, then start one exposure. Returns before it has ended.

        Refuse with `FeatureError` when not armed or when the trigger source isn't SOFTWARE,
        with `DeviceTimeout` when the camera doesn't become ready.
        """
        ...

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        """Wait for the oldest frame not yet fetched. The array is the caller's to keep.

        In free run (`TriggerSource.FREE_RUN`) frames come by themselves after `arm`, and `trigger` refuses.
        `timeout_s` counts from the end of the exposure. Raise `DeviceTimeout` when none comes or `abort`
        was called, `IncompleteFrame` when parts are missing, `DeviceDisconnected` when the device is gone.
        """
        ...

    def disarm(self) -> None:
        """Stop acquisition; afterwards READY. Does nothing when not armed."""
        ...

    def abort(self) -> None:
        """Stop waiting, from any thread: a blocked `get_frame` raises `DeviceTimeout` within 0.2 s.

        Afterwards the camera is READY; `arm` starts afresh.
        """
        ...


@runtime_checkable
class Projector(Device, Protocol):
    """A projector, or the screen of a deflectometry rig."""

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do; after `open`."""
        ...

    def load(self, patterns: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        """Take patterns for `show`, replacing those loaded before. Nothing is shown yet.

        Refuse with `GeometryError` unless every pattern has exactly `capabilities.size`.
        """
        ...

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        """Show a loaded pattern and return once it is lit (or submitted, see `Presented.confirmed`).

        Refuse with `FeatureError` when no pattern of that index is loaded, `DeviceTimeout` or
        `DeviceDisconnected` when the display doesn't follow.
        """
        ...

    def blank(self, level: int = 0) -> Presented:
        """Show the whole field at one code, 0..255, without touching the loaded patterns."""
        ...


@runtime_checkable
class SequenceProjector(Projector, Protocol):
    """A projector that runs through patterns by its own clock and fires the cameras' trigger line."""

    def arm_sequence(self, indices: Sequence[int], exposure_us: float, period_us: float) -> None:
        """Prepare a run over loaded patterns. Cameras have to be armed on the trigger line before the start.

        Refuse with `FeatureError` when there are too many patterns, or the exposure doesn't fit the period.
        """
        ...

    def start_sequence(self) -> None:
        """Run the prepared sequence once; returns at its end or earlier. Every pattern fires one trigger edge."""
        ...

    def stop_sequence(self) -> None:
        """Stop a running sequence, from any thread; does nothing when none runs."""
        ...


@runtime_checkable
class Rig(Protocol):
    """Cameras and a projector that look at the same scene; for deflectometry the projector is a screen."""

    @property
    def name(self) -> str:
        """Name under which the rig was opened, e.g. `simulated`."""
        ...

    @property
    def info(self) -> DeviceInfo:
        """Who built the rig, and whether it is simulated."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name; the first is the reference unless `facts` says otherwise."""
        ...

    @property
    def projector(self) -> Projector:
        """The projector or screen."""
        ...

    def open(self) -> None:
        """Open every device. Afterwards all are READY; when one refuses, the others are closed again."""
        ...

    def close(self) -> None:
        """Close every device. Any number of times; never raises."""
        ...

    def facts(self) -> RigFacts:
        """Return sizes, ranges and noise: given to every method. Called after `open`."""
        ...

    def calibration(self) -> RigCalibration | None:
        """Return the calibration that the rig hands over, None where it has none. Called after `open`."""
        ...

    def __enter__(self) -> "Rig":
        """Open."""
        ...

    def __exit__(self, *exc: object) -> None:
        """Close."""
        ...


@runtime_checkable
class Wired(Protocol):
    """A rig whose projector's trigger output is wired to cameras: bursts can be timed by hardware."""

    @property
    def trigger_lines(self) -> Mapping[str, TriggerSource]:
        """The line of each wired camera that the projector's trigger output drives; the others are left out."""
        ...


@runtime_checkable
class Settles(Protocol):
    """A projector whose light comes some time after it says so; the latency calibration found how long."""

    settle_ms: float | None
    """What it waits by itself; None: not measured."""
    settle_exposure_ms: float | None
    """The exposure that this was measured with; shorter ones see more of the change. None: not known."""


@runtime_checkable
class Remarks(Protocol):
    """A device that has something to say to its owner, found out when it was opened."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what is doubtful about it, a sentence each; empty: nothing."""
        ...


@runtime_checkable
class Notes(Protocol):
    """A device that was found set otherwise than a scan needs it, or as its owner may not know."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what was found when it was opened, a sentence each; nothing of it is wrong now."""
        ...


@runtime_checkable
class KnowsTruth(Protocol):
    """A rig that knows what it looks at: the simulated one. For a scan's report only, never for a stage."""

    def truth(self, reference: str, cameras: Sequence[str] | None = None) -> Truth:
        """Return the true surface behind each pixel of the reference camera.

        `cameras` are those that the scan used (None: all): a pixel belongs to the base of
        completeness only if every one of them sees it.
        """
        ...


@runtime_checkable
class KnowsMirrorTruth(KnowsTruth, Protocol):
    """A rig that knows slopes and heights of the mirror that it looks at. For a scan's report only, never for a stage."""

    def mirror_truth(self, reference: str) -> MirrorTruth:
        """Return true slopes and heights behind each pixel of the reference camera, in the mirror's frame."""
        ...


@runtime_checkable
class KnowsItsPace(Protocol):
    """A device that says itself how long its calls may take, beside what they were told to wait."""

    answers_within_s: float
    """A call that takes longer counts as stuck: its scan ends, with the device's name."""
