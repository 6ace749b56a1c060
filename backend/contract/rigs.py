"""What a client may know of a rig, and what it may ask of one."""

from datetime import datetime
from enum import StrEnum
from typing import Any

from pydantic import Field

from backend.contract.base import Message


class PoseView(Message):
    """x_to = R x_from + t."""

    R: tuple[tuple[float, ...], ...]
    t_mm: tuple[float, ...]


class PinholeView(Message):
    """A camera or projector as OpenCV models it."""

    width_px: int
    height_px: int
    K: tuple[tuple[float, ...], ...]
    distortion: tuple[float, ...]


class CameraView(Message):
    """One camera of a rig."""

    name: str
    width_px: int
    height_px: int
    bit_depth: int
    exposure_min_ms: float
    exposure_max_ms: float
    model: PinholeView | None = None
    camera_from_world: PoseView | None = None


class ProjectorView(Message):
    """The projector or screen of a rig."""

    width_px: int
    height_px: int
    frame_period_ms: float | None
    model: PinholeView | None = None
    projector_from_world: PoseView | None = None


class RigView(Message):
    """A rig with its devices, as a scan sees it."""

    name: str
    title: str
    options: dict[str, Any]
    reference: str
    cameras: tuple[CameraView, ...]
    projector: ProjectorView | None
    screen_mm: tuple[tuple[float, float, float], ...] = ()
    """Edge of the display that the part is seen with, once around, in the world; empty where there is none."""
    mirror_mm: tuple[float, float, float] | None = None
    """Middle of the mirror under test, in the world; None where it isn't known."""


class RigOffer(Message):
    """A rig that a scan can be made with."""

    name: str
    title: str
    doc: str
    options_schema: dict[str, Any]
    """JSON schema of the options (scene, sizes, seed ... for the simulated rig)."""
    error: str | None = None
    """Why it can't be used, e.g. a plug-in that failed to load."""


# ---- the rig desk: a rig without a scan


class RigLink(StrEnum):
    """Whether a rig's devices are held by this application."""

    CLOSED = "closed"
    """No: another program may use them."""
    OPENING = "opening"
    OPEN = "open"
    CLOSING = "closing"


class WorkStatus(StrEnum):
    """Where a piece of work at a rig is."""

    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"
    CANCELLED = "cancelled"


class RigOwner(Message):
    """Who has the rig for himself now."""

    who: str
    doing: str
    """What, as half a sentence: `captures scan 'Bracket'`."""
    scan: str = ""
    """The scan that is captured; empty: another work, e.g. the latency calibration."""


class DeviceView(Message):
    """One device of an open rig."""

    name: str
    role: str
    """`camera` or `projector`."""
    vendor: str
    model: str
    serial: str
    address: str
    driver: str
    firmware: str
    link: str
    """closed, ready, armed or lost."""
    width_px: int
    height_px: int
    refresh_hz: float | None = None
    """Of a projector: None where its light is steady or unknown."""


class Limits(Message):
    """What a number may be."""

    min: float
    max: float
    step: float = 0.0
    """0: any value between."""


class LiveSettings(Message):
    """How live pictures are taken: all cameras alike."""

    exposure_ms: float = Field(20.0, gt=0, allow_inf_nan=False)
    gain_db: float = Field(0.0, allow_inf_nan=False)
    snap: bool = True
    """Whole periods of the projector only; without effect where it has none."""
    pattern: str = Field("white", max_length=40)
    """What is projected meanwhile: one of the patterns that the rig's state lists."""
    level: int = Field(128, ge=0, le=255)
    """Code of the pattern `gray`."""


class LiveCamera(Message):
    """What the newest picture of a camera says."""

    camera: str
    number: int
    """Another one: another picture."""
    age_s: float
    width_px: int
    height_px: int
    bit_depth: int
    exposure_ms: float | None
    gain_db: float | None
    histogram: tuple[int, ...]
    """Pixels in 256 bins from black to full scale."""
    mean_gray: float
    saturated_share: float
    """Of all pixels, in [0, 1]."""
    black_share: float
    """Share of pixels at 0."""
    sharpness: float
    """Comparable only between pictures of the same scene under the same pattern; exposure doesn't matter."""


