"""Encoded results outside of the store: arrays as numbers in the document, large ones in files beside it."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from backend.domain.errors import InvalidCaptureError
from backend.storage.artifacts import ArtifactStore

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

LARGEST_INLINE = 1024
"""Arrays of more elements go into files: nobody reads them as numbers."""


def written_out(document: Any, store: ArtifactStore, write: Callable[[str, Array], str]) -> Any:
    """Replace the references to artifacts in an encoded result by their contents.

    Parameters
    ----------
    document
        What `encode` made.
    store
        Has the arrays.
    write
        Takes a large array and its hash, writes it, returns the file's name.
    """
    if isinstance(document, Mapping):
        if "$array" in document:
            return _array_out(store.get(document["$array"]), document["$array"], write)
        return {name: written_out(value, store, write) for name, value in document.items()}
    if isinstance(document, list | tuple):
        return [written_out(value, store, write) for value in document]
    return document


def read_back(document: Any, store: ArtifactStore, folder: Path) -> Any:
    """Put written-out arrays into the store again; the document is then as `encode` made it.

    Raises
    ------
    InvalidCaptureError
        If a file is missing or an array isn't what its type and shape say.
    """
    if isinstance(document, Mapping):
        if "$values" in document or "$file" in document:
            meta = store.put(_array_in(document, folder))
            return {"$array": meta.hash, "shape": list(meta.shape), "dtype": meta.dtype}
        return {name: read_back(value, store, folder) for name, value in document.items()}
    if isinstance(document, list):
        return [read_back(value, store, folder) for value in document]
    return document


def _array_out(array: Array, hash: str, write: Callable[[str, Array], str]) -> dict[str, Any]:
    if array.size > LARGEST_INLINE or not _is_finite(array):
        return {"$file": write(hash, array)}
    return {"$values": array.tolist(), "dtype": array.dtype.str, "shape": list(array.shape)}


def _is_finite(array: Array) -> bool:
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())


def _array_in(document: Mapping[str, Any], folder: Path) -> Array:
    if "$file" in document:
        return read_array(folder, str(document["$file"]))
    try:
        array = np.array(document["$values"], dtype=np.dtype(document["dtype"]))
        shape = tuple(int(n) for n in document["shape"])
        if array.size != math.prod(shape):
            raise ValueError
        return array.reshape(shape)
    except (KeyError, TypeError, ValueError):
        raise InvalidCaptureError(
            "scan.json holds an array that isn't what its type and shape say: export the scan again."
        ) from None


def read_array(folder: Path, name: str) -> Array:
    """Read an `.npy` file of an export.

    Raises
    ------
    InvalidCaptureError
        If it lies outside of the folder, is missing or isn't such a file.
    """
    file = (folder / name).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise InvalidCaptureError(f"{name} lies outside of {folder}: put the file into the folder.")
    try:
        array: Array = np.load(file, allow_pickle=False)
    except FileNotFoundError:
        raise InvalidCaptureError(f"The file {file} is missing: export the scan again.") from None
    except (OSError, ValueError, EOFError) as error:
        raise InvalidCaptureError(f"{file} can't be read: {error}.") from None
    return array
