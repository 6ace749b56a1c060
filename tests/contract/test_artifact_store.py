"""What every artifact store promises, and what the local one promises beyond.

A new store gets a class like `TestLocalArtifactStore` with a fixture `store`.
"""

import errno
import fcntl
import hashlib
import itertools
import os
import pickle
import random
import resource
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.domain.errors import (
    CorruptDataError,
    NotFoundError,
    StartupError,
    StorageFullError,
)
from backend.domain.frames import Pixels
from backend.storage.artifacts import Array, ArtifactStore, LocalArtifactStore, StoredPixels
from backend.storage.artifacts import local as local_module

MISSING = "0" * 64
NO_HASHES = [
    "",
    "../../etc/passwd",
    "0" * 63,
    "0" * 65,
    "G" * 64,
    "A" * 64,
    "/" * 64,
    "0" * 64 + "\n",
]

rng = np.random.default_rng(7)
ARRAYS: dict[str, Array] = {
    "uint8 frame": rng.integers(0, 256, (48, 64), dtype=np.uint8),
    "uint16 frame": rng.integers(0, 4096, (48, 64), dtype=np.uint16),
    "float32 map with NaN": np.where(rng.random((50, 60)) < 0.5, np.nan, 1).astype(np.float32),
    "float64 matrix": rng.random((3, 3)),
    "float16": rng.random(5).astype(np.float16),
    "int64": rng.integers(-(2**62), 2**62, 7),
    "mask": rng.random((9, 11)) < 0.5,
    "one number": np.array(3.5),
    "nothing": np.zeros((0, 3), np.float32),
    "larger than a chunk": rng.integers(0, 256, (3, 2048, 1024), dtype=np.uint8),
    "larger than a chunk, every second column": rng.integers(0, 256, (3, 1500, 4096), np.uint8)[
        :, :, ::2
    ],
    "one row larger than a chunk, reversed": np.arange(2**21, dtype=np.uint32)[::-1],
    "Fortran order": np.asfortranarray(rng.random((40, 30))),
    "transposed": rng.random((40, 30)).T,
    "big endian": rng.random(8).astype(">f8"),
    "broadcast": np.broadcast_to(np.uint8(7), (5, 4)),
}