class PartView(Message):
    """What a square part of the newest picture of a camera says."""

    number: int
    """Of the picture, as in `LiveCamera`."""
    mean_gray: float
    saturated_share: float
    """Of the part's pixels, in [0, 1]."""
    sharpness: float
    """Comparable only between pictures of the same place under the same pattern; exposure doesn't matter."""


class LiveView(Message):
    """The newest pictures of a rig in numbers."""

    rig: str
    running: bool
    """Pictures are taken because somebody looks, or captured by the owner."""
    owner: RigOwner | None
    settings: LiveSettings
    """Those in force, snapped."""
    cameras: tuple[LiveCamera, ...]
    failure: str | None
    """Why no newer picture comes."""


class StartLatency(Message):
    """Measure the latency of a rig's projector."""

    repetitions: int = Field(10, ge=3, le=100)
    """Changes each way at each delay."""


class LatencyView(Message):
    """How long after its acknowledgement a projector shows a pattern."""

    settle_ms: float
    refresh_hz: float
    exposure_ms: float
    delays_ms: tuple[float, ...]
    up: tuple[float, ...]
    """Smallest share of the change from black to white that any camera saw, for each delay."""
    down: tuple[float, ...]
    """The same from white to black."""
    measured: datetime
    kept: bool
    """Kept for the rig: its projector waits as long from now on."""
    note: str = ""
    """Why it isn't kept, or doesn't count; how coarse it is where cameras can't be triggered."""
    resolution_ms: float | None = None
    """So much shorter the slowest change may have been; None: not known."""


class RigWork(Message):
    """What was started at a rig last: its latency calibration, or a check."""

    kind: str
    """In words: latency calibration, or check."""
    status: WorkStatus
    who: str
    progress: float
    """Share done, 0..1."""
    text: str
    error: str | None = None
    latency: LatencyView | None = None
    lines: tuple[str, ...] = ()
    """What a check found."""
    problems: tuple[str, ...] = ()
    """What looked wrong in it; empty: all is well."""


class RigState(Message):
    """A rig without a scan: its devices, who has it, what is done with it."""

    name: str
    title: str
    link: RigLink
    options: dict[str, Any]
    """Options that it is open with, or was last."""
    failure: str | None
    """Why it couldn't be opened, or failed since."""
    owner: RigOwner | None
    devices: tuple[DeviceView, ...]
    exposure_ms: Limits | None
    """What all cameras can do; None while it isn't open."""
    gain_db: Limits | None
    period_ms: float | None
    """Of the projector; exposures snap to its multiples."""
    patterns: tuple[str, ...]
    """What can be projected."""
    live: LiveSettings
    settle_ms: float | None
    """How long its projector waits after an acknowledgement; None: not known."""
    settle_measured: datetime | None
    keeps_latency: bool
    """Whether a measured latency can be kept: only for rigs that are described by a file."""
    work: RigWork | None


class DiscoverCameras(Message):
    """Look for cameras."""

    addresses: tuple[str, ...] = Field((), max_length=64)
    """Asked one by one, by unicast; none: those that rig files name."""
    search: bool = False
    """Let every driver look for itself. GigE Vision drivers broadcast: every device on every network hears it."""


class FoundCameraView(Message):
    """A camera that answered."""

    driver: str
    rig_line: str
    """What a rig file says of it, without the camera's name."""
    vendor: str
    model: str
    serial: str
    address: str
    controlled_by: str | None
    """Who controls it; empty: nobody; None: it doesn't say."""
    used_in: tuple[str, ...]
    """Rigs of this station that name it."""


class Discovery(Message):
    """What was found."""

    cameras: tuple[FoundCameraView, ...]
    problems: tuple[str, ...] = ()
    """Why some drivers couldn't search."""
