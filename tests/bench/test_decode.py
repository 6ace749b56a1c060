"""Decoding, against copying the same frames in the same run and against plain numpy.

Ratios of the best of several interleaved rounds: neither a slow machine nor a busy one moves them much.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.numerics.absolute_phase import Limits, absolute_phase, decode_frames, empty_maps
from backend.numerics.fringe_orders import cascade, maximum_likelihood
from backend.numerics.gray_code import decode_gray_code
from backend.numerics.patterns import Axis, gray_code_pattern
from backend.numerics.phasors import fuse_exposures
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import NoiseModel
from tests.fringe_scenes import Scene, ramp

pytestmark = [pytest.mark.bench, pytest.mark.timeout(900)]

HEIGHT, WIDTH = 1920, 2560
CODE = SineCode.equal_steps((59, 64, 70), 4)
NOISE = NoiseModel(read_gray=1.0, gray_per_e=1 / 60)
SIZE_PX = 1280


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    return Scene(ramp(HEIGHT, WIDTH, 0.02, 0.98)).frames(CODE, sigma_gray=1.5)


def copier(frames: list[np.ndarray]) -> Callable[[], None]:
    """Copy frames into buffers that exist already."""
    buffers = [np.zeros_like(frame) for frame in frames]

    def copy() -> None:
        for buffer, frame in zip(buffers, frames, strict=True):
            np.copyto(buffer, frame)

    return copy


def best_ms(candidates: dict[str, Callable[[], object]], rounds: int = 40) -> dict[str, float]:
    """Best time of each candidate; they take turns, so that a busy moment meets all of them."""
    best = dict.fromkeys(candidates, float("inf"))
    for candidate in candidates.values():
        candidate()
    for _ in range(rounds):
        for name, candidate in candidates.items():
            start = time.perf_counter()
            candidate()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best


def report(benchmark: Any, times: dict[str, float], run: Callable[[], object]) -> None:
    """Hand the figures to pytest-benchmark's record, and print them."""
    figures = {name: round(value, 2) for name, value in times.items()}
    benchmark.extra_info.update(figures)
    benchmark.pedantic(run, rounds=3)
    print(figures)


