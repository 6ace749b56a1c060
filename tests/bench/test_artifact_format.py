"""Which file format for 600 MB captures? `pytest tests/bench/test_artifact_format.py -m bench -s`

120 frames of 2592 x 1944, 8 bit, with the noise of the default camera. Every candidate keeps the frames one
by one, as a capture brings them, hashes them (sha256) and brings them to the disk; then all are read again,
and one is opened and looked at in one pixel. Everything runs interleaved in the same rounds, beside a copy in
memory; the table shows medians. zarr isn't a dependency: without it its lines are left out.
"""

import hashlib
import importlib
import importlib.util
import os
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.storage.artifacts import Array, LocalArtifactStore

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]

HEIGHT_PX, WIDTH_PX, FRAMES, ROUNDS = 1944, 2592, 120, 3
MEGABYTES = HEIGHT_PX * WIDTH_PX * FRAMES / 1e6


class Format:
    """One way to keep frames in a folder."""

    name: str

    def open(self, folder: Path) -> None:
        raise NotImplementedError

    def write(self, number: int, frame: Array) -> None:
        raise NotImplementedError

    def read(self, number: int) -> Array:
        raise NotImplementedError


class Store(Format):
    """The application's store: hashed while written, renamed."""

    def __init__(self, *, durable: bool) -> None:
        self.name = "store, .npy" if durable else "store, .npy, not durable"
        self._durable = durable

    def open(self, folder: Path) -> None:
        self._store = LocalArtifactStore(folder, durable=self._durable)
        self._hashes: list[str] = []

    def write(self, number: int, frame: Array) -> None:
        self._hashes.append(self._store.put(frame).hash)

    def read(self, number: int) -> Array:
        return self._store.get(self._hashes[number])


class PlainNpy(Format):
    """numpy.save: what the store's hash and care cost on top of."""

    name = "numpy.save, no hash"

    def open(self, folder: Path) -> None:
        folder.mkdir()
        self._folder = folder

    def write(self, number: int, frame: Array) -> None:
        with (self._folder / f"{number}.npy").open("wb") as file:
            np.save(file, frame)
            file.flush()
            os.fsync(file.fileno())

    def read(self, number: int) -> Array:
        array: Array = np.load(self._folder / f"{number}.npy", mmap_mode="r")
        return array


class Zarr(Format):
    """One array per frame, as artifacts are; one chunk, so that nothing else slows it."""

    def __init__(self, name: str, compressor: Callable[[Any], Any]) -> None:
        self.name = f"zarr, {name}"
        self._compressor = compressor

    def open(self, folder: Path) -> None:
        self._zarr = importlib.import_module("zarr")
        folder.mkdir()
        self._folder = folder

    def write(self, number: int, frame: Array) -> None:
        digest = hashlib.sha256(frame.data)
        folder = self._folder / f"{number}.zarr"
        kept = self._zarr.create_array(
            folder,
            shape=frame.shape,
            dtype=frame.dtype,
            chunks=frame.shape,
            compressors=self._compressor(importlib.import_module("zarr.codecs")),
            attributes={"hash": digest.hexdigest()},
        )
        kept[:] = frame
        for file in folder.rglob("*"):
            if file.is_file():
                with file.open("rb") as handle:
                    os.fsync(handle.fileno())

    def read(self, number: int) -> Array:
        array: Array = self._zarr.open_array(self._folder / f"{number}.zarr", mode="r")[:]
        return array


def formats() -> list[Format]:
    found: list[Format] = [Store(durable=True), Store(durable=False), PlainNpy()]
    if importlib.util.find_spec("zarr"):
        found += [
            Zarr("uncompressed", lambda codecs: None),
            Zarr("lz4", lambda codecs: codecs.BloscCodec(cname="lz4", shuffle="bitshuffle")),
            Zarr("zstd 3", lambda codecs: codecs.ZstdCodec(level=3)),
        ]
    return found


