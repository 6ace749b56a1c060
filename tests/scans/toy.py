"""A tiny method and a tiny rig, so that the mechanism can be tested in milliseconds.

Two capturing stages and three pure ones, an optional input that nothing makes, a check that can warn and fail,
a closed loop, and settings that make a stage fail, hang or report.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from backend.devices.errors import DeviceBusy, DeviceDisconnected, DeviceError, DeviceTimeout
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    LinkState,
    Presented,
    ProjectorCapabilities,
    Range,
    TriggerSource,
)
from backend.devices.protocols import Frame as DeviceFrame
from backend.domain.arrays import ArrayHash, LoadArray
from backend.domain.checks import Check, at_most
from backend.domain.errors import RigFailedError, StageFailedError
from backend.domain.frames import Frame
from backend.domain.hints import (
    Curve,
    Frames,
    Histogram,
    Mask,
    Picture,
    Points,
    Scalar,
    Table,
    Value,
)
from backend.domain.method import Method
from backend.domain.params import Params, setting
from backend.domain.patterns import WHITE, Sine
from backend.domain.rig import (
    CameraFacts,
    PinholeModel,
    Pose,
    ProjectorFacts,
    RigCalibration,
    RigFacts,
)
from backend.domain.shots import Burst, Exposed, Plan, Progress, Shoot, Shot, Until
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.methods import Registry
from backend.numerics.errors import NumericsError

WIDTH_PX, HEIGHT_PX = 24, 16
PROJECTOR_PX = (32, 8)

# the method


class LookParams(Params):
    """How the scene is looked at."""

    exposure_ms: float | None = setting(
        None, title="Exposure", unit="ms", auto="exposure_ms", gt=0, le=100
    )
    wanted_gray: float = setting(100.0, title="Wanted gray", unit="gray", ge=1, le=250)


@dataclass(frozen=True)
class Rung:
    """One exposure that was tried."""

    exposure_ms: float
    mean_gray: float


@dataclass(frozen=True)
class Look:
    """The scene under a white field."""

    exposure_ms: Annotated[float, Value("Exposure", unit="ms")]
    white: Annotated[Mapping[str, UInt8[np.ndarray, "h w"]], Picture("White field")]
    ladder: Annotated[tuple[Rung, ...], Table("Exposures tried")]


def bright_enough(result: Look, params: LookParams) -> Check:
    last = result.ladder[-1].mean_gray
    return at_most(
        "brightness",
        last,
        warning=200.0,
        failure=240.0,
        sentence=f"mean gray {last:.0f}",
        unit="gray",
    )


@stage(title="Look", version=1, review=Review.ON_WARNING, checks=(bright_enough,))
def toy_look(facts: RigFacts, params: LookParams, shoot: Shoot) -> Look:
    """Find an exposure that is bright enough."""
    ladder, white = shoot(look_plan(params, facts.reference))
    return Look(ladder[-1].exposure_ms, white, ladder)


def look_plan(
    params: LookParams, reference: str
) -> Plan[tuple[tuple[Rung, ...], dict[str, np.ndarray]]]:
    ladder: list[Rung] = []
    asked_ms = params.exposure_ms or 1.0
    while True:
        (exposed,) = yield (Shot(WHITE, asked_ms, role="white"),)
        frame = exposed[reference]
        ladder.append(Rung(frame.exposure_ms or 0.0, float(frame.gray.mean())))
        done = params.exposure_ms or ladder[-1].mean_gray >= params.wanted_gray or asked_ms >= 100
        if done:
            return tuple(ladder), {name: f.gray for name, f in exposed.items()}
        asked_ms = min(2 * asked_ms, 100.0)


class LevelsParams(Params):
    """How gray levels are grouped."""

    step_gray: int = setting(64, title="Step", unit="gray", ge=1, le=128)
    levels_gray: tuple[float, ...] | None = setting(
        None, title="Levels", unit="gray", auto="levels_gray", min_length=1, max_length=4
    )
    kind: Literal["even", "odd"] = setting("even", title="Kind")
    colour: str = setting("red", title="Colour", cosmetic=True)
    mask: ArrayHash | None = setting(None, title="Mask")
    most: float = setting(6.0, title="Most levels", ge=1, le=100)


@dataclass(frozen=True)
class Levels:
    """The scene's gray levels, coarsely."""

    levels_gray: Float[np.ndarray, "n"]
    histogram: Annotated[
        Float[np.ndarray, "gray"],
        Histogram("Gray levels", valleys="levels_gray", edits="levels_gray"),
    ]
    count: Annotated[int, Value("Levels")]
    labels: Annotated[UInt8[np.ndarray, "h w"], Mask("Levels", {1: "dark"}, edits="mask")]


