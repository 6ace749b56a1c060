"""Arrays as `.npy` files, written while they are sent: a memory-mapped array never is in memory whole."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.lib import format as npy_format

_CHUNK_BYTES = 4 * 2**20


def npy_size_bytes(array: np.ndarray[tuple[int, ...], np.dtype[Any]]) -> int:
    """Return the length of the file."""
    return len(_header(array)) + array.nbytes


def npy_chunks(array: np.ndarray[tuple[int, ...], np.dtype[Any]]) -> Iterator[bytes]:
    """Return the file in pieces of 4 MiB; the array has to be C-contiguous."""
    yield _header(array)
    flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    for start in range(0, array.nbytes, _CHUNK_BYTES):
        yield bytes(flat[start : start + _CHUNK_BYTES])


def _header(array: np.ndarray[tuple[int, ...], np.dtype[Any]]) -> bytes:
    header = io.BytesIO()
    fields = npy_format.header_data_from_array_1_0(np.ascontiguousarray(array))
    npy_format.write_array_header_1_0(header, fields)
    return header.getvalue()
