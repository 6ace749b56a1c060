import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.numerics import decoding_kernels, fusion_kernels
from backend.numerics.absolute_phase import absolute_phase, decode_frames
from backend.numerics.errors import FrameError
from backend.numerics.fringe_orders import cascade, code_aided, maximum_likelihood
from backend.numerics.gray_code import decode_gray_code
from backend.numerics.kernels import frame_stack, kernel_input
from backend.numerics.phasors import fuse_exposures, sinusoid_misfit
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import NoiseModel


def test_frames_are_taken_where_they_lie():
    frames = [np.zeros((4, 6), np.uint16) for _ in range(3)]
    stack = frame_stack(frames)
    assert [int(a) for a in stack.addresses] == [frame.ctypes.data for frame in frames]
    assert stack.shape == (4, 6)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "no frame"),
        ([np.zeros((4, 6), np.float32)], "frame 0 is float32"),
        ([np.zeros((4, 6, 3), np.uint8)], r"frame 0 is uint8 of shape \(4, 6, 3\)"),
        ([np.zeros((4, 6), np.uint8), np.zeros((6, 4), np.uint8)], "frame 1"),
        ([np.zeros((4, 6), np.uint8), np.zeros((4, 6), np.uint16)], "frame 1 is uint16"),
    ],
)
def test_frames_that_do_not_belong_together_are_refused(frames, message):
    with pytest.raises(FrameError, match=message):
        frame_stack(frames)


def test_a_read_only_mapped_file_is_not_copied_and_looks_writable(tmp_path: Path):
    np.save(tmp_path / "map.npy", np.arange(12, dtype=np.float32).reshape(3, 4))
    mapped = np.load(tmp_path / "map.npy", mmap_mode="r")
    plain = kernel_input(mapped)
    assert plain.ctypes.data == mapped.ctypes.data
    assert type(plain) is np.ndarray
    assert plain.flags.writeable
    assert (plain == mapped).all()


def test_mapped_and_strided_frames_decode_like_plain_ones(tmp_path: Path):
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 255, (9, 14), dtype=np.uint8) for _ in range(4)]
    np.save(tmp_path / "frame.npy", frames[0])
    mapped = np.load(tmp_path / "frame.npy", mmap_mode="r")
    strided = np.asfortranarray(frames[1])
    plain = decode_gray_code(frames[:2], frames[2:], codes=4, size_px=4)
    other = decode_gray_code([mapped, strided], frames[2:], codes=4, size_px=4)
    assert all((a == b).all() for a, b in zip(plain, other, strict=True) if a.dtype != np.float32)


def test_several_python_threads_may_run_kernels_at_once():
    rng = np.random.default_rng(2)
    frames = [rng.integers(0, 255, (64, 300), dtype=np.uint8) for _ in range(8)]
    expected = decode_gray_code(frames[:4], frames[4:], codes=16, size_px=16).code
    different = []

    def work() -> None:
        for _ in range(20):
            code = decode_gray_code(frames[:4], frames[4:], codes=16, size_px=16).code
            if not np.array_equal(code, expected):
                different.append(code)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not different


_ROWS = """
from backend.numerics.kernels import row_loop

@row_loop
def fill(row):
    for i in range(row.size):
        row[i] = {value}
"""
_KERNEL = """
import numba
from backend.numerics.kernels import kernel
from rows import fill

@kernel
def run(plane):
    for i in numba.prange(plane.shape[0]):
        fill(plane[i])
"""
_MAIN = """
import numpy as np
from runner import run
plane = np.zeros((2, 3))
run(plane)
print(plane[0, 0], sum(run.stats.cache_hits.values()))
"""


def test_an_edited_row_loop_in_another_file_is_compiled_again(tmp_path: Path):
    (tmp_path / "runner.py").write_text(_KERNEL)
    root = Path(__file__).parents[2]

    def run(value: float) -> list[str]:
        (tmp_path / "rows.py").write_text(_ROWS.format(value=value))
        answer = subprocess.run(
            [sys.executable, "-B", "-c", _MAIN],
            cwd=tmp_path,
            env={"PYTHONPATH": f"{tmp_path}:{root}", "NUMBA_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        return answer.stdout.split()

    assert run(1.0) == ["1.0", "0"]
    assert run(1.0) == ["1.0", "1"]
    assert run(2.0) == ["2.0", "0"]


def test_importing_the_package_does_not_import_numba():
    code = "import sys, backend.numerics, backend.numerics.reasons, backend.numerics.patterns; print('numba' in sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    assert answer.stdout.strip() == "False"


def test_after_the_warm_up_no_kind_of_input_compiles_anything(tmp_path: Path):
    for name in ("absolute_phase", "phasors", "gray_code"):
        import_module(f"backend.numerics.{name}").warm_up_kernels()
    kernels: tuple[Any, ...] = (
        decoding_kernels.decode_frames,
        decoding_kernels.locate_phasors,
        fusion_kernels.fuse_exposures,
        fusion_kernels.sinusoid_misfit,
    )
    code = SineCode(
        (3.0, 4.0, 5.0), ((0.0, 1.0, 2.5, 4.0, 5.0), (0.0, 2.0, 4.0), (0.0, 1.0, 2.0, 3.0))
    )
    rng = np.random.default_rng(4)
    np.save(tmp_path / "frames.npy", rng.integers(0, 4096, (12, 6, 7), dtype=np.uint16))
    frames = list(np.load(tmp_path / "frames.npy", mmap_mode="r"))
    noise = NoiseModel(read_gray=1.0, gray_per_e=0.1)
    phasors = fuse_exposures(
        [frames, frames], code, exposure_ms=[1.0, 2.0], noise=noise, saturation_gray=float("inf"),
        strategy="masks", exposure_index=np.zeros((6, 7), np.uint8),
    )  # fmt: skip
    maps = {n: m for n, m in phasors._asdict().items() if isinstance(m, np.ndarray)}
    for name, plane in maps.items():
        np.save(tmp_path / f"{name}.npy", plane)
    mapped = phasors._replace(
        **{name: np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in maps}
    )
    coarse_px = np.zeros((6, 7), np.float32)
    absolute_phase(mapped, code, maximum_likelihood(code.periods), size_px=64, with_margin=True)
    absolute_phase(mapped, code, code_aided(code.periods, codes=8), size_px=64, coarse_px=coarse_px)
    decode_frames(
        frames, code, cascade(code.periods), size_px=64, saturation_gray=4094, noise=noise
    )
    sinusoid_misfit(frames, code)
    assert [len(kernel.signatures) for kernel in kernels] == [1, 1, 1, 1]