class ArtifactStoreContract:
    """The promises of `ArtifactStore`; a subclass says with which store."""

    def test_it_is_a_store(self, store: ArtifactStore) -> None:
        assert isinstance(store, ArtifactStore)

    @pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS.keys())
    def test_an_array_comes_back_bit_by_bit(self, store: ArtifactStore, array: Array) -> None:
        meta = store.put(array)
        back = store.get(meta.hash)
        assert (back.shape, back.dtype) == (array.shape, array.dtype.newbyteorder("<"))
        assert back.tobytes() == array.astype(back.dtype, order="C").tobytes()
        assert type(back) is np.ndarray
        assert back.flags.c_contiguous

    @pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS.keys())
    def test_what_is_known_without_reading(self, store: ArtifactStore, array: Array) -> None:
        meta = store.put(array)
        assert store.meta(meta.hash) == meta
        assert (meta.shape, meta.size_bytes) == (array.shape, array.nbytes)
        assert np.dtype(meta.dtype) == array.dtype.newbyteorder("<")
        store.verify(meta.hash)

    @pytest.mark.parametrize("name", ["mask", "uint8 frame", "larger than a chunk"])
    def test_nobody_can_write_into_an_artifact(self, store: ArtifactStore, name: str) -> None:
        back = store.get(store.put(ARRAYS[name]).hash)
        with pytest.raises(ValueError, match="read-only"):
            back[0] = 0

    def test_equal_arrays_are_kept_once(self, store: ArtifactStore) -> None:
        array = ARRAYS["float64 matrix"]
        copies: list[Array] = [array, array.copy(), np.asfortranarray(array)]
        metas = [store.put(a) for a in copies]
        assert len(set(metas)) == 1
        assert list(store.hashes()) == [metas[0].hash]

    def test_equal_bytes_of_another_shape_or_type_are_another_artifact(
        self, store: ArtifactStore
    ) -> None:
        array = np.zeros(24, np.uint8)
        others: list[Array] = [array.reshape(4, 6), array.reshape(6, 4)]
        others += [array, array.view(np.int8), array.view(np.float32)]
        hashes = {store.put(other).hash for other in others}
        assert len(hashes) == 5
        assert set(store.hashes()) == hashes

    @pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS.keys())
    def test_an_artifact_put_again_is_the_same(self, store: ArtifactStore, array: Array) -> None:
        meta = store.put(array)
        back = store.get(meta.hash)
        assert store.put(back) == meta
        assert store.put(back[...]) == meta

    def test_a_part_of_an_artifact_is_another_artifact(self, store: ArtifactStore) -> None:
        whole = store.get(store.put(rng.integers(0, 256, (300, 300), dtype=np.uint8)).hash)
        for part in (whole[:-1], whole[1:], whole.T, whole[::-1], whole.view(np.int8)):
            meta = store.put(part)
            np.testing.assert_array_equal(store.get(meta.hash), part)

    def test_the_hash_is_the_same_everywhere_and_always(self, store: ArtifactStore) -> None:
        # Whoever changes this loses all stored results.
        array = np.arange(6, dtype=np.float32).reshape(2, 3)
        expected = hashlib.sha256(b"<f4 2x3\n" + array.tobytes()).hexdigest()
        assert store.put(array).hash == expected

    @pytest.mark.parametrize(
        "array",
        [
            np.array(["text"]),
            np.array([None]),
            np.zeros(2, complex),
            np.zeros(2, [("x", "f4")]),
            np.zeros(2, np.longdouble),
            np.zeros(2, "datetime64[s]"),
        ],
        ids=lambda array: str(array.dtype),
    )
    def test_other_elements_are_refused(self, store: ArtifactStore, array: Array) -> None:
        with pytest.raises(TypeError, match="can't be stored"):
            store.put(array)
        assert list(store.hashes()) == []

    @pytest.mark.parametrize("hash", [MISSING, *NO_HASHES])
    def test_what_is_missing_is_named(self, store: ArtifactStore, hash: str) -> None:
        for look in (store.get, store.meta, store.verify):
            with pytest.raises(NotFoundError, match="no artifact"):
                look(hash)
        assert hash not in store

    def test_a_deleted_artifact_is_gone_and_its_mapping_stays(self, store: ArtifactStore) -> None:
        meta = store.put(ARRAYS["larger than a chunk"])
        mapped = store.get(meta.hash)
        assert meta.hash in store
        store.delete(meta.hash)
        assert meta.hash not in store
        assert list(store.hashes()) == []
        np.testing.assert_array_equal(mapped, ARRAYS["larger than a chunk"])
        store.delete(meta.hash)  # twice is no error
        assert store.put(mapped) == meta  # and what somebody still has can be put again
        assert meta.hash in store

    def test_threads_may_put_the_same_at_once(self, store: ArtifactStore) -> None:
        arrays = [np.full((600, 800), n % 4, np.uint8) for n in range(16)]
        threads = [threading.Thread(target=store.put, args=(array,)) for array in arrays]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        hashes = list(store.hashes())
        assert len(hashes) == len(set(hashes)) == 4
        for hash in hashes:
            store.verify(hash)

    def test_a_store_can_be_sent_to_another_process(self, store: ArtifactStore) -> None:
        meta = store.put(ARRAYS["mask"])
        other: ArtifactStore = pickle.loads(pickle.dumps(store))
        np.testing.assert_array_equal(other.get(meta.hash), ARRAYS["mask"])

    def test_pixels_are_loaded_when_looked_at(self, store: ArtifactStore) -> None:
        frame = ARRAYS["uint16 frame"]
        meta = store.put(frame)
        for pixels in (StoredPixels(store, meta.hash), StoredPixels(store, meta.hash, meta)):
            assert isinstance(pixels, Pixels)
            assert (pixels.shape, pixels.dtype) == (frame.shape, frame.dtype)
            np.testing.assert_array_equal(pixels.load(), frame)
        store.delete(meta.hash)
        with pytest.raises(NotFoundError):
            pixels.load()


