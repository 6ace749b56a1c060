"""A folder that appears whole or not at all: written beside its place under another name, then renamed."""

import contextlib
import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from backend.contract.scan_file import SCAN_FORMAT
from backend.domain.errors import ConflictError, StorageFullError
from backend.domain.ids import new_id

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

SCAN_FILE = "scan.json"


class FolderKind(NamedTuple):
    """How a folder of ours is known again: by a JSON file that says its format and lists its files."""

    index_file: str
    format: str


SCAN = FolderKind(SCAN_FILE, SCAN_FORMAT)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class ExportFolder:
    """Files on their way into a folder; each is hashed while it is written."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.hashes: dict[str, str] = {}
        """sha256 of every file written so far, by its path relative to the folder."""

    def write(self, name: str, parts: Iterable[bytes | memoryview]) -> None:
        """Write one file."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256()
        with path.open("wb") as file:
            for part in parts:
                digest.update(part)
                file.write(part)
        self.hashes[name] = digest.hexdigest()

    def write_array(self, name: str, array: Array) -> None:
        """Write an array as `.npy`."""
        flat = np.asarray(array, order="C")
        self.write(name, (_npy_header(flat), flat.reshape(-1).view(np.uint8).data))

    def write_json(self, name: str, document: Any) -> None:
        """Write a document that people may read."""
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
        self.write(name, (text.encode(), b"\n"))


def _npy_header(array: Array) -> bytes:
    header = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape}
    text = repr(header).encode("latin-1")
    # Version 1.0: magic, length, text padded so that the numbers begin at a multiple of 64.
    padding = -(10 + len(text) + 1) % 64
    length = len(text) + padding + 1
    return b"\x93NUMPY\x01\x00" + length.to_bytes(2, "little") + text + b" " * padding + b"\n"


def safe_name(text: str) -> str:
    """Return a text as part of a file name: a camera may be called anything."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text) or "_"


@contextlib.contextmanager
def whole_folder(folder: Path, kind: FolderKind = SCAN) -> Iterator[ExportFolder]:
    """Make a folder: it takes its place when all is written; on any error nothing is left behind.

    Raises
    ------
    ConflictError
        If something else than an export of that kind is there already, or the place can't be written.
    StorageFullError
        If there is no room.
    """
    place = folder.expanduser().absolute()
    partial = place.parent / f".{place.name}.{new_id()}.partial"
    with _readable_errors(place):
        refuse_foreign(place, kind)
        partial.mkdir(parents=True)
        try:
            yield ExportFolder(partial)
            _take_place(partial, place)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def refuse_foreign(place: Path, kind: FolderKind = SCAN) -> None:
    """Refuse a place where there is anything that isn't an older export of ours, whole or in part."""
    if not place.exists():
        return
    if not place.is_dir():
        raise ConflictError(f"{place} is a file: name a folder for the export.")
    found = {str(p.relative_to(place)) for p in place.rglob("*") if not p.is_dir()}
    if not found:
        return
    own = _files_of_export(place, kind)
    if own is None:
        raise ConflictError(
            f"{place} isn't empty and isn't an older export of the same kind: name a new folder."
        )
    if foreign := sorted(found - own):
        raise ConflictError(
            f"{place} holds files that aren't of the export ({foreign[0]}): take them away or name a new folder."
        )


def _files_of_export(place: Path, kind: FolderKind) -> set[str] | None:
    try:
        document = json.loads((place / kind.index_file).read_text(encoding="utf-8"))
        return {kind.index_file, *document["files"]} if document["format"] == kind.format else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _take_place(partial: Path, place: Path) -> None:
    """Put the new folder where the old one is; the old one goes when the new one is there."""
    if not place.exists():
        partial.rename(place)
        return
    old = place.parent / f".{place.name}.{new_id()}.old"
    place.rename(old)
    try:
        partial.rename(place)
    except OSError:
        old.rename(place)
        raise
    shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def _readable_errors(place: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise StorageFullError(
                f"There is no room for the export in {place.parent} ({os.strerror(error.errno)}): "
                "free some and export again; nothing was left behind."
            ) from error
        raise ConflictError(
            f"The export can't be written to {place} ({error.strerror}): name another folder."
        ) from error