@dataclass
class Measured:
    """Seconds of each round."""

    write_s: list[float] = field(default_factory=list)
    write_cpu_s: list[float] = field(default_factory=list)
    """Processor time: steadier than the clock on a machine with other work."""
    read_s: list[float] = field(default_factory=list)
    one_s: list[float] = field(default_factory=list)
    size_mb: float = 0.0


@pytest.fixture(scope="module")
def stack() -> Array:
    """Fringe frames of a textured scene: shot and read noise of the default camera, 8 bit."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX].astype(np.float32)
    albedo = 0.5 + 0.3 * np.sin(x / 311) * np.sin(y / 173) + 0.1 * np.sin(x / 17 + y / 29)
    frames = np.empty((FRAMES, HEIGHT_PX, WIDTH_PX), np.uint8)
    noise = rng.standard_normal((4, HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    for n in range(FRAMES):
        gray = albedo * (110 + 90 * np.cos(x / (8 + n % 3) + np.pi / 2 * n))
        sigma = np.sqrt(gray / 60 + (12 / 60) ** 2)  # 60 electrons per gray level, 12 of read noise
        frames[n] = np.clip(gray + sigma * np.roll(noise[n % 4], 7 * n, axis=0) + 4, 0, 255)
    return frames


def test_formats(stack: Array, tmp_path: Path) -> None:
    measured = {f.name: Measured() for f in formats()}
    copies, hashes = [], []
    for round_ in range(ROUNDS):
        copies.append(seconds(lambda: np.copyto(np.empty_like(stack), stack)))
        hashes.append(seconds(lambda: [hashlib.sha256(frame.data) for frame in stack]))
        for candidate in formats():
            folder = tmp_path / f"{round_} {candidate.name}"
            run(candidate, folder, stack, measured[candidate.name])
            shutil.rmtree(folder)
    for line in table(measured, statistics.median(copies), statistics.median(hashes)):
        print(line)
    ours, plain = measured["store, .npy"], measured["numpy.save, no hash"]
    hash_and_write_s = statistics.median(hashes) + statistics.median(plain.write_s)
    assert statistics.median(ours.write_s) < 3 * hash_and_write_s
    assert statistics.median(ours.one_s) < 0.01


def run(candidate: Format, folder: Path, stack: Array, into: Measured) -> None:
    candidate.open(folder)
    cpu_s = time.process_time()
    into.write_s.append(seconds(lambda: write_all(candidate, stack)))
    into.write_cpu_s.append(time.process_time() - cpu_s)
    into.size_mb = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6
    into.one_s.append(seconds(lambda: int(candidate.read(FRAMES // 2)[900, 1300])))
    into.read_s.append(seconds(lambda: [int(candidate.read(n).max()) for n in range(FRAMES)]))
    np.testing.assert_array_equal(candidate.read(FRAMES - 1), stack[-1])


def write_all(candidate: Format, stack: Array) -> None:
    for number, frame in enumerate(stack):
        candidate.write(number, frame)


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def table(measured: dict[str, Measured], copy_s: float, hash_s: float) -> Iterator[str]:
    yield f"\n{MEGABYTES:.0f} MB, copy {MEGABYTES / copy_s:.0f} MB/s, sha256 {MEGABYTES / hash_s:.0f} MB/s"
    yield f"{'format':26} {'write MB/s':>10} {'CPU s':>6} {'read MB/s':>10} {'one pixel ms':>13} {'size %':>7}"
    for name, m in measured.items():
        write, read = (MEGABYTES / statistics.median(s) for s in (m.write_s, m.read_s))
        one_ms = 1000 * statistics.median(m.one_s)
        size = 100 * m.size_mb / MEGABYTES
        cpu_s = statistics.median(m.write_cpu_s)
        yield f"{name:26} {write:10.0f} {cpu_s:6.2f} {read:10.0f} {one_ms:13.2f} {size:7.0f}"