def few_levels(result: Levels, params: LevelsParams) -> Check:
    return at_most(
        "levels", result.count, warning=params.most, failure=4 * params.most,
        sentence=f"{result.count} levels found",
    )  # fmt: skip


@stage(title="Levels", version=1, review=Review.ON_WARNING, checks=(few_levels,))
def toy_levels(look: Look, params: LevelsParams, load: LoadArray) -> Levels:
    """Group the gray levels of the white field."""
    gray = next(iter(look.white.values()))
    coarse = gray // params.step_gray
    if params.mask:
        coarse = (coarse * load(params.mask)).astype(np.uint8)
    levels = np.unique(coarse) * float(params.step_gray)
    if params.levels_gray:
        levels = np.array(params.levels_gray)
    histogram = np.bincount(coarse.ravel() * params.step_gray, minlength=256).astype(float)
    return Levels(levels, histogram, len(levels), coarse.astype(np.uint8))


@dataclass(frozen=True)
class Hint:
    """Something that only a plug-in or an import could supply."""

    text: str


class FringesParams(Params):
    """How the fringes are captured."""

    exposures_ms: tuple[float, ...] = setting(
        (2.0, 4.0), title="Exposures", min_length=1, max_length=8
    )
    steps: int = setting(4, title="Steps", ge=3, le=16)
    until: bool = setting(False, title="Wait for a bright picture first")


@dataclass(frozen=True)
class Fringes:
    """The captured fringes."""

    frames: Annotated[
        tuple[Frame, ...], Frames("Fringes", x="shifts_rad", slope="slope", offset="offset")
    ]
    note: Annotated[str, Value("Note")]
    shifts_rad: Float[np.ndarray, "n"]
    slope: Mapping[str, Float[np.ndarray, "h w"]]
    offset: Mapping[str, Float[np.ndarray, "h w"]]


@stage(title="Fringes", version=1, review=Review.ON_FAILURE)
def toy_fringes(
    levels: Levels, hint: Hint | None, facts: RigFacts, params: FringesParams, shoot: Shoot
) -> Fringes:
    """Capture shifted fringes at several exposures."""
    if params.until:
        shoot(wait_plan(facts.reference))
    frames = shoot(fringe_plan(params))
    shifts = [2 * np.pi * k / params.steps for k in range(params.steps)] * len(params.exposures_ms)
    size = HEIGHT_PX, WIDTH_PX
    slope = {name: np.full(size, np.nan) for name in facts.cameras}
    return Fringes(
        frames,
        hint.text if hint else "no hint",
        np.array(shifts),
        slope,
        {name: np.full(size, 2.5) for name in facts.cameras},
    )


def fringe_plan(params: FringesParams) -> Plan[tuple[Frame, ...]]:
    shifts = [2 * np.pi * k / params.steps for k in range(params.steps)]
    burst: Burst = tuple(
        Shot(Sine(periods=2, shift_rad=float(shift)), exposure_ms, role="fringe")
        for exposure_ms in params.exposures_ms
        for shift in shifts
    )
    exposed = yield burst
    return tuple(frame for shot in exposed for frame in shot.values())


def wait_plan(reference: str) -> Plan[Exposed]:
    def ready(exposed: Exposed) -> bool:
        return bool(exposed[reference].gray.mean() > WAIT_FOR_GRAY)

    (exposed,) = yield Until(Shot(WHITE, 1.0, role="wait"), ready, timeout_s=2.0)
    return exposed


