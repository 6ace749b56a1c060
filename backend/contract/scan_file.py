"""The `scan.json` of an export: how a scan came about, so that it can be read, imported and replayed."""

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

SCAN_FORMAT = "unglare-scan"


class _Part(BaseModel):
    """Fields that a newer version added are passed over."""

    model_config = ConfigDict(frozen=True, extra="ignore", use_attribute_docstrings=True)


class WrittenScan(_Part):
    """The scan itself."""

    id: str
    name: str
    note: str
    who: str
    created: datetime
    revision: int
    """Number of its last edit."""
    rig: str
    """Empty: the frames were imported."""
    rig_options: dict[str, Any]
    preset: str | None


class WrittenMethod(_Part):
    """The measuring method."""

    name: str
    title: str


class WrittenSetting(_Part):
    """One setting's value and where it comes from."""

    value: Any
    source: str
    """`default`, `preset`, `recipe` or `edited`."""
    chosen: Any = None
    """What the stage chose where the value is None (automatic)."""


class WrittenStage(_Part):
    """Where one stage stood, and the run that made its present result."""

    name: str
    title: str
    version: int
    status: str
    message: str
    key: str | None
    take: int
    run: str | None
    result_hash: str | None
    started: datetime | None
    duration_s: float | None
    checks: tuple[dict[str, Any], ...]
    versions: dict[str, str]
    """Of the programs that made the result."""


class WrittenGiven(_Part):
    """A result that was handed over with the scan."""

    type: str
    hash: str
    document: dict[str, Any] | None
    """Arrays are written out; None: it was made of imported frames, which `capture.json` holds."""
    origin: dict[str, Any] | None = None
    """Where it came from if it was an operator's choice or a calibration."""


class WrittenDecision(_Part):
    """What an operator decided about a result."""

    stage: str
    key: str
    verdict: str
    reason: str
    who: str
    when: datetime


class WrittenEdit(_Part):
    """One change of one setting."""

    revision: int
    stage: str
    field: str
    old: Any
    new: Any
    kind: str
    reason: str
    who: str
    when: datetime


class WrittenAudit(_Part):
    """One line of the audit trail."""

    when: datetime
    who: str
    action: str
    stage: str | None
    sentence: str


class ScanFile(_Part):
    """A `scan.json`, whole."""

    format: Literal["unglare-scan"]
    version: Literal[1]
    unglare: str
    """Version of the program that wrote it."""
    exported: datetime
    scan: WrittenScan
    method: WrittenMethod
    settings: dict[str, dict[str, WrittenSetting]]
    stages: tuple[WrittenStage, ...]
    given: dict[str, WrittenGiven]
    decisions: tuple[WrittenDecision, ...]
    edits: tuple[WrittenEdit, ...]
    audit: tuple[WrittenAudit, ...]
    devices: dict[str, Any]
    """Who the devices are that captured, by their names in the rig."""
    metrics: dict[str, Any]
    """Points, times and, where the rig knew it, the comparison with the truth."""
    results: dict[str, WrittenGiven] = {}
    """By stage, the results that can be handed to other scans."""
    arrays: dict[str, str] = {}
    """Files of the arrays that settings refer to, e.g. painted masks, by the hash in the setting."""
    files: dict[str, str]
    """sha256 of every other file of the export."""
