"""What the event stream tells. A client that gets one asks for what it shows."""

from typing import Literal

from backend.contract.base import Message
from backend.contract.scans import JobView


class ScanChanged(Message):
    """A scan's state changed: fetch it (or take the answer of your own request)."""

    kind: Literal["scan_changed"] = "scan_changed"
    scan: str
    revision: int


class JobProgress(Message):
    """A running job got further."""

    kind: Literal["job_progress"] = "job_progress"
    scan: str
    job: JobView


class FrameCaptured(Message):
    """A new picture of a camera is there."""

    kind: Literal["frame_captured"] = "frame_captured"
    scan: str
    rig: str
    camera: str
    artifact: str
    exposure_ms: float
    text: str


class RigChanged(Message):
    """A rig was opened, closed, lost, or got other options."""

    kind: Literal["rig_changed"] = "rig_changed"
    rig: str


Event = ScanChanged | JobProgress | FrameCaptured | RigChanged
