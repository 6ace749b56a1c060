"""What the databases' own errors mean to an operator."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import URL
from sqlalchemy.exc import DBAPIError

from backend.domain.errors import ConflictError, CorruptDataError, StartupError, StorageFullError

_FULL = ("database or disk is full", "53100", "no space left on device")
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
        cause = str(error.orig)
        if _tells(cause, _FULL):
            raise StorageFullError(
                "there is no room on the disk for the database; free some and try again, "
                "nothing was half-written"
            ) from error
        if _tells(cause, _DAMAGED):
            raise CorruptDataError(
                f"the database is damaged ({_first_line(cause)}); restore it from a backup"
            ) from error
        if _tells(cause, _BUSY):
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
        cause = error.orig if isinstance(error, DBAPIError) else error
        raise StartupError(
            f"the database {url.render_as_string()} can't be opened ({_first_line(str(cause))}); "
            f"check that it exists and may be written, or choose another one"
        ) from error


def _tells(cause: str, signs: tuple[str, ...]) -> bool:
    return any(sign.lower() in cause.lower() for sign in signs)


def _first_line(text: str) -> str:
    return (text.strip().splitlines() or ["no reason given"])[0]
