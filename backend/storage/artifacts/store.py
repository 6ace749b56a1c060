"""The artifact store: arrays under the hash of their content, written once, mapped when read."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

_HASH = re.compile(r"[0-9a-f]{64}")


class ArtifactMeta(NamedTuple):
    """What is known of an artifact without reading it."""

    hash: str
    """sha256 over dtype, shape and bytes (C order, little endian), hexadecimal."""
    shape: tuple[int, ...]
    dtype: str
    """As numpy writes it, e.g. `|u1`, `<f4`."""
    size_bytes: int
    """Size of the array's bytes."""


@runtime_checkable
class ArtifactStore(Protocol):
    """Where arrays are kept. Used from several threads and processes at once.

    What is in the store is whole: an artifact becomes visible under its hash only when all of it is there.
    """

    def put(self, array: Array) -> ArtifactMeta:
        """Keep a copy of an array; return at once what is known if it is there already.

        Parameters
        ----------
        array
            Booleans, integers or floating point numbers, any shape and memory order. It comes back in
            C order and little endian.

        Raises
        ------
        TypeError
            If the elements are of another kind (objects, texts, records).
        StorageFullError
            If there is no room; nothing is left behind then.
        """
        ...

    def get(self, hash: str) -> Array:
        """Return an array, read only, memory-mapped where the store can.

        Raises
        ------
        NotFoundError
            If there is no such artifact.
        CorruptDataError
            If what is stored is not what was written (wrong size, unreadable header).
        """
        ...

    def meta(self, hash: str) -> ArtifactMeta:
        """Return what is known without reading the array; raises as `get` does."""
        ...

    def verify(self, hash: str) -> None:
        """Read the artifact whole and compare the hash; raises as `get` does."""
        ...

    def __contains__(self, hash: str) -> bool:
        """Return whether the artifact is there."""
        ...

    def hashes(self) -> Iterator[str]:
        """Return the hashes of all artifacts, in no order."""
        ...

    def delete(self, hash: str) -> None:
        """Remove an artifact that nothing refers to; nothing happens if it isn't there.

        Arrays that somebody has mapped stay valid. Never called by itself: only on an operator's order.
        """
        ...


@dataclass(frozen=True)
class StoredPixels:
    """Pixels in a store, loaded when looked at (see `domain.frames.Pixels`)."""

    store: ArtifactStore = field(compare=False)
    hash: str
    known: ArtifactMeta | None = field(default=None, compare=False, repr=False)
    """Where it is known already, the store isn't asked for shape and type."""

    @property
    def meta(self) -> ArtifactMeta:
        """What is known without loading."""
        return self.known or self.store.meta(self.hash)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape without loading."""
        return self.meta.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Element type without loading."""
        return np.dtype(self.meta.dtype)

    def load(self) -> Array:
        """Return the array, mapped, read only."""
        return self.store.get(self.hash)


def is_hash(text: str) -> bool:
    """Return whether a text can be an artifact's hash: anything else never reaches a file name."""
    return _HASH.fullmatch(text) is not None


def storable(array: Array) -> Array:
    """Return the array with little endian elements.

    Raises
    ------
    TypeError
        If its elements aren't booleans, integers or floating point numbers.
    """
    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        raise TypeError(
            f"an array of {array.dtype} can't be stored; booleans, integers and floats of up to 64 bit can"
        )
    return np.asarray(array, dtype=array.dtype.newbyteorder("<"))


def hash_prefix(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return what is hashed before the bytes, so that equal bytes of another shape are another artifact."""
    return f"{dtype.str} {'x'.join(map(str, shape))}\n".encode()
