"""The first tables.

A migration is history: it imports nothing of the application, whose tables go on changing.
"""

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

APPEND_ONLY = ("edits", "decisions", "frames", "audit")


def upgrade() -> None:
    _create_scans()
    _create_given()
    _create_edits()
    _create_jobs()
    _create_runs()
    _create_decisions()
    _create_frames()
    _create_audit()
    _create_triggers()


def downgrade() -> None:
    _drop_triggers()
    for table in ("audit", "frames", "decisions", "runs", "jobs", "edits", "given", "scans"):
        op.drop_table(table)


def _searchable() -> sa.types.TypeEngine[Any]:
    return sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def _moment() -> sa.types.TypeEngine[Any]:
    return sa.DateTime(timezone=True)


def _words(name: str, *members: str) -> sa.Enum:
    return sa.Enum(*members, name=name, native_enum=False, create_constraint=True, length=32)


def _sequence() -> sa.Column[Any]:
    counted = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    return sa.Column("sequence", counted, primary_key=True)


def _scan() -> sa.Column[Any]:
    return sa.Column("scan", sa.Text(), sa.ForeignKey("scans.id"), nullable=False)


def _text(name: str, *, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, sa.Text(), nullable=nullable)


def _create_scans() -> None:
    op.create_table(
        "scans",
        sa.Column("id", sa.Text(), primary_key=True),
        _text("name"),
        _text("note"),
        _text("method"),
        _text("rig"),
        _text("rig_options"),
        _text("preset", nullable=True),
        _text("recipe"),
        sa.Column("created", _moment(), nullable=False),
        _text("who"),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.CheckConstraint("revision >= 0", name="revision"),
    )
    op.create_index("ix_scans_created", "scans", ["created"])


def _create_given() -> None:
    op.create_table(
        "given",
        _scan(),
        _text("name"),
        _text("type_name"),
        _text("document"),
        _text("hash"),
        sa.PrimaryKeyConstraint("scan", "name"),
    )


def _create_edits() -> None:
    op.create_table(
        "edits",
        _scan(),
        sa.Column("revision", sa.Integer(), autoincrement=False, nullable=False),
        _text("stage"),
        _text("field"),
        _text("old"),
        _text("new"),
        sa.Column("kind", _words("kind", "set", "reset", "undo", "take"), nullable=False),
        _text("group"),
        _text("reverts", nullable=True),
        _text("reason"),
        _text("who"),
        sa.Column("when", _moment(), nullable=False),
        sa.PrimaryKeyConstraint("scan", "revision"),
        sa.CheckConstraint("revision > 0", name="revision"),
    )


def _create_jobs() -> None:
    status = _words(
        "status",
        "queued",
        "running",
        "awaiting_review",
        "finished",
        "failed",
        "cancelled",
        "interrupted",
    )
    op.create_table(
        "jobs",
        sa.Column("id", sa.Text(), primary_key=True),
        _scan(),
        sa.Column("status", status, nullable=False),
        _text("until", nullable=True),
        sa.Column("unattended", sa.Boolean(), nullable=False),
        _text("stage", nullable=True),
        sa.Column("progress", sa.Double(), nullable=False),
        _text("text"),
        _text("error", nullable=True),
        _text("who"),
        sa.Column("created", _moment(), nullable=False),
        sa.Column("started", _moment(), nullable=True),
        sa.Column("ended", _moment(), nullable=True),
        sa.CheckConstraint("progress >= 0 AND progress <= 1", name="progress"),
    )
    op.create_index("ix_jobs_scan_created", "jobs", ["scan", "created"])
    op.create_index("ix_jobs_status", "jobs", ["status"])