WAIT_FOR_GRAY = 50.0


class PhaseParams(Params):
    """How the phase is calculated, and how it goes wrong."""

    offset_rad: float = setting(0.0, title="Offset", unit="rad", ge=-4, le=4)
    behave: Literal["well", "numerics", "sentence", "defect", "memory", "report", "hang", "die"] = (
        setting("well", title="Behaviour")
    )


@dataclass(frozen=True)
class ToyPhase:
    """Phase per camera."""

    phase_rad: Annotated[
        Mapping[str, Float[np.ndarray, "h w"]], Picture("Phase", unit="rad", colormap="twilight")
    ]
    mean_rad: Annotated[float, Value("Mean", unit="rad")]
    x_px: Float[np.ndarray, "w"]
    profile_rad: Annotated[Float[np.ndarray, "w"], Curve("Profile", x="x_px")]


@stage(title="Phase", version=1, review=Review.ALWAYS)
def toy_phase(
    fringes: Fringes, levels: Levels | None, params: PhaseParams, progress: Progress
) -> ToyPhase:
    """Calculate the phase of every pixel."""
    misbehave(params.behave, progress)
    progress(0.5, "half")
    cameras = dict.fromkeys(f.camera for f in fringes.frames)
    phase = {name: _phase(fringes, name) + params.offset_rad for name in cameras}
    first = next(iter(phase.values()))
    return ToyPhase(phase, float(np.nanmean(first)), np.arange(first.shape[1]) * 1.0, first[0])


def _phase(fringes: Fringes, camera: str) -> np.ndarray:
    frames = [f for f in fringes.frames if f.camera == camera]
    shifts = [f.pattern.shift_rad for f in frames if isinstance(f.pattern, Sine)]
    gray = np.stack([f.gray.astype(float) for f in frames])
    phase: np.ndarray = np.angle(np.tensordot(np.exp(-1j * np.array(shifts)), gray, axes=1))
    return phase


def misbehave(behave: str, progress: Progress) -> None:
    errors: dict[str, Callable[[], Exception]] = {
        "numerics": lambda: NumericsError("frequency 0 has no phase: give one above 0"),
        "sentence": lambda: StageFailedError("The picture is black: open the iris."),
        "defect": lambda: ZeroDivisionError("division by zero"),
        "memory": lambda: MemoryError(),
    }
    if behave in errors:
        raise errors[behave]()
    if behave == "report":
        while True:
            progress(0.25, "reports for ever")
    if behave == "hang":
        progress(0.125, "hangs")
        threading.Event().wait(60)
    if behave == "die":
        import os

        os._exit(3)


class CloudParams(Params):
    """How points are made."""

    scale_mm: float = setting(1.0, title="Scale", unit="mm", gt=0, le=1000)


@dataclass(frozen=True)
class Cloud:
    """Points."""

    points_mm: Annotated[
        Float[np.ndarray, "n 3"], Points("Cloud", colour="rgb", scalars=("height_mm",))
    ]
    rgb: UInt8[np.ndarray, "n 3"]
    height_mm: Annotated[Float[np.ndarray, "n"], Scalar("Height", unit="mm")]
    pixel_x: Float[np.ndarray, "n"]
    pixel_y: Float[np.ndarray, "n"]


@stage(title="Cloud", version=1, review=Review.ON_FAILURE)
def toy_cloud(phase: ToyPhase, calibration: RigCalibration, params: CloudParams) -> Cloud:
    """Make one point per pixel."""
    z = next(iter(phase.phase_rad.values())).astype(np.float32) * params.scale_mm
    y, x = np.mgrid[: z.shape[0], : z.shape[1]]
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    rgb = np.full((z.size, 3), 128, np.uint8)
    return Cloud(points, rgb, z.ravel(), x.ravel().astype(float), y.ravel().astype(float))


