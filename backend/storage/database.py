"""The database: opened, brought up to date, and used in transactions."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError
from sqlalchemy.orm import Session

from backend.domain.errors import StartupError
from backend.storage.failures import as_expected, cannot_open
from backend.storage.repositories import Repositories

_BUSY_TIMEOUT_MS = 30_000
_READ_ONLY = "unglare_read_only"


def utc_now() -> datetime:
    """Return this moment, aware, in UTC."""
    return datetime.now(UTC)


class Database:
    """One database, usable from several threads and processes at once.

    Parameters
    ----------
    url
        `sqlite:////folder/file.db` (folder and file are made where they are missing) or
        `postgresql://user:password@host/name`.
    now
        The clock; only tests pass another one.

    Raises
    ------
    StartupError
        If the address can't be understood, or the file or server can't be opened.
    """

    def __init__(self, url: str, *, now: Callable[[], datetime] = utc_now) -> None:
        self._url = _understood(url)
        self._now = now
        self.engine: Engine = _engine(self._url)

    def upgrade(self) -> None:
        """Bring the tables up to date, all or nothing; StartupError if a newer version made them."""
        # Alembic takes a third of a second to import, which a command that only shows its help shouldn't wait for.
        from backend.storage.migrate import upgrade

        with cannot_open(self._url), self.engine.begin() as connection:
            upgrade(connection)

    @contextmanager
    def transaction(self) -> Iterator[Repositories]:
        """Do one unit of work: committed at the end, taken back whole if anything is raised.

        On SQLite there is one writing transaction at a time; others wait up to 30 s. Keep it short.

        Raises
        ------
        StorageFullError
            If there is no room on the disk.
        CorruptDataError
            If the database file is damaged.
        """
        with as_expected(), Session(self.engine) as session, session.begin():
            yield Repositories(session, self._now)

    @contextmanager
    def reading(self) -> Iterator[Repositories]:
        """Look at one consistent state without keeping writers out; writing is refused."""
        engine = self.engine.execution_options(**_read_only(self.engine))
        with as_expected(), Session(engine) as session, session.begin():
            yield Repositories(session, self._now)

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def _understood(text: str) -> URL:
    try:
        url = make_url(text)
    except ArgumentError as error:
        raise StartupError(
            f"the database address {text!r} can't be understood; write sqlite:////folder/unglare.db "
            f"or postgresql://user:password@host/name"
        ) from error
    if url.drivername in ("postgresql", "postgres"):
        return url.set(drivername="postgresql+pg8000")
    if url.get_backend_name() == "sqlite" and url.database in (None, "", ":memory:"):
        raise StartupError(
            f"the database address {text!r} names no file, and a database in memory can't be shared "
            f"between threads; write sqlite:////folder/unglare.db"
        )
    return url


def _engine(url: URL) -> Engine:
    try:
        if url.get_backend_name() == "sqlite":
            return _sqlite_engine(url)
        # A server may have been restarted since the connection was last used.
        return create_engine(url, pool_pre_ping=True)
    except (ModuleNotFoundError, NoSuchModuleError) as error:
        raise StartupError(
            f"the driver of the database address {url.render_as_string()!r} isn't installed; "
            f"for PostgreSQL: pip install 'unglare[postgres]'"
        ) from error


def _sqlite_engine(url: URL) -> Engine:
    folder = Path(str(url.database)).expanduser().resolve().parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StartupError(
            f"the database folder {folder} can't be made ({error.strerror}); choose another one"
        ) from error
    engine = create_engine(url, connect_args={"timeout": _BUSY_TIMEOUT_MS / 1000})
    event.listen(engine, "connect", _prepare_connection)
    event.listen(engine, "begin", _begin)
    event.listen(engine, "commit", _allow_writing)
    event.listen(engine, "rollback", _allow_writing)
    return engine


def _prepare_connection(connection: Any, _record: Any) -> None:
    # The driver must not begin transactions by itself: it would do so only before the first write,
    # and two readers that then both want to write would deadlock. See `_begin`.
    connection.isolation_level = None
    for pragma in (
        f"busy_timeout = {_BUSY_TIMEOUT_MS}",
        "journal_mode = WAL",
        # NORMAL would lose the last commits (of an audit trail, of a frame journal) in a power cut.
        "synchronous = FULL",
        "foreign_keys = ON",
        # Without it INSERT OR REPLACE deletes rows behind the back of the append-only triggers.
        "recursive_triggers = ON",
    ):
        connection.execute(f"PRAGMA {pragma}")


def _begin(connection: Connection) -> None:
    if connection.get_execution_options().get(_READ_ONLY):
        connection.exec_driver_sql("BEGIN")
        connection.exec_driver_sql("PRAGMA query_only = ON")
    else:
        # Take the write lock now: a transaction that reads first and then can't write has to start over.
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _allow_writing(connection: Connection) -> None:
    if connection.get_execution_options().get(_READ_ONLY):
        connection.exec_driver_sql("PRAGMA query_only = OFF")


def _read_only(engine: Engine) -> dict[str, Any]:
    if engine.dialect.name == "sqlite":
        return {_READ_ONLY: True}
    return {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