def _create_runs() -> None:
    status = _words("status", "running", "finished", "failed", "cancelled", "interrupted")
    op.create_table(
        "runs",
        sa.Column("id", sa.Text(), primary_key=True),
        _scan(),
        sa.Column("job", sa.Text(), sa.ForeignKey("jobs.id"), nullable=True),
        _text("stage"),
        _text("key"),
        sa.Column("take", sa.Integer(), nullable=False),
        sa.Column("status", status, nullable=False),
        sa.Column("started", _moment(), nullable=False),
        sa.Column("finished", _moment(), nullable=True),
        sa.Column("duration_s", sa.Double(), nullable=True),
        _text("document", nullable=True),
        _text("hash", nullable=True),
        _text("checks"),
        _text("error", nullable=True),
        sa.Column("defect", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("versions", _searchable(), nullable=False),
        sa.Column("device", _searchable(), nullable=False),
        sa.CheckConstraint("take >= 0", name="take"),
        sa.CheckConstraint(
            "status <> 'finished' OR (document IS NOT NULL AND hash IS NOT NULL)",
            name="finished_has_result",
        ),
    )
    op.create_index("ix_runs_scan_key_status", "runs", ["scan", "key", "status"])
    op.create_index("ix_runs_job", "runs", ["job"])
    op.create_index("ix_runs_status", "runs", ["status"])


def _create_decisions() -> None:
    op.create_table(
        "decisions",
        _sequence(),
        _scan(),
        sa.Column("run", sa.Text(), sa.ForeignKey("runs.id"), nullable=False),
        _text("stage"),
        _text("key"),
        sa.Column("verdict", _words("verdict", "accept", "reject"), nullable=False),
        _text("reason"),
        _text("who"),
        sa.Column("when", _moment(), nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_decisions_scan_key", "decisions", ["scan", "key"])
    op.create_index("ix_decisions_run", "decisions", ["run"])


def _create_frames() -> None:
    op.create_table(
        "frames",
        _sequence(),
        _scan(),
        _text("stage"),
        sa.Column("take", sa.Integer(), nullable=False),
        _text("shot"),
        sa.Column("occurrence", sa.Integer(), nullable=False),
        _text("camera"),
        _text("document"),
        _text("artifact"),
        sa.Column("bit_depth", sa.Integer(), nullable=False),
        sa.Column("metadata", _searchable(), nullable=False),
        sa.Column("when", _moment(), nullable=False),
        sa.UniqueConstraint("scan", "stage", "take", "shot", "occurrence"),
        sa.CheckConstraint("take >= 0 AND occurrence >= 0", name="counts"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_frames_artifact", "frames", ["artifact"])


def _create_audit() -> None:
    op.create_table(
        "audit",
        _sequence(),
        _scan(),
        sa.Column("when", _moment(), nullable=False),
        _text("who"),
        _text("action"),
        _text("stage", nullable=True),
        _text("sentence"),
        _text("details"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_audit_scan_sequence", "audit", ["scan", "sequence"])


def _create_triggers() -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute(
            """
            CREATE FUNCTION only_grows() RETURNS trigger LANGUAGE plpgsql AS $$
            BEGIN
                RAISE EXCEPTION '% only grows: its rows are never changed or removed', TG_TABLE_NAME;
            END $$
            """
        )
        for table in APPEND_ONLY:
            op.execute(
                f"CREATE TRIGGER {table}_only_grows BEFORE UPDATE OR DELETE OR TRUNCATE ON {table} "
                "FOR EACH STATEMENT EXECUTE FUNCTION only_grows()"
            )
        return
    for table in APPEND_ONLY:
        for change in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER {table}_only_grows_{change.lower()} BEFORE {change} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{table} only grows: its rows are never changed or removed'); END"
            )


def _drop_triggers() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for table in APPEND_ONLY:
            op.execute(f"DROP TRIGGER {table}_only_grows ON {table}")
        op.execute("DROP FUNCTION only_grows()")
        return
    for table in APPEND_ONLY:
        for change in ("update", "delete"):
            op.execute(f"DROP TRIGGER {table}_only_grows_{change}")
