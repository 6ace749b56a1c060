"""Numerics against real captures; how errors are counted stands in each folder's README."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.numerics.absolute_phase import AbsolutePhase, Limits, decode_frames
from backend.numerics.fringe_orders import cascade, maximum_likelihood
from backend.numerics.gray_code import decode_gray_code, distinct_projector_pixels
from backend.numerics.phasors import fuse_exposures, modulation_gray, wrapped_phase_rad
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import NoiseModel

pytestmark = pytest.mark.skipif(
    "UNGLARE_DATA" not in os.environ, reason="UNGLARE_DATA names no folder of real captures"
)
NOISE = NoiseModel(read_gray=1.0, gray_per_e=0.0)


def load(
    path: str, kind: str = "sine", axis: str = "x"
) -> tuple[list[np.ndarray], list[dict[str, Any]], dict[str, Any]]:
    """Read the frames of one kind and axis in the order of the folder's description."""
    file = Path(os.environ["UNGLARE_DATA"]) / path
    document = json.loads(file.read_text())
    entries = [
        entry for entry in document["frames"]
        if entry["pattern"]["kind"] == kind and entry["pattern"]["axis"] == axis
    ]  # fmt: skip
    frames: list[np.ndarray] = []
    for entry in entries:
        picture = cv2.imread(str(file.parent / entry["file"]), cv2.IMREAD_UNCHANGED)
        assert picture is not None, entry["file"]
        if picture.ndim == 3:
            picture = np.rint(picture.mean(axis=2)).astype(np.uint8)
        frames.append(picture)
    return frames, [entry["pattern"] for entry in entries], document


def fringes(
    path: str, axis: str = "x", *, take: slice = slice(None)
) -> tuple[SineCode, list[np.ndarray], int]:
    """Read a set of fringes, or the same steps of every frequency in it."""
    frames, patterns, document = load(path, axis=axis)
    periods = tuple(dict.fromkeys(float(pattern["periods"]) for pattern in patterns))
    chosen, shifts_rad = [], []
    for value in periods:
        of_one = [i for i, pattern in enumerate(patterns) if pattern["periods"] == value][take]
        chosen += [frames[i] for i in of_one]
        shifts_rad.append(
            tuple(patterns[i]["shift_rad"] + patterns[i]["offset_rad"] for i in of_one)
        )
    size = document["projector"]["width_px" if axis == "x" else "height_px"]
    return SineCode(periods, tuple(shifts_rad)), chosen, int(size)


