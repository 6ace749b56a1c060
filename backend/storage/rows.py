"""What the repositories take and give: frozen rows, free of the database."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from backend.domain.states import JobStatus, Verdict


class EditKind(enum.StrEnum):
    """What an edit does."""

    SET = "set"
    RESET = "reset"
    """Back to recipe, preset or default."""
    UNDO = "undo"
    """Takes back another group of edits; the row says which."""
    TAKE = "take"
    """Take the pictures again: `field` is `take`, old and new are its numbers."""


class RunStatus(enum.StrEnum):
    """How far one run of a stage came."""

    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"
    """The process died; found at the next start."""


@dataclass(frozen=True)
class ScanRow:
    """One scan as it was asked for, and the number of its last edit."""

    id: str
    name: str
    note: str
    method: str
    rig: str
    rig_options: Mapping[str, Any]
    preset: str | None
    recipe: Mapping[str, Mapping[str, Any]]
    """`{stage: {field: value}}`, on top of defaults and preset."""
    created: datetime
    who: str
    revision: int = 0
    """Number of the last edit; 0: never edited."""


@dataclass(frozen=True)
class GivenRow:
    """A result that was handed over with the scan."""

    name: str
    """Name of the stage that it replaces, or of a type that no stage makes (`RigFacts`)."""
    type_name: str
    document: dict[str, Any]
    hash: str
    origin: Mapping[str, Any] | None = None
    """Where it comes from if neither the rig nor imported frames: `sentence`, and `calibration`, `scan` or `folder`."""


@dataclass(frozen=True)
class CalibrationRow:
    """A stage's result that is kept for a rig: later scans get the newest one of its type.

    It holds for the rig that it was made with: the same name, the same facts, the same geometry.
    """

    sequence: int
    """1, 2, 3 ...: what a person calls it."""
    type_name: str
    rig: str
    facts_hash: str
    """Content hash of the rig's `RigFacts`."""
    calibration_hash: str | None
    """Content hash of the rig's `RigCalibration`; None: it had none."""
    document: dict[str, Any]
    hash: str
    scan: str
    """The scan that it was made in."""
    stage: str
    run: str
    who: str
    when: datetime
    withdrawn: datetime | None = None
    """When it was taken back: no later scan gets it."""
    withdrawn_by: str | None = None


@dataclass(frozen=True)
class EditRow:
    """One change of one field. Rows are never changed; undo adds rows."""

    scan: str
    stage: str
    field: str
    old: Any
    new: Any
    kind: EditKind
    group: str
    """Fields changed by one request share it; undo takes back the whole group."""
    reason: str
    who: str
    when: datetime
    reverts: str | None = None
    """The group that this row undoes."""
    revision: int = 0
    """1, 2, 3 ... within the scan; given when the row is added."""


@dataclass(frozen=True)
class RunRow:
    """One run of one stage of one scan."""

    id: str
    scan: str
    stage: str
    key: str
    take: int
    status: RunStatus
    started: datetime
    job: str | None = None
    finished: datetime | None = None
    """When it ended, whatever way."""
    duration_s: float | None = None
    document: dict[str, Any] | None = None
    """The encoded result of a finished run."""
    hash: str | None = None
    """Content hash of the document."""
    checks: list[dict[str, Any]] = field(default_factory=list)
    error: str | None = None
    defect: bool = False
    """True: not an expected error; the log has the traceback."""
    versions: dict[str, str] = field(default_factory=dict)
    device: dict[str, Any] = field(default_factory=dict)
    """What the rig's devices told of themselves, for a stage that captures."""


@dataclass(frozen=True)
class DecisionRow:
    """What an operator decided about the result with a key."""

    sequence: int
    scan: str
    run: str
    stage: str
    key: str
    verdict: Verdict
    reason: str
    who: str
    when: datetime


@dataclass(frozen=True)
class FrameRow:
    """One captured frame in the journal. It counts once this row and its artifact are there."""

    scan: str
    stage: str
    take: int
    shot: str
    """Hash of pattern, mask, exposure_ms, gain_db and camera."""
    occurrence: int
    """0 for the first time the plan asks for this shot, 1 for the second ..."""
    camera: str
    document: dict[str, Any]
    """The shot: pattern, exposure_ms, gain_db, role, mask's hash."""
    artifact: str
    bit_depth: int
    when: datetime
    metadata: dict[str, Any] = field(default_factory=dict)
    """frame_id, timestamps, settings read back."""


@dataclass(frozen=True)
class JobRow:
    """One request to run a scan's stages."""

    id: str
    scan: str
    status: JobStatus
    who: str
    created: datetime
    until: str | None = None
    """Last stage to run; None: to the end."""
    unattended: bool = False
    stage: str | None = None
    """The stage it is at."""
    progress: float = 0.0
    """Share of the stage done, 0..1."""
    text: str = ""
    error: str | None = None
    started: datetime | None = None
    ended: datetime | None = None


@dataclass(frozen=True)
class AuditRow:
    """Who did what, when, why."""

    sequence: int
    scan: str
    when: datetime
    who: str
    action: str
    stage: str | None
    sentence: str
    details: dict[str, Any]
