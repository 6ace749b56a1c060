"""What the databases' own errors mean to an operator."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import URL
from sqlalchemy.exc import DBAPIError

from backend.domain.errors import ConflictError, CorruptDataError, StartupError, StorageFullError

# SQLite's sentences and PostgreSQL's codes (its sentences depend on the server's language).
_FULL = ("database or disk is full", "53100")
_DAMAGED = ("file is not a database", "database disk image is malformed", "XX001", "XX002")
_BUSY = ("database is locked", "database table is locked", "40P01", "55P03")


@contextmanager
def as_expected() -> Iterator[None]:
    """Turn a full disk, a damaged file and a lock that never comes into the application's errors.

    Everything else (a broken constraint, a refused UPDATE) is a defect and passes.
    """
    try:
        yield
    except DBAPIError as error:
        sign, cause = _sign(error), _sentence(error)
        if sign in _FULL:
            raise StorageFullError(
                "there is no room on the disk for the database; free some and try again, "
                "nothing was half-written"
            ) from error
        if sign in _DAMAGED:
            raise CorruptDataError(
                f"the database is damaged ({cause}); restore it from a backup"
            ) from error
        if sign in _BUSY:
            raise ConflictError(
                "the database was kept busy by another process for too long; try again"
            ) from error
        raise


@contextmanager
def cannot_open(url: URL) -> Iterator[None]:
    """Turn whatever goes wrong while a database is opened into one sentence with its address."""
    try:
        yield
    except (DBAPIError, OSError) as error:
        cause = _sentence(error) if isinstance(error, DBAPIError) else str(error)
        raise StartupError(
            f"the database {url.render_as_string()} can't be opened ({cause}); "
            f"check that it exists and may be written, or choose another one"
        ) from error


def _sign(error: DBAPIError) -> str:
    return _from_server(error).get("C") or str(error.orig)


def _sentence(error: DBAPIError) -> str:
    text = _from_server(error).get("M") or str(error.orig)
    return (text.strip().splitlines() or ["no reason given"])[0]


def _from_server(error: DBAPIError) -> dict[str, str]:
    """Return the fields of PostgreSQL's answer: C is the code, M the sentence."""
    arguments = getattr(error.orig, "args", ())
    return arguments[0] if arguments and isinstance(arguments[0], dict) else {}
