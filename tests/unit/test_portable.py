"""Encoded results outside of the store: what is written out comes back bit by bit."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.domain.errors import InvalidCaptureError
from backend.services.export_folder import ExportFolder, safe_name
from backend.services.portable import LARGEST_INLINE, read_array, read_back, written_out
from backend.storage.codec import content_hash, decode, encode


@dataclass(frozen=True)
class Result:
    """Arrays of all sizes."""

    small: np.ndarray[Any, Any]
    thirds: np.ndarray[Any, Any]
    large: np.ndarray[Any, Any]
    holes: np.ndarray[Any, Any]
    empty: np.ndarray[Any, Any]
    names: tuple[str, ...]


RESULT = Result(
    small=np.arange(6, dtype=np.uint16).reshape(2, 3),
    thirds=np.array([1 / 3, -2e-300, 0.1], np.float64),
    large=np.arange(LARGEST_INLINE + 1, dtype=np.float32) / 3,
    holes=np.array([1.0, np.nan, np.inf], np.float32),
    empty=np.zeros((0, 3), np.float32),
    names=("a", "b"),
)


def export(document: Any, store: Any, folder: Path) -> Any:
    target = ExportFolder(folder)

    def write(hash: str, array: np.ndarray[Any, Any]) -> str:
        target.write_array(f"given/{hash}.npy", array)
        return f"given/{hash}.npy"

    return json.loads(json.dumps(written_out(document, store, write), allow_nan=False))


def test_a_result_comes_back_bit_by_bit(store, tmp_path):
    document = encode(RESULT, store)
    written = export(document, store, tmp_path / "out")
    again = read_back(written, store, tmp_path / "out")
    assert content_hash(again) == content_hash(document)
    np.testing.assert_array_equal(decode(again, Result, store).holes, RESULT.holes)


def test_only_large_arrays_and_those_with_holes_become_files(store, tmp_path):
    written = export(encode(RESULT, store), store, tmp_path / "out")
    assert [name for name, value in written.items() if "$file" in value] == ["large", "holes"]
    assert written["thirds"]["$values"] == RESULT.thirds.tolist()


def test_files_are_what_numpy_reads(store, tmp_path):
    written = export(encode(RESULT, store), store, tmp_path / "out")
    found = np.load(tmp_path / "out" / written["large"]["$file"])
    np.testing.assert_array_equal(found, RESULT.large)
    assert found.dtype == np.float32


@pytest.mark.parametrize(
    "array",
    [np.zeros((3, 0, 2)), np.array(5.0), np.arange(24, dtype=np.uint8).reshape(2, 3, 4)[:, ::2], np.array([True])],
)  # fmt: skip
def test_every_shape_is_written(tmp_path, array):
    ExportFolder(tmp_path).write_array("a.npy", array)
    found = np.load(tmp_path / "a.npy")
    np.testing.assert_array_equal(found, array)
    assert (found.shape, found.dtype) == (array.shape, array.dtype)


@pytest.mark.parametrize(
    "broken",
    [
        {"$values": [1, 2], "dtype": "<f8", "shape": [3]},
        {"$values": [1, 2], "dtype": "nonsense", "shape": [2]},
        {"$values": [1, 2], "shape": [2]},
        {"$values": ["x"], "dtype": "<f8", "shape": [1]},
    ],
)
def test_an_array_that_is_not_what_it_says_is_refused(store, tmp_path, broken):
    with pytest.raises(InvalidCaptureError, match="export the scan again"):
        read_back({"small": broken}, store, tmp_path)


def test_a_file_outside_of_the_folder_is_refused(tmp_path):
    with pytest.raises(InvalidCaptureError, match="lies outside"):
        read_array(tmp_path / "in", "../secret.npy")


def test_a_missing_or_damaged_file_is_refused(tmp_path):
    with pytest.raises(InvalidCaptureError, match="missing"):
        read_array(tmp_path, "none.npy")
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY\x01\x00")
    with pytest.raises(InvalidCaptureError, match="can't be read"):
        read_array(tmp_path, "bad.npy")


@pytest.mark.parametrize(
    ("name", "safe"), [("left", "left"), ("../a b", "_a_b"), ("Kamera 1", "Kamera_1"), ("", "_")]
)
def test_a_camera_may_be_called_anything(name, safe):
    assert safe_name(name) == safe
