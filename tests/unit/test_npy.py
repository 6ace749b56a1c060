"""Arrays as .npy files, in pieces."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as hnp

from backend.api.npy import npy_chunks, npy_size_bytes


@given(
    hnp.arrays(
        hnp.scalar_dtypes().filter(lambda d: d.kind in "biuf"),
        hnp.array_shapes(min_dims=0, min_side=0, max_side=5),
    )
)
def test_numpy_reads_what_was_written(array: np.ndarray) -> None:
    content = b"".join(npy_chunks(array))

    assert len(content) == npy_size_bytes(array)
    np.testing.assert_array_equal(np.load(io.BytesIO(content)), array)


def test_a_mapped_array_is_read_piece_by_piece(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(3 * 2**20, dtype=np.uint32))
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")

    pieces = list(npy_chunks(mapped))

    assert b"".join(pieces) == (tmp_path / "a.npy").read_bytes()
    assert max(map(len, pieces)) == 4 * 2**20


@pytest.mark.parametrize("order", ["C", "F"])
def test_memory_order_doesnt_matter(order: str) -> None:
    array = np.asarray(np.arange(6).reshape(2, 3), order=order)  # type: ignore[call-overload]  # numpy's literals

    np.testing.assert_array_equal(np.load(io.BytesIO(b"".join(npy_chunks(array)))), array)
