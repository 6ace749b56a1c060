"""Artifacts as `.npy` files in a folder.

`ab/cdef....npy` holds the artifact `abcdef...`. A file is written in `partial/`, brought to the disk and
then renamed: under its final name it is always whole, whenever the process or the power dies.
"""

# ruff: noqa: D102 - ArtifactStore has the docstrings of its methods

import contextlib
import errno
import fcntl
import hashlib
import io
import os
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from backend.domain.errors import (
    CorruptDataError,
    NotFoundError,
    StartupError,
    StorageFullError,
)
from backend.domain.ids import new_id
from backend.storage.artifacts.store import Array, ArtifactMeta, hash_prefix, is_hash, storable

_CHUNK_BYTES = 4 << 20
"""What is hashed and written at once; small enough to be in the cache for the second of the two."""
_MAPPED_BYTES = 64 << 10
"""Smaller arrays are read: a mapping costs a file descriptor and a page fault."""
_MAPPINGS = 1 << 16
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PARTIAL = "partial"


class LocalArtifactStore:
    """A folder of artifacts, shared by the threads and processes of one machine.

    Parameters
    ----------
    root
        The folder; it is made if it is missing. What dead processes left half-written is removed.
    durable
        Whether an artifact has to survive a power cut once `put` has returned. False only where the
        data are thrown away anyway.

    Raises
    ------
    StartupError
        If the folder can't be made or written.
    """

    def __init__(self, root: Path, *, durable: bool = True) -> None:
        self.root = Path(root).resolve()
        self.durable = durable
        try:
            (self.root / _PARTIAL).mkdir(parents=True, exist_ok=True)
            with _PartialFile(self.root / _PARTIAL):
                pass
        except OSError as error:
            raise StartupError(
                f"the artifact folder {self.root} can't be written ({error.strerror}); "
                f"choose another one or change its permissions"
            ) from error
        _remove_leftovers(self.root / _PARTIAL)
        _allow_many_mappings()

    def put(self, array: Array) -> ArtifactMeta:
        if (known := self._known_mapping(array)) is not None:
            return known
        array = storable(array)
        if array.nbytes <= _CHUNK_BYTES:
            # Hashing first costs nothing here (the array fits into the cache) and saves writing it again.
            meta = _meta(array, _digest(array))
            if self._is_whole(meta):
                return meta
        with _no_room(array), _PartialFile(self.root / _PARTIAL) as partial:
            meta = _meta(array, _write(array, partial.file))
            if not self._is_whole(meta):
                self._publish(partial, meta)
        return meta

    def get(self, hash: str) -> Array:
        with self._open(hash) as (file, header):
            if header.size_bytes < _MAPPED_BYTES:
                array = np.fromfile(file, header.dtype).reshape(header.shape)
                array.flags.writeable = False
                return array
            mapped = np.memmap(
                file, header.dtype, mode="r", offset=header.offset_bytes, shape=header.shape
            )
        # A plain view: numpy's own class slows every slice down and numba's dispatch with it.
        return mapped.view(np.ndarray)

    def meta(self, hash: str) -> ArtifactMeta:
        with self._open(hash) as (_, header):
            return ArtifactMeta(hash, header.shape, header.dtype.str, header.size_bytes)

    def verify(self, hash: str) -> None:
        if _digest(self.get(hash)) != hash:
            raise _corrupt(hash, "its content has changed")

    def path(self, hash: str) -> Path:
        """Return the artifact's file, whether it is there or not; NotFoundError if that is no hash."""
        if not is_hash(hash):
            raise NotFoundError(
                f"{hash[:80]!r} is no artifact's hash; it has 64 hexadecimal digits"
            )
        return self.root / hash[:2] / f"{hash[2:]}.npy"

    def __contains__(self, hash: str) -> bool:
        return is_hash(hash) and self.path(hash).is_file()

    def hashes(self) -> Iterator[str]:
        for file in self.root.glob("[0-9a-f][0-9a-f]/*.npy"):
            if is_hash(found := file.parent.name + file.stem):
                yield found

    def delete(self, hash: str) -> None:
        self.path(hash).unlink(missing_ok=True)

    def _known_mapping(self, array: Array) -> ArtifactMeta | None:
        """Return what is known if the array is a whole artifact of this store, mapped by `get`."""
        source: object = array
        while type(source) is np.ndarray:
            source = source.base
        if not isinstance(source, np.memmap) or source.filename is None:
            return None
        file = Path(source.filename)
        if file.parent.parent != self.root or not is_hash(file.parent.name + file.stem):
            return None
        same = array.shape == source.shape and array.dtype == source.dtype
        if same and array.flags.c_contiguous and array.ctypes.data == source.ctypes.data:
            meta = _meta(array, file.parent.name + file.stem)
            return meta if self._is_whole(meta) else None
        return None

    def _is_whole(self, meta: ArtifactMeta) -> bool:
        """Return whether the artifact is there; a file cut off by a disk's fault is not."""
        try:
            return self.meta(meta.hash) == meta
        except (NotFoundError, CorruptDataError):
            return False

    def _publish(self, partial: "_PartialFile", meta: ArtifactMeta) -> None:
        target = self.path(meta.hash)
        is_new = not target.parent.is_dir()
        target.parent.mkdir(exist_ok=True)
        if self.durable:
            os.fsync(partial.file.fileno())
        partial.path.replace(target)
        if self.durable:
            _bring_to_disk(target.parent)
            if is_new:
                _bring_to_disk(self.root)

    @contextlib.contextmanager
    def _open(self, hash: str) -> Iterator[tuple[BinaryIO, "_Header"]]:
        try:
            file = self.path(hash).open("rb")
        except FileNotFoundError as error:
            raise NotFoundError(
                f"there is no artifact {hash}; run the stage that made it again"
            ) from error
        with file:
            yield file, _read_header(file, hash)