def wrapped(code: SineCode, frames: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Wrapped phases, and where no sample is near saturation and the fringes have contrast."""
    phasors = fuse_exposures([frames], code, exposure_ms=[1.0], noise=NOISE, saturation_gray=253)
    valid = (phasors.reasons == 0) & (modulation_gray(phasors).min(axis=0) > 10)
    return wrapped_phase_rad(phasors), valid


@pytest.mark.parametrize(("scene", "limit_rad"), [("board", 0.045), ("bottle", 0.035)])
@pytest.mark.parametrize("first", [0, 1, 2])
def test_four_steps_agree_with_twelve(scene, limit_rad, first):
    path = f"ps-3freq-board-bottle/capture-{scene}.json"
    reference, valid = wrapped(*fringes(path)[:2])
    four, _ = wrapped(*fringes(path, take=slice(first, None, 3))[:2])
    assert valid.mean() > 0.8
    error_rad = np.angle(np.exp(1j * (four - reference)))[:, valid]
    assert np.sqrt((error_rad**2).mean()) <= limit_rad


def decoded(
    path: str, axis: str = "x", *, take: slice = slice(None), way: str = "likelihood"
) -> AbsolutePhase:
    code, frames, size_px = fringes(path, axis, take=take)
    orders = cascade(code.periods) if way == "cascade" else maximum_likelihood(code.periods)
    return decode_frames(
        frames, code, orders, size_px=size_px, saturation_gray=253,
        limits=Limits(min_modulation_gray=10.0 if "board" in path else 8.0, max_residual_cycles=1.0, guard_band=0.0),
    )  # fmt: skip


@pytest.mark.parametrize("scene", ["board", "bottle"])
@pytest.mark.parametrize("first", [0, 1, 2])
@pytest.mark.parametrize("way", ["likelihood", "cascade"])
def test_four_steps_find_the_fringe_orders_of_twelve(scene, first, way):
    path = f"ps-3freq-board-bottle/capture-{scene}.json"
    reference = decoded(path)
    four = decoded(path, take=slice(first, None, 3), way=way)
    both = (reference.reasons == 0) & (four.reasons == 0)
    assert both.mean() > 0.8
    # Half the shortest fringe, 42 projector pixels.
    wrong = np.abs(four.projector_px - reference.projector_px)[both] > 21
    assert wrong.mean() <= 0.012


def test_the_flat_board_is_a_plane():
    result = decoded("ps-3freq-board-bottle/capture-board.json")
    u = result.projector_px
    assert np.nanpercentile(u, [1, 50, 99]) == pytest.approx((77, 650, 1524), abs=12)
    # A plane seen through two pinholes: u = (a + b x + c y) / (1 + d x + e y), in the recess.
    rows, columns = np.mgrid[90:400, 150:550]
    v = u[90:400, 150:550].astype(float)
    x, y, v = ((a[np.isfinite(v)] - s) / 320 for a, s in ((columns, 320), (rows, 240), (v, 0)))
    design = np.stack([np.ones_like(x), x, y, -v * x, -v * y], axis=1)
    fit = np.linalg.lstsq(design, v, rcond=None)[0]
    model = (fit[0] + fit[1] * x + fit[2] * y) / (1 + fit[3] * x + fit[4] * y)
    assert v.size > 100_000
    assert 320 * np.sqrt(((v - model) ** 2).mean()) < 0.4


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("way", ["likelihood", "cascade"])
def test_box_in_both_directions_has_few_order_outliers(axis, way):
    result = decoded("ps-3freq-xy-box/capture.json", axis, way=way)
    u = result.projector_px
    valid = np.isfinite(u)
    assert valid.mean() > 0.40
    # Outliers against the median of 5 x 5 neighbours, of valid ones only.
    filled = np.where(valid, u, np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(filled, 2, constant_values=np.nan), (5, 5)
    )
    centre = np.full(u.shape, np.nan)
    centre[valid] = np.nanmedian(windows[valid].reshape(-1, 25), axis=1)
    size_px = 854 if axis == "x" else 480
    wrong = np.abs(u - centre)[valid] > size_px / 37 / 2
    assert wrong.mean() <= 0.006


def test_gray_code_of_the_shell_sees_the_projector_pixels():
    codes = {}
    for axis, size_px in (("x", 1280), ("y", 800)):
        frames, patterns, _ = load("gray-inverse-procam-shell/capture.json", "gray", axis)
        by_bit = {(p["bit"], p["inverse"]): f for p, f in zip(patterns, frames, strict=True)}
        bits = sorted({bit for bit, _ in by_bit}, reverse=True)
        # The optics don't resolve the two finest bits everywhere.
        codes[axis] = decode_gray_code(
            [by_bit[bit, False] for bit in bits], [by_bit[bit, True] for bit in bits],
            codes=size_px, size_px=size_px, min_contrast_gray=5, unjudged_low_bits=2,
        )  # fmt: skip
    valid = (codes["x"].reasons == 0) & (codes["y"].reasons == 0)
    # Whole gray levels here, thirds in the folder's figure, so its limit of 5 lies elsewhere.
    assert valid.sum() == pytest.approx(728_764, rel=0.05)
    columns, rows = (np.where(valid, codes[axis].code, -1).astype(np.int32) for axis in "xy")
    seen = distinct_projector_pixels(columns, rows, width_px=1280, height_px=800)
    assert len(seen.projector_px) == pytest.approx(329_595, rel=0.05)
    assert np.median(seen.spread_px) < 1.0
