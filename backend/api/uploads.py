"""A captured folder as a zip file: streamed to disk, counted, and unpacked without trust."""

import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from errno import EDQUOT, EEXIST, EISDIR, ENAMETOOLONG, ENOSPC, ENOTDIR
from pathlib import Path, PurePosixPath

from starlette.concurrency import run_in_threadpool

from backend.api.errors import TooLargeError
from backend.domain.errors import InvalidCaptureError, StorageFullError
from backend.services.capture_sources import is_foreign

CAPTURE_FILE = "capture.json"
_MOST_FILES = 20_000
_WRITE_BYTES = 2**20
_BAD_NAMES = frozenset({EEXIST, EISDIR, ENAMETOOLONG, ENOTDIR})


@contextmanager
def upload_folder(parent: Path) -> Iterator[Path]:
    """Make a folder for one upload that is gone afterwards, whatever happens."""
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="upload-", dir=parent) as folder:
        yield Path(folder)


async def save(body: AsyncIterator[bytes], target: Path, limit_bytes: int) -> int:
    """Write a body to a file as it arrives and return its size.

    Raises
    ------
    TooLargeError
        As soon as more than `limit_bytes` have arrived.
    StorageFullError
        If the disk is full.
    """
    size_bytes, waiting = 0, bytearray()
    with _full_disk_named(target), target.open("wb") as file:
        async for piece in body:
            size_bytes += len(piece)
            if size_bytes > limit_bytes:
                raise too_large(limit_bytes)
            waiting += piece
            if len(waiting) >= _WRITE_BYTES:
                await run_in_threadpool(file.write, bytes(waiting))
                waiting.clear()
        await run_in_threadpool(file.write, bytes(waiting))
    return size_bytes


def too_large(limit_bytes: int) -> TooLargeError:
    """Say that an upload is over the limit."""
    return TooLargeError(
        f"The upload is larger than {limit_bytes / 2**20:.0f} MiB; leave frames out, or raise UNGLARE_UPLOAD_LIMIT_MB."
    )


def unpack(archive: Path, folder: Path, limit_bytes: int) -> Path:
    """Unpack a zip file and return the path of the `capture.json` in it.

    Parameters
    ----------
    archive
        The zip file.
    folder
        An empty folder; nothing is written outside of it.
    limit_bytes
        Most bytes that its files may have together, counted while they are unpacked: what the
        archive says of itself isn't believed.

    Raises
    ------
    InvalidCaptureError
        If it isn't a zip file, holds a path that leads out of the folder, a link, or not
        exactly one `capture.json`.
    TooLargeError
        If more comes out than the limit.
    StorageFullError
        If the disk is full.
    """
    try:
        with zipfile.ZipFile(archive) as zipped, _full_disk_named(folder):
            members = [m for m in zipped.infolist() if not m.is_dir()]
            if len(members) > _MOST_FILES:
                raise InvalidCaptureError(
                    f"The zip file holds {len(members)} files; {_MOST_FILES} are the most."
                )
            left_bytes = limit_bytes
            for member in members:
                target = folder / _inner_path(member)
                target.parent.mkdir(parents=True, exist_ok=True)
                with zipped.open(member) as source, target.open("xb") as file:
                    left_bytes -= _copy(source.read, file.write, left_bytes, limit_bytes)
    except (zipfile.BadZipFile, EOFError, RuntimeError, zlib.error) as error:
        raise InvalidCaptureError(  # RuntimeError: encrypted, or packed by a method that we don't know
            f"The upload is no readable zip file ({error}); zip the capture's folder again."
        ) from error
    except OSError as error:
        if error.errno not in _BAD_NAMES:
            raise
        raise InvalidCaptureError(
            f"The zip file holds {Path(str(error.filename)).name[:80]!r} twice or under a name that no file can have; zip the capture's folder again."
        ) from error
    return _capture_file(folder)


def _inner_path(member: zipfile.ZipInfo) -> Path:
    name = member.filename
    path = PurePosixPath(name)
    leads_out = path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name
    if leads_out or not name.isprintable() or not path.parts:
        raise InvalidCaptureError(
            f"The zip file holds {name!r}, which would be written outside of its folder; zip the folder itself."
        )
    if stat.S_ISLNK(member.external_attr >> 16):
        raise InvalidCaptureError(
            f"The zip file holds the link {name!r}; zip the file it points to."
        )
    return Path(*path.parts)


def _copy(
    read: Callable[[int], bytes],
    write: Callable[[bytes], int],
    left_bytes: int,
    limit_bytes: int,
) -> int:
    copied = 0
    while piece := read(_WRITE_BYTES):
        copied += len(piece)
        if copied > left_bytes:
            raise too_large(limit_bytes)
        write(piece)
    return copied


def _capture_file(folder: Path) -> Path:
    found = sorted(folder.rglob(CAPTURE_FILE))
    if not found and is_foreign(folder):
        return folder
    if len(found) != 1:
        raise InvalidCaptureError(
            f"The zip file holds {len(found)} files named {CAPTURE_FILE}; it has to hold exactly one, beside its frames."
        )
    return found[0]


@contextmanager
def _full_disk_named(place: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in {ENOSPC, EDQUOT}:
            raise
        free_mib = shutil.disk_usage(place.parent).free / 2**20
        raise StorageFullError(
            f"The disk of {place.parent} is full ({free_mib:.0f} MiB free); free some and upload again."
        ) from error