class TestLocalArtifactStore(ArtifactStoreContract):
    """The folder on this machine, in the variant that doesn't wait for the disk."""


class TestDurableLocalArtifactStore(ArtifactStoreContract):
    """The folder on this machine as it is used."""

    @pytest.fixture
    def store(self, tmp_path: Path) -> LocalArtifactStore:
        return LocalArtifactStore(tmp_path / "artifacts")


# --- the local store alone ----------------------------------------------------------------------------


def files(store: LocalArtifactStore) -> list[str]:
    return sorted(str(p.relative_to(store.root)) for p in store.root.rglob("*") if p.is_file())


def test_an_artifact_is_a_file_that_numpy_reads(store: LocalArtifactStore) -> None:
    meta = store.put(ARRAYS["float32 map with NaN"])
    assert files(store) == [f"{meta.hash[:2]}/{meta.hash[2:]}.npy"]
    back = np.load(store.path(meta.hash), mmap_mode="r")
    np.testing.assert_array_equal(back, ARRAYS["float32 map with NaN"])


def test_a_large_artifact_is_mapped_and_a_small_one_read(store: LocalArtifactStore) -> None:
    assert isinstance(store.get(store.put(np.zeros(1 << 17)).hash).base, np.memmap)
    assert not isinstance(store.get(store.put(np.zeros(8)).hash).base, np.memmap)


def test_other_files_in_the_folder_are_no_artifacts(store: LocalArtifactStore) -> None:
    meta = store.put(np.zeros(3))
    (store.path(meta.hash).parent / "notes.npy").touch()
    (store.root / "README").touch()
    assert list(store.hashes()) == [meta.hash]