def numpy_decode(frames: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Decode as one would write it down in numpy: the paper's cascade, no residual, no reasons."""
    wrapped, modulation = [], []
    for i in range(0, 12, 4):
        i0, i1, i2, i3 = (frame.astype(np.float32) for frame in frames[i : i + 4])
        wrapped.append(np.arctan2(i3 - i1, i0 - i2) / np.float32(2 * np.pi))
        modulation.append(np.hypot(i3 - i1, i0 - i2) / 2)
    w59, w64, w70 = wrapped
    coarse = ((w70 - w64) - (w64 - w59)) % 1
    six = (np.rint(6 * coarse - (w70 - w64)) + w70 - w64) / 6
    return (np.rint(70 * six - w70) + w70) / 70, np.minimum.reduce(modulation)


def test_decoding_twelve_frames_takes_at_most_five_copies(benchmark, frames):
    orders, maps = maximum_likelihood(CODE.periods), empty_maps((HEIGHT, WIDTH))
    by_cascade = cascade(CODE.periods)

    def decode(ways=orders, out=maps):
        return decode_frames(frames, CODE, ways, size_px=SIZE_PX, saturation_gray=254, out=out)

    times = best_ms({"copy": copier(frames), "decode": decode, "cascade": lambda: decode(by_cascade),
                     "new_maps": lambda: decode(out=None)})  # fmt: skip
    times["numpy"] = best_ms({"numpy": lambda: numpy_decode(frames)}, rounds=2)["numpy"]
    report(benchmark, times, decode)
    assert times["decode"] <= 5 * times["copy"]
    assert times["decode"] * 5 <= times["numpy"]


def test_decoding_with_sigma_and_margin_costs_little_more(benchmark, frames):
    orders = maximum_likelihood(CODE.periods)
    plain = empty_maps((HEIGHT, WIDTH))
    full = empty_maps((HEIGHT, WIDTH), with_sigma=True, with_margin=True)

    def decode(out):
        return decode_frames(
            frames, CODE, orders, size_px=SIZE_PX, saturation_gray=254, noise=NOISE, out=out
        )

    times = best_ms({"plain": lambda: decode(plain), "full": lambda: decode(full)})
    report(benchmark, times, lambda: decode(full))
    assert times["full"] <= 2 * times["plain"]


def test_fusing_three_exposures_and_finding_the_position(benchmark):
    scene = Scene(ramp(HEIGHT, WIDTH, 0.02, 0.98), 25.0, 35.0)
    exposure_ms = [1.0, 2.0, 4.0]
    exposures = [scene.frames(CODE, exposure_ms=t, sigma_gray=1.5) for t in exposure_ms]
    orders = maximum_likelihood(CODE.periods)

    def fuse(out=None):
        return fuse_exposures(
            exposures, CODE, exposure_ms=exposure_ms, noise=NOISE, saturation_gray=254, out=out
        )

    def fuse_numpy():
        total, sums = 0.0, [0.0] * 6
        for frames, t in zip(exposures, exposure_ms, strict=True):
            stack = np.stack(frames).astype(np.float32)
            variance = 1 + np.maximum(stack.mean(axis=0), 0) / 60
            weight = (stack.max(axis=0) < 254) * t / variance
            total = total + weight * t
            for k in range(3):
                sums[k] = sums[k] + weight * (stack[4 * k] - stack[4 * k + 2])
                sums[k + 3] = sums[k + 3] + weight * (stack[4 * k + 3] - stack[4 * k + 1])
        return [value / total for value in sums]

    phasors, maps = fuse(), empty_maps((HEIGHT, WIDTH), with_sigma=True)

    def locate():
        return absolute_phase(phasors, CODE, orders, size_px=SIZE_PX, limits=Limits(), out=maps)

    everything = [frame for frames in exposures for frame in frames]
    times = best_ms(
        {
            "copy": copier(everything),
            "fuse": lambda: fuse(phasors),
            "locate": locate,
            "new_maps": fuse,
        },
        rounds=20,
    )
    times["numpy"] = best_ms({"numpy": fuse_numpy}, rounds=2)["numpy"]
    report(benchmark, times, fuse)
    # 23 bytes per pixel are written, nearly as much as is read, and each row is touched again in the caches.
    assert times["fuse"] <= 8 * times["copy"]
    assert times["fuse"] * 3 <= times["numpy"]
    # 23 bytes per pixel are read and 18 written, more than all the frames.
    assert times["locate"] <= 6 * times["copy"]


def test_gray_code_of_44_frames_takes_at_most_three_copies(benchmark):
    height, width = 1944, 2592
    rng = np.random.default_rng(0)
    columns = np.linspace(0, 1279.99, width).astype(int)
    rows = np.linspace(0, 799.99, height).astype(int)
    sets: dict[str, tuple[list[np.ndarray], list[np.ndarray]]] = {}
    axes: tuple[tuple[Axis, int, np.ndarray], ...] = (("x", 1280, columns), ("y", 800, rows))
    for axis, size, seen in axes:
        for inverse in (False, True):
            for bit in reversed(range(11)):
                pattern = gray_code_pattern(
                    width_px=1280,
                    height_px=800,
                    axis=axis,
                    bit=bit,
                    bits=11,
                    codes=size,
                    inverse=inverse,
                )
                line = (pattern[0] if axis == "x" else pattern[:, 0])[seen] // 2
                plane = line[np.newaxis, :] if axis == "x" else line[:, np.newaxis]
                noisy = plane + rng.integers(0, 20, (height, width), dtype=np.uint8)
                sets.setdefault(axis, ([], []))[inverse].append(noisy)

    maps = {axis: decode_gray_code(*sets[axis], codes=size, size_px=size) for axis, size, _ in axes}

    def decode():
        return [
            decode_gray_code(*sets[axis], codes=size, size_px=size, out=maps[axis])
            for axis, size, _ in axes
        ]

    def decode_numpy():
        codes = []
        for patterns, inverses in sets.values():
            binary = code = np.zeros((height, width), np.int32)
            for pattern, inverse in zip(patterns, inverses, strict=True):
                binary = binary ^ (pattern > inverse)
                code = 2 * code + binary
            codes.append(code)
        return codes

    everything = [frame for pair in sets.values() for part in pair for frame in part]
    times = best_ms({"copy": copier(everything), "decode": decode}, rounds=20)
    times["numpy"] = best_ms({"numpy": decode_numpy}, rounds=2)["numpy"]
    report(benchmark, times, decode)
    found = decode()
    assert (found[0].code == columns).all()
    assert (found[1].code == rows[:, np.newaxis]).all()
    assert times["decode"] <= 3 * times["copy"]


def peak_mb(run: Callable[[], object]) -> float:
    """Resident memory at its highest during a run, above what it was before, in [MB]."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")

    def read(key: str) -> float:
        line = next(line for line in status.read_text().splitlines() if line.startswith(key))
        return float(line.split()[1]) / 1000

    reset.write_text("5")
    before = read("VmRSS")
    run()
    return read("VmHWM") - before


def test_decoding_needs_no_memory_beside_its_maps(frames):
    orders, maps = maximum_likelihood(CODE.periods), empty_maps((HEIGHT, WIDTH))

    def decode():
        decode_frames(frames, CODE, orders, size_px=SIZE_PX, saturation_gray=254, out=maps)

    decode()
    frames_mb = sum(frame.nbytes for frame in frames) / 1e6
    extra_mb = peak_mb(decode)
    print({"frames_mb": frames_mb, "extra_mb": extra_mb})
    assert extra_mb < 0.05 * frames_mb
