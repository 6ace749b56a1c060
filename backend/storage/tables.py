"""The tables. `edits`, `decisions`, `frames` and `audit` only grow: triggers refuse UPDATE and DELETE.

```mermaid
erDiagram
    scans ||--o{ given : "handed over"
    scans ||--o{ edits : "revision 1, 2, 3"
    scans ||--o{ jobs : ""
    scans ||--o{ runs : ""
    scans ||--o{ frames : "journal"
    scans ||--o{ audit : ""
    runs ||--o{ calibrations : "kept for the rig"
    jobs ||--o{ runs : ""
    runs ||--o{ decisions : ""
```
"""

from datetime import datetime
from typing import Any

from sqlalchemy import (
    CheckConstraint,
    Double,
    ForeignKey,
    Index,
    MetaData,
    UniqueConstraint,
    false,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from backend.domain.states import JobStatus, Verdict
from backend.storage.columns import (
    SEARCHABLE,
    SEQUENCE,
    ExactJson,
    ExactJsonOrNull,
    UtcDateTime,
    Words,
    one_of,
)
from backend.storage.rows import EditKind, RunStatus

APPEND_ONLY = ("edits", "decisions", "frames", "audit")
"""Tables whose rows are never changed or removed."""


class Base(DeclarativeBase):
    """All constraints get a name, so that a migration can say which one it changes."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {datetime: UtcDateTime(), float: Double(), str: Words()}


class Scan(Base):
    """See `ScanRow`."""

    __tablename__ = "scans"
    __table_args__ = (CheckConstraint("revision >= 0", name="revision"), Index(None, "created"))

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    note: Mapped[str]
    method: Mapped[str]
    rig: Mapped[str]
    rig_options: Mapped[dict[str, Any]] = mapped_column(ExactJson)
    preset: Mapped[str | None]
    recipe: Mapped[dict[str, dict[str, Any]]] = mapped_column(ExactJson)
    created: Mapped[datetime]
    who: Mapped[str]
    revision: Mapped[int] = mapped_column(default=0)


class Given(Base):
    """See `GivenRow`."""

    __tablename__ = "given"

    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    type_name: Mapped[str]
    document: Mapped[dict[str, Any]] = mapped_column(ExactJson)
    hash: Mapped[str]
    origin: Mapped[dict[str, Any] | None] = mapped_column(ExactJsonOrNull)


class Calibration(Base):
    """See `CalibrationRow`."""

    __tablename__ = "calibrations"
    __table_args__ = (
        CheckConstraint("(withdrawn IS NULL) = (withdrawn_by IS NULL)", name="withdrawn"),
        Index(None, "rig", "type_name"),
        Index(None, "scan"),
        {"sqlite_autoincrement": True},
    )

    sequence: Mapped[int] = mapped_column(SEQUENCE, primary_key=True)
    type_name: Mapped[str]
    rig: Mapped[str]
    facts_hash: Mapped[str]
    calibration_hash: Mapped[str | None]
    document: Mapped[dict[str, Any]] = mapped_column(ExactJson)
    hash: Mapped[str]
    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"))
    stage: Mapped[str]
    run: Mapped[str] = mapped_column(ForeignKey("runs.id"))
    who: Mapped[str]
    when: Mapped[datetime]
    withdrawn: Mapped[datetime | None]
    withdrawn_by: Mapped[str | None]


class Edit(Base):
    """See `EditRow`."""

    __tablename__ = "edits"
    __table_args__ = (CheckConstraint("revision > 0", name="revision"),)

    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"), primary_key=True)
    revision: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    stage: Mapped[str]
    field: Mapped[str]
    old: Mapped[Any] = mapped_column(ExactJson, nullable=False)
    new: Mapped[Any] = mapped_column(ExactJson, nullable=False)
    kind: Mapped[EditKind] = mapped_column(one_of(EditKind, "kind"))
    group: Mapped[str]
    reverts: Mapped[str | None]
    reason: Mapped[str]
    who: Mapped[str]
    when: Mapped[datetime]


class Job(Base):
    """See `JobRow`."""

    __tablename__ = "jobs"
    __table_args__ = (
        CheckConstraint("progress >= 0 AND progress <= 1", name="progress"),
        Index(None, "scan", "created"),
        Index(None, "status"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"))
    status: Mapped[JobStatus] = mapped_column(one_of(JobStatus, "status"))
    until: Mapped[str | None]
    unattended: Mapped[bool]
    stage: Mapped[str | None]
    progress: Mapped[float]
    text: Mapped[str]
    error: Mapped[str | None]
    who: Mapped[str]
    created: Mapped[datetime]
    started: Mapped[datetime | None]
    ended: Mapped[datetime | None]


class Run(Base):
    """See `RunRow`."""

    __tablename__ = "runs"
    __table_args__ = (
        CheckConstraint("take >= 0", name="take"),
        CheckConstraint(
            "status <> 'finished' OR (document IS NOT NULL AND hash IS NOT NULL)",
            name="finished_has_result",
        ),
        Index(None, "scan", "key", "status"),
        Index(None, "job"),
        Index(None, "status"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"))
    job: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"))
    stage: Mapped[str]
    key: Mapped[str]
    take: Mapped[int]
    status: Mapped[RunStatus] = mapped_column(one_of(RunStatus, "status"))
    started: Mapped[datetime]
    finished: Mapped[datetime | None]
    duration_s: Mapped[float | None]
    document: Mapped[dict[str, Any] | None] = mapped_column(ExactJsonOrNull)
    hash: Mapped[str | None]
    checks: Mapped[list[dict[str, Any]]] = mapped_column(ExactJson)
    error: Mapped[str | None]
    defect: Mapped[bool] = mapped_column(server_default=false())
    versions: Mapped[dict[str, str]] = mapped_column(SEARCHABLE)
    device: Mapped[dict[str, Any]] = mapped_column(SEARCHABLE)


class Decision(Base):
    """See `DecisionRow`."""

    __tablename__ = "decisions"
    __table_args__ = (
        Index(None, "scan", "key"),
        Index(None, "run"),
        {"sqlite_autoincrement": True},
    )

    sequence: Mapped[int] = mapped_column(SEQUENCE, primary_key=True)
    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"))
    run: Mapped[str] = mapped_column(ForeignKey("runs.id"))
    stage: Mapped[str]
    key: Mapped[str]
    verdict: Mapped[Verdict] = mapped_column(one_of(Verdict, "verdict"))
    reason: Mapped[str]
    who: Mapped[str]
    when: Mapped[datetime]


class Frame(Base):
    """See `FrameRow`."""

    __tablename__ = "frames"
    __table_args__ = (
        UniqueConstraint("scan", "stage", "take", "shot", "occurrence"),
        CheckConstraint("take >= 0 AND occurrence >= 0", name="counts"),
        Index(None, "artifact"),
        {"sqlite_autoincrement": True},
    )

    sequence: Mapped[int] = mapped_column(SEQUENCE, primary_key=True)
    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"))
    stage: Mapped[str]
    take: Mapped[int]
    shot: Mapped[str]
    occurrence: Mapped[int]
    camera: Mapped[str]
    document: Mapped[dict[str, Any]] = mapped_column(ExactJson)
    artifact: Mapped[str]
    bit_depth: Mapped[int]
    metadata_: Mapped[dict[str, Any]] = mapped_column("metadata", SEARCHABLE)
    when: Mapped[datetime]


class Audit(Base):
    """See `AuditRow`."""

    __tablename__ = "audit"
    __table_args__ = (Index(None, "scan", "sequence"), {"sqlite_autoincrement": True})

    sequence: Mapped[int] = mapped_column(SEQUENCE, primary_key=True)
    scan: Mapped[str] = mapped_column(ForeignKey("scans.id"))
    when: Mapped[datetime]
    who: Mapped[str]
    action: Mapped[str]
    stage: Mapped[str | None]
    sentence: Mapped[str]
    details: Mapped[dict[str, Any]] = mapped_column(ExactJson)
