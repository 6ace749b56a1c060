"""Results kept for a rig, and where a given result comes from."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("given", sa.Column("origin", sa.Text(), nullable=True))
    op.create_table(
        "calibrations",
        sa.Column(
            "sequence", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True
        ),
        sa.Column("type_name", sa.Text(), nullable=False),
        sa.Column("rig", sa.Text(), nullable=False),
        sa.Column("facts_hash", sa.Text(), nullable=False),
        sa.Column("calibration_hash", sa.Text(), nullable=True),
        sa.Column("document", sa.Text(), nullable=False),
        sa.Column("hash", sa.Text(), nullable=False),
        sa.Column("scan", sa.Text(), sa.ForeignKey("scans.id"), nullable=False),
        sa.Column("stage", sa.Text(), nullable=False),
        sa.Column("run", sa.Text(), sa.ForeignKey("runs.id"), nullable=False),
        sa.Column("who", sa.Text(), nullable=False),
        sa.Column("when", sa.DateTime(timezone=True), nullable=False),
        sa.Column("withdrawn", sa.DateTime(timezone=True), nullable=True),
        sa.Column("withdrawn_by", sa.Text(), nullable=True),
        sa.CheckConstraint("(withdrawn IS NULL) = (withdrawn_by IS NULL)", name="withdrawn"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_calibrations_rig_type_name", "calibrations", ["rig", "type_name"])
    op.create_index("ix_calibrations_scan", "calibrations", ["scan"])


def downgrade() -> None:
    op.drop_table("calibrations")
    op.drop_column("given", "origin")
