"""The state of a scan, whole: every request that changes a scan answers with it."""

from datetime import datetime
from typing import Any

from backend.contract.base import Message
from backend.domain.states import JobStatus, Level, StageStatus, Verdict


class ArtifactRef(Message):
    """An array in the store; fetch it at `/api/artifacts/{hash}`."""

    hash: str
    shape: tuple[int, ...]
    dtype: str


class FrameRef(Message):
    """One captured frame of a result."""

    camera: str
    pattern: dict[str, Any]
    exposure_ms: float | None
    gain_db: float
    role: str
    bit_depth: int
    image: ArtifactRef


class FieldView(Message):
    """One shown field of a finished stage."""

    name: str
    hint: dict[str, Any]
    per_camera: bool
    value: Any = None
    """Numbers, texts, tables: the thing itself, as JSON. Per camera: a mapping."""
    arrays: dict[str, ArtifactRef] = {}
    """Arrays: under the camera's name if per camera, else under ``""``."""
    frames: tuple[FrameRef, ...] = ()


class PixelLevels(Message):
    """What every captured frame of a camera says at one pixel."""

    camera: str
    x: int
    y: int
    axis: tuple[float, ...] | None
    """What the gray levels are shown over, one per frame; None: their numbers."""
    gray: tuple[float, ...]
    exposure_ms: tuple[float | None, ...]
    full_scale_gray: float
    slope: float | None = None
    """Of the line fitted to this pixel, in gray per unit of the axis."""
    offset: float | None = None
    """Of that line, in gray."""


class CheckView(Message):
    """One finding about a result."""

    name: str
    level: Level
    sentence: str
    value: float | None
    limit: float | None
    unit: str


class SettingView(Message):
    """One setting's present value and where it comes from."""

    value: Any
    source: str
    """`default`, `preset`, `recipe` or `edited`."""
    chosen: Any = None
    """What the stage chose where the value is None (automatic) and a result exists."""


class DecisionView(Message):
    """The last decision on the present result."""

    verdict: Verdict
    reason: str
    who: str
    when: datetime


class StageState(Message):
    """One stage of a scan."""

    name: str
    title: str
    status: StageStatus
    message: str
    """One sentence: what is missing, what failed, what the result says."""
    key: str | None
    """Today's key; None while an input isn't known yet."""
    stage_run: str | None
    """Id of the finished (or failed) run with today's key."""
    take: int
    settings: dict[str, SettingView]
    checks: tuple[CheckView, ...] = ()
    fields: tuple[FieldView, ...] = ()
    decision: DecisionView | None = None
    duration_s: float | None = None
    started: datetime | None = None
    result_hash: str | None = None
    can_keep: bool = False
    """True: later scans with this rig could use the result, if it is kept as a calibration."""
    kept: int | None = None
    """Number of the calibration that this result is kept as."""


class HandedView(Message):
    """A result that an operator may hand to the scan: what it is now, and which stages it reaches."""

    type: str
    title: str
    name: str
    """The stage that it replaces, or the type itself where no stage makes it."""
    stages: tuple[str, ...]
    """The stage that it replaces, or those that read it."""
    sentence: str | None = None
    """Where it comes from; None: nothing is handed over."""
    calibration: int | None = None
    """Number of the calibration, if it is one."""
    result_hash: str | None = None


class CalibrationView(Message):
    """A result that is kept for a rig; later scans get the newest one of its type."""

    number: int
    type: str
    title: str
    rig: str
    scan: str
    scan_name: str
    stage: str
    who: str
    when: datetime
    result_hash: str
    facts_hash: str
    """Content hash of the rig's facts: a scan gets it only if its rig has the same."""
    calibration_hash: str | None
    """The same of its geometry; None: the rig had none."""
    newest: bool
    """True: this is what the next scan with such a rig gets."""
    withdrawn: datetime | None = None
    withdrawn_by: str | None = None


class JobView(Message):
    """The job that runs, or the last one."""

    id: str
    status: JobStatus
    stage: str | None
    """The stage it is at."""
    progress: float
    """Share of the stage done, 0..1."""
    text: str
    remaining_s: float | None
    """Estimate for the stage; None where there is none."""
    error: str | None
    who: str


class ScanSummary(Message):
    """One line of the scan list."""

    id: str
    name: str
    method: str
    rig: str
    created: datetime
    who: str
    status: str
    """`running`, `awaiting_review`, `failed`, `done` or `idle`."""
    stages_done: int
    stages: int
    points: int | None = None
    """Number of points of the last cloud, if there is one."""


class ScanState(Message):
    """Everything about a scan that a screen needs, but the arrays."""

    id: str
    name: str
    note: str
    method: str
    rig: str
    rig_options: dict[str, Any]
    created: datetime
    who: str
    revision: int
    """Number of the last edit; sent back with an edit, so that a stale one is noticed."""
    preset: str | None
    status: str
    stages: tuple[StageState, ...]
    job: JobView | None
    handed: tuple[HandedView, ...] = ()
    """Results that may be handed over, e.g. calibrations of the rig."""
    undo: str | None
    """What undo would take back, as a sentence; None if there is nothing."""


class AuditEntry(Message):
    """One line of the audit trail: who did what, when, why."""

    sequence: int
    when: datetime
    who: str
    action: str
    """`created`, `edited`, `undone`, `redone`, `accepted`, `rejected`, `run`, `cancelled`, `finished`, `failed`, `imported`, `exported`..."""
    stage: str | None
    sentence: str
    details: dict[str, Any]
