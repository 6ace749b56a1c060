"""What a client may know of a rig."""

from typing import Any

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


class RigCheck(Message):
    """What `rigs check` found."""

    name: str
    ok: bool
    lines: tuple[str, ...]