def test_a_stored_array_is_not_written_again(
    store: LocalArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    small, large = np.zeros(8), rng.random((1000, 1000))
    metas = [store.put(small), store.put(large)]
    mapped = store.get(metas[1].hash)

    def refuse(*_: object) -> None:
        raise AssertionError("it wrote")

    monkeypatch.setattr(local_module, "_write", refuse)
    assert [store.put(small), store.put(mapped), store.put(mapped[:])] == [*metas, metas[1]]


def cut_to_half(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def cut_to_nothing(file: Path) -> None:
    os.truncate(file, 0)


def cut_in_the_header(file: Path) -> None:
    os.truncate(file, 20)


def append_a_byte(file: Path) -> None:
    file.write_bytes(file.read_bytes() + b"x")


def break_the_header(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[12:20] = b"}{}{}{}{"
    file.write_bytes(content)


def put_in_another_format(file: Path) -> None:
    file.write_bytes(b"\x89PNG" + file.read_bytes()[4:])


def claim_objects(file: Path) -> None:
    file.write_bytes(file.read_bytes().replace(b"'<f8'", b"'|O' ", 1))


DAMAGES = [
    cut_to_half,
    cut_to_nothing,
    cut_in_the_header,
    append_a_byte,
    break_the_header,
    put_in_another_format,
    claim_objects,
]


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("length", [100, 100_000], ids=["small", "large"])
def test_a_damaged_file_is_named_and_healed_by_putting_again(
    store: LocalArtifactStore, damage: Callable[[Path], None], length: int
) -> None:
    array = np.arange(length, dtype=float)
    meta = store.put(array)
    damage(store.path(meta.hash))
    for look in (store.get, store.meta, store.verify):
        with pytest.raises(CorruptDataError, match=f"artifact {meta.hash} is damaged: "):
            look(meta.hash)
    assert store.put(array) == meta
    np.testing.assert_array_equal(store.get(meta.hash), array)


@pytest.mark.parametrize("length", [100, 100_000], ids=["small", "large"])
def test_a_changed_byte_is_found_by_verifying(store: LocalArtifactStore, length: int) -> None:
    meta = store.put(np.arange(length, dtype=float))
    with store.path(meta.hash).open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x55")
    with pytest.raises(CorruptDataError, match="its content has changed"):
        store.verify(meta.hash)


# --- no room ------------------------------------------------------------------------------------------

MORE_THAN_A_CHUNK = rng.integers(0, 256, 5 << 20, dtype=np.uint8)


class FailingAt:
    """Stands for a system call that finds no room the n-th time."""

    def __init__(self, call: Callable[..., Any], number: int, code: int) -> None:
        self._call, self._left, self._code = call, number, code

    def __call__(self, *arguments: Any) -> Any:
        self._left -= 1
        if self._left == 0:
            raise OSError(self._code, os.strerror(self._code))
        return self._call(*arguments)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT], ids=["disk", "quota"])
@pytest.mark.parametrize(
    ("place", "number"),
    [("write", 1), ("write", 2), ("write", 3), ("fsync", 1), ("mkdir", 1), ("replace", 1)],
)
def test_a_full_disk_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, number: int, code: int
) -> None:
    store = LocalArtifactStore(tmp_path)
    with monkeypatch.context() as patch:
        if place == "write":
            write = FailingAt(local_module._write_some, number, code)
            patch.setattr(local_module, "_write_some", write)
        elif place == "fsync":
            patch.setattr(os, "fsync", FailingAt(os.fsync, number, code))
        else:
            failing = FailingAt(getattr(Path, place), number, code)
            patch.setattr(Path, place, lambda *a, **_: failing(*a))
        with pytest.raises(StorageFullError, match=r"no room for an array of 5.2 MB.*; free some"):
            store.put(MORE_THAN_A_CHUNK)
    assert files(store) == []
    store.verify(store.put(MORE_THAN_A_CHUNK).hash)