TOY = Method(
    name="toy",
    title="Toy",
    stages=(toy_look, toy_levels, toy_fringes, toy_phase, toy_cloud),
    given=(RigFacts, RigCalibration, Hint),
    presets={"coarse": {"toy_levels.step_gray": 128}},
)


@lru_cache(maxsize=1)
def toy_registry() -> Registry:
    return Registry({"toy": TOY}, {})


# the rig

BEFORE = CameraSettings(1000.0, 0.0, "Mono8")
CAMERA = DeviceInfo("toy", "camera", "1")
ABILITIES = CameraCapabilities(
    (WIDTH_PX, HEIGHT_PX),
    ("Mono8",),
    Range(10.0, 100_000.0, 0.0, "us"),
    Range(0.0, 10.0, 0.0, "dB"),
    (TriggerSource.SOFTWARE,),
)
PROJECTOR = DeviceInfo("toy", "projector", "2")
DISPLAY = ProjectorCapabilities(PROJECTOR_PX, certain=True)


@dataclass
class Faults:
    """What goes wrong with a rig, and when; shared by all rigs that one `ToyRigs` opens."""

    errors: dict[int, list[DeviceError]] = field(default_factory=dict)
    """Number of the exposure (1, 2 ...) -> errors that its `get_frame` raises, one per attempt."""
    before_shot: Callable[[int], None] = lambda shot: None
    """Called by the projector with the number of the shot (1, 2 ...)."""
    before_open: Callable[[], None] = lambda: None
    gone: bool = False
    """True: a lost device doesn't come back."""
    hold: threading.Event | None = None
    """While it isn't set, `get_frame` waits."""


class Closing:
    """What `with` needs, and the rest of a device's life."""

    name: str
    rig: Any
    reconnects = 0

    def open(self) -> None:
        self.state = LinkState.READY

    def close(self) -> None:
        self.state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        self.reconnects += 1
        if self.rig.faults.gone:
            self.state = LinkState.LOST
            raise DeviceDisconnected(self.name, "the link is gone for good")
        self.open()

    def __enter__(self) -> Any:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@dataclass
class ToyCamera(Closing):
    """Sees the projector's picture, stretched, times exposure and albedo."""

    name: str
    rig: "ToyRig"
    state: LinkState = LinkState.CLOSED
    settings: CameraSettings = BEFORE
    info: DeviceInfo = CAMERA
    capabilities: CameraCapabilities = ABILITIES
    frames: int = 0
    exposing: bool = False
    aborted: threading.Event = field(default_factory=threading.Event)
    threads: set[int] = field(default_factory=set)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        # The exposure is rounded to whole 16 us, as hardware does.
        taken_us = round(settings.exposure_us / 16) * 16.0
        self.settings = CameraSettings(taken_us, settings.gain_db, "Mono8")
        self.rig.configured += 1
        return self.settings

    def arm(self, n_frames: int | None = None) -> None:
        self.aborted.clear()
        self.state = LinkState.ARMED

    def disarm(self) -> None:
        self.state = LinkState.READY

    def abort(self) -> None:
        self.aborted.set()
        self.state = LinkState.READY

    def trigger(self) -> None:
        self.threads.add(threading.get_ident())
        if self.state is not LinkState.ARMED:
            raise DeviceBusy(self.name, "isn't armed")
        self.frames += 1

    def get_frame(self, timeout_s: float = 2.0) -> DeviceFrame:
        faults = self.rig.faults
        while faults.hold is not None and not faults.hold.wait(0.01):
            if self.aborted.is_set():
                raise DeviceTimeout(self.name, "was aborted")
        errors = faults.errors.get(self.rig.shots, [])
        if errors and errors[0].device == self.name:
            raise errors.pop(0)
        return DeviceFrame(
            data=self.rig.seen_by(self),
            pixel_format="Mono8",
            bits=8,
            frame_id=self.frames,
            exposure_us=self.settings.exposure_us,
            gain_db=self.settings.gain_db,
            timestamp_s=float("nan"),
            host_time_s=float(self.frames),
            metadata={"temperature": 30.5, "raw": object()},
        )


