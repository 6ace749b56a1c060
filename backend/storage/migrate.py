"""Migrations without an `alembic.ini`: the scripts are part of the package.

A new one: change `tables.py`, copy the newest file of `migrations/versions` under the next number, and write
both ways. `tests/contract/test_migrations.py` lists what it still lacks, on both databases.
"""

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

from backend.domain.errors import StartupError

_LOCK = 7_354_119_020
"""Any number: two processes that start at once must agree on it."""


def upgrade(connection: Connection, to: str = "head") -> None:
    """Bring the tables up to date within the connection's transaction.

    Raises
    ------
    StartupError
        If the database was made by a newer version.
    """
    _keep_others_out(connection)
    _refuse_newer(connection)
    command.upgrade(configuration(connection), to)


def downgrade(connection: Connection, to: str) -> None:
    """Take migrations back, e.g. `base` for all; data of dropped tables is lost."""
    _keep_others_out(connection)
    _refuse_newer(connection)
    command.downgrade(configuration(connection), to)


def configuration(connection: Connection) -> Config:
    """Return what Alembic has to know, without a file."""
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


def _keep_others_out(connection: Connection) -> None:
    # SQLite's BEGIN IMMEDIATE has done so already.
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LOCK})")


def _refuse_newer(connection: Connection) -> None:
    known = {
        s.revision for s in ScriptDirectory.from_config(configuration(connection)).walk_revisions()
    }
    present = MigrationContext.configure(connection).get_current_heads()
    if newer := sorted(set(present) - known):
        raise StartupError(
            f"the database {connection.engine.url.render_as_string()} was made by a newer version "
            f"(migration {', '.join(newer)} isn't known here); install that version, or choose "
            f"another database or a backup from before"
        )