class _Header(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset_bytes: int
    size_bytes: int


class _PartialFile:
    """A file being written: locked while its writer lives, gone afterwards unless it was renamed."""

    def __init__(self, folder: Path) -> None:
        self.path, self.file = _locked_file(folder)

    def __enter__(self) -> "_PartialFile":
        return self

    def __exit__(self, *error: object) -> None:
        # Close last: without the lock, somebody's `_remove_leftovers` may take the file.
        self.path.unlink(missing_ok=True)
        self.file.close()


def _locked_file(folder: Path) -> tuple[Path, BinaryIO]:
    while True:
        path = folder / new_id()
        file = path.open("xb", buffering=0)
        fcntl.flock(file, fcntl.LOCK_EX)
        # Between the two lines another process may have taken it for a leftover.
        if os.fstat(file.fileno()).st_nlink:
            return path, file
        file.close()


def _remove_leftovers(folder: Path) -> None:
    for path in folder.iterdir():
        with contextlib.suppress(OSError), path.open("rb") as file:
            # The lock dies with its process: whoever gets it knows that nobody writes here any more.
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _write(array: Array, file: Any) -> str:
    """Write header and bytes, hash them on the way, return the hash."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape}
    )
    _write_all(file, header.getbuffer())
    digest = hashlib.sha256(hash_prefix(array.dtype, array.shape))
    for chunk in _chunks(array):
        digest.update(chunk)
        _write_all(file, chunk)
    return digest.hexdigest()


def _write_all(file: Any, chunk: memoryview) -> None:
    while chunk:
        chunk = chunk[_write_some(file, chunk) :]


def _write_some(file: Any, chunk: memoryview) -> int:
    """Write what the system takes at once: without a buffer that may be less than it is given."""
    return int(file.write(chunk))


def _digest(array: Array) -> str:
    digest = hashlib.sha256(hash_prefix(array.dtype, array.shape))
    for chunk in _chunks(array):
        digest.update(chunk)
    return digest.hexdigest()


def _chunks(array: Array) -> Iterator[memoryview]:
    """Cut the array's bytes, in C order, into pieces; only pieces of a strided array are copied."""
    if array.flags.c_contiguous or array.nbytes <= _CHUNK_BYTES:
        flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        for start in range(0, flat.size, _CHUNK_BYTES):
            yield flat[start : start + _CHUNK_BYTES].data
        return
    rows = max(1, _CHUNK_BYTES // max(1, array[0].nbytes))
    for start in range(0, len(array), rows):
        part = array[start : start + rows]
        yield from _chunks(part if rows > 1 else part[0])


def _meta(array: Array, hash: str) -> ArtifactMeta:
    return ArtifactMeta(hash, array.shape, array.dtype.str, array.nbytes)


def _read_header(file: BinaryIO, hash: str) -> _Header:
    try:
        if np.lib.format.read_magic(file) != (1, 0):
            raise _corrupt(hash, "its header is of another version")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except ValueError as error:
        raise _corrupt(hash, "its header can't be read") from error
    offset = file.tell()
    size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
    present = os.fstat(file.fileno()).st_size - offset
    if dtype.kind not in "biuf":
        raise _corrupt(hash, f"it holds elements of {dtype}")
    if present != size or is_fortran:
        raise _corrupt(hash, f"it has {present} bytes where {size} were written")
    return _Header(shape, dtype, offset, size)


def _corrupt(hash: str, what: str) -> CorruptDataError:
    return CorruptDataError(
        f"the artifact {hash} is damaged: {what}; restore its file from a backup or run its stage again"
    )


@contextlib.contextmanager
def _no_room(array: Array) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise StorageFullError(
            f"there is no room for an array of {array.nbytes / 1e6:.1f} MB ({error.strerror}); "
            f"free some and run again, nothing was half-written"
        ) from error


def _bring_to_disk(folder: Path) -> None:
    """Make renames in a folder survive a power cut."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _allow_many_mappings() -> None:
    """Let this process open more files, as far as the system allows.

    Until Python 3.13 every mapped array keeps a file descriptor, and 1024, the usual limit, is less than
    two cameras' frames of a long scan.
    """
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MAPPINGS if most == resource.RLIM_INFINITY else min(_MAPPINGS, most)
    if resource.RLIM_INFINITY != now < wanted:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