def test_another_fault_of_the_disk_is_no_full_disk(
    store: LocalArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        write = FailingAt(local_module._write_some, 1, errno.EIO)
        patch.setattr(local_module, "_write_some", write)
        with pytest.raises(OSError, match="Input/output error"):
            store.put(MORE_THAN_A_CHUNK)
    assert files(store) == []


LIMITED = """
import resource, sys
from pathlib import Path
import numpy as np
from backend.domain.errors import StorageFullError
from backend.storage.artifacts import LocalArtifactStore

store = LocalArtifactStore(Path(sys.argv[1]))
resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
store.put(np.ones(2_000_000, np.uint8))
try:
    store.put(np.ones(9_000_000, np.uint8))
except StorageFullError as error:
    print(error)
"""


def test_a_limit_of_the_system_leaves_nothing(store: LocalArtifactStore) -> None:
    command = [sys.executable, "-c", LIMITED, str(store.root)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "no room for an array of 9.0 MB (File too large)" in done.stdout
    assert len(files(store)) == 1
    store.verify(next(store.hashes()))


def test_a_write_cut_short_goes_on(
    store: LocalArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = local_module._write_some
    lengths = itertools.cycle([1, 1000, 100_000])
    monkeypatch.setattr(
        local_module, "_write_some", lambda file, chunk: write(file, chunk[: next(lengths)])
    )
    store.verify(store.put(MORE_THAN_A_CHUNK).hash)


# --- processes that die ---------------------------------------------------------------------------------

WRITER = """
import sys
from pathlib import Path
import numpy as np
from backend.storage.artifacts import LocalArtifactStore

store = LocalArtifactStore(Path(sys.argv[1]), durable=False)
rng = np.random.default_rng(int(sys.argv[2]))
while True:
    array = rng.integers(0, 256, int(rng.integers(1, 12_000_000)), dtype=np.uint8)
    print(store.put(array).hash, flush=True)
"""


def test_a_writer_killed_at_any_moment_leaves_whole_artifacts(store: LocalArtifactStore) -> None:
    told: set[str] = set()
    left_behind = 0
    for seed in range(8):
        told |= write_and_be_killed(store.root, seed)
        left_behind += len(list((store.root / "partial").iterdir()))
        store = LocalArtifactStore(store.root, durable=False)
        assert list((store.root / "partial").iterdir()) == []
    present = set(store.hashes())
    assert present >= told
    assert len(files(store)) == len(present)
    for hash in present:
        store.verify(hash)
    assert left_behind, "no writer was killed while it wrote: the test has shown nothing"


def write_and_be_killed(root: Path, seed: int) -> set[str]:
    command = [sys.executable, "-c", WRITER, str(root), str(seed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        told = {child.stdout.readline().strip()}
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(random.Random(seed).uniform(0, 0.1))
        os.kill(child.pid, signal.SIGKILL)
        told |= {line.strip() for line in child.stdout if line.endswith("\n")}
    assert "" not in told
    return told


def test_what_another_process_is_writing_stays(store: LocalArtifactStore) -> None:
    with local_module._PartialFile(store.root / "partial") as partial:
        LocalArtifactStore(store.root)
        assert partial.path.exists()
    assert not partial.path.exists()


def test_leftovers_are_removed_at_the_start(store: LocalArtifactStore) -> None:
    (store.root / "partial" / "left behind").write_bytes(b"half")
    LocalArtifactStore(store.root)
    assert files(store) == []


def test_a_file_taken_for_a_leftover_before_its_lock_is_made_again(
    store: LocalArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = fcntl.flock
    rounds = iter([True, False])

    def lock_after_a_cleaner(file: Any, operation: int) -> None:
        if next(rounds):
            Path(file.name).unlink()
        lock(file, operation)

    monkeypatch.setattr(fcntl, "flock", lock_after_a_cleaner)
    meta = store.put(np.arange(10))
    store.verify(meta.hash)


def test_content_reaches_the_disk_before_its_name_and_the_name_before_put_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LocalArtifactStore(tmp_path)
    done: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def note_fsync(handle: int) -> None:
        is_folder = stat.S_ISDIR(os.fstat(handle).st_mode)
        done.append(os.readlink(f"/proc/self/fd/{handle}") if is_folder else "content")
        fsync(handle)

    def note_replace(source: Path, target: Path) -> Path:
        done.append("rename")
        return replace(source, target)

    monkeypatch.setattr(os, "fsync", note_fsync)
    monkeypatch.setattr(Path, "replace", note_replace)
    folder = store.path(store.put(np.arange(10)).hash).parent
    assert done == ["content", "rename", str(folder), str(store.root)]


# --- start ----------------------------------------------------------------------------------------------


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "a file").touch()
    with pytest.raises(StartupError, match=r"artifact folder .*a file/store can't be written"):
        LocalArtifactStore(tmp_path / "a file" / "store")


MANY = """
import resource, sys
from pathlib import Path
import numpy as np
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 4096))
from backend.storage.artifacts import LocalArtifactStore

store = LocalArtifactStore(Path(sys.argv[1]), durable=False)
metas = [store.put(np.full(70_000, n, np.uint16)) for n in range(300)]
mapped = [store.get(meta.hash) for meta in metas]
print(sum(int(array[-1]) for array in mapped))
"""


@pytest.mark.skipif(
    resource.getrlimit(resource.RLIMIT_NOFILE)[1] < 4096, reason="this system allows few open files"
)
def test_more_arrays_are_mapped_than_files_may_usually_be_open(store: LocalArtifactStore) -> None:
    command = [sys.executable, "-c", MANY, str(store.root)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) == sum(range(300))