@dataclass
class ToyProjector(Closing):
    """Remembers what it shows."""

    rig: "ToyRig"
    name: str = "projector"
    state: LinkState = LinkState.CLOSED
    info: DeviceInfo = PROJECTOR
    capabilities: ProjectorCapabilities = DISPLAY
    loaded: tuple[np.ndarray, ...] = ()
    loads: int = 0
    picture: np.ndarray = field(default_factory=lambda: np.zeros(PROJECTOR_PX[::-1], np.uint8))

    def load(self, patterns: Sequence[np.ndarray]) -> None:
        self.loaded = tuple(patterns)
        self.loads += 1

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        self.rig.shots += 1
        self.rig.faults.before_shot(self.rig.shots)
        self.picture = self.loaded[index]
        return Presented(index, 0.0, None, confirmed=True)

    def fail(self, shot: int) -> None:
        """Raise what is to go wrong with the projector at a shot: for `Faults.before_shot`."""
        errors = self.rig.faults.errors.get(shot, [])
        if errors and errors[0].device == self.name:
            raise errors.pop(0)

    def blank(self, level: int = 0) -> Presented:
        self.picture = np.full(PROJECTOR_PX[::-1], level, np.uint8)
        return Presented(-1, 0.0, None, confirmed=True)


class ToyRig(Closing):
    """Two cameras and a projector. `noise`: another picture every time; otherwise always the same."""

    def __init__(self, name: str, options: Mapping[str, Any], faults: Faults) -> None:
        self.name = name
        self.info = DeviceInfo("toy", "rig", simulated=True)
        self.options = dict(options)
        self.faults = faults
        self.cameras = {side: ToyCamera(side, self) for side in ("left", "right")}
        self.projector = ToyProjector(self)
        self.shots = 0
        self.configured = 0
        self.opened = 0
        self.closed = 0
        self._random = np.random.default_rng(options.get("seed", 0))

    def open(self) -> None:
        self.faults.before_open()
        self.opened += 1
        for device in (*self.cameras.values(), self.projector):
            device.open()

    def close(self) -> None:
        self.closed += 1
        for device in (*self.cameras.values(), self.projector):
            device.close()

    def facts(self) -> RigFacts:
        camera = CameraFacts(WIDTH_PX, HEIGHT_PX, 8, 0.01, 100.0, 0.0, 10000.0, 5.0)
        width_px, height_px = PROJECTOR_PX
        return RigFacts(
            dict.fromkeys(self.cameras, camera), "left", ProjectorFacts(width_px, height_px)
        )

    def calibration(self) -> RigCalibration | None:
        if not self.options.get("calibrated", True):
            return None
        model = PinholeModel(WIDTH_PX, HEIGHT_PX, np.eye(3))
        poses = {name: Pose(np.eye(3), np.zeros(3)) for name in self.cameras}
        return RigCalibration(dict.fromkeys(self.cameras, model), poses, "left")

    def seen_by(self, camera: ToyCamera) -> np.ndarray:
        light = (
            np.resize(self.projector.picture[0], WIDTH_PX) * camera.settings.exposure_us / 10_000
        )
        rows = np.linspace(0.2, 1.0, HEIGHT_PX)[:, None]
        noise = (
            self._random.normal(0, 3, (HEIGHT_PX, WIDTH_PX)) if self.options.get("noise") else 0.0
        )
        return np.clip(rows * light[None, :] + noise, 0, 255).astype(np.uint8)


class ToyRigs:
    """Opens toy rigs and remembers them: the `open_rig` of the tests."""

    def __init__(self) -> None:
        self.faults = Faults()
        self.opened: list[ToyRig] = []

    def __call__(self, name: str, options: Mapping[str, Any]) -> ToyRig:
        if options.get("broken"):
            raise RigFailedError(f"Rig {name!r} doesn't answer: switch it on.")
        rig = ToyRig(name, options, self.faults)
        self.opened.append(rig)
        return rig

    @property
    def shots(self) -> int:
        """Shots of all rigs so far."""
        return sum(rig.shots for rig in self.opened)
