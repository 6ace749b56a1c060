from typing import Any

import numpy as np
import pytest

from backend.numerics.errors import CodeError, FrameError
from backend.numerics.gray_code import (
    decode_gray_code,
    decode_gray_code_by_reference,
    decode_gray_code_by_threshold,
    distinct_projector_pixels,
)
from backend.numerics.patterns import gray_code_pattern
from backend.numerics.reasons import Reason

WIDTH_PX = 1280


def frames_of(codes, bits, *, columns, low=20, high=120, inverse=False, dtype=np.uint8):
    """Picture of every bit, coarsest first, where camera pixel i sees projector column columns[i]."""
    return [
        np.where(
            gray_code_pattern(
                width_px=WIDTH_PX, height_px=1, bit=bit, bits=bits, codes=codes, inverse=inverse
            )[0][columns] == 255,
            high, low,
        ).astype(dtype)
        for bit in reversed(range(bits))
    ]  # fmt: skip


COLUMNS = np.arange(WIDTH_PX).reshape(2, -1)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(("codes", "bits"), [(1280, 11), (2048, 11), (128, 7), (100, 8), (2, 1)])
def test_every_code_comes_back(codes, bits, dtype):
    patterns = frames_of(codes, bits, columns=COLUMNS, dtype=dtype)
    inverses = frames_of(codes, bits, columns=COLUMNS, dtype=dtype, inverse=True)
    decoded = decode_gray_code(patterns, inverses, codes=codes, size_px=WIDTH_PX)
    expected = (2 * COLUMNS + 1) * codes // (2 * WIDTH_PX)
    assert (decoded.code == expected).all()
    assert (decoded.contrast_gray == 100).all()
    assert (decoded.reasons == 0).all()
    middle_px = (expected + 0.5) / codes * WIDTH_PX - 0.5
    assert np.abs(decoded.projector_px - middle_px).max() < 1e-3


def test_left_out_bits_join_neighbouring_codes():
    patterns = frames_of(1280, 11, columns=COLUMNS)
    inverses = frames_of(1280, 11, columns=COLUMNS, inverse=True)
    garbage = [np.zeros_like(patterns[0])] * 2
    decoded = decode_gray_code(
        [*patterns[:9], *garbage],
        [*inverses[:9], *garbage],
        codes=1280,
        size_px=WIDTH_PX,
        ignored_low_bits=2,
    )
    assert (decoded.code == COLUMNS // 4 * 4).all()
    assert np.allclose(decoded.projector_px, COLUMNS // 4 * 4 + 1.5)
    assert (decoded.reasons == 0).all()


def test_the_weakest_bit_decides():
    patterns = frames_of(16, 4, columns=COLUMNS)
    inverses = frames_of(16, 4, columns=COLUMNS, inverse=True)
    for frame, value in ((patterns[2], 70), (inverses[2], 64)):
        frame[0, :600] = value
    decoded = decode_gray_code(patterns, inverses, codes=16, size_px=WIDTH_PX, min_contrast_gray=6)
    assert (decoded.contrast_gray[0, :600] == 6).all()
    assert (decoded.reasons[0, :600] == int(Reason.CODE_MARGIN)).all()
    assert (decoded.code[0, :600] == -1).all()
    assert np.isnan(decoded.projector_px[0, :600]).all()
    assert (decoded.reasons[1] == 0).all()
    enough = decode_gray_code(patterns, inverses, codes=16, size_px=WIDTH_PX, min_contrast_gray=5)
    assert (enough.reasons == 0).all()


def test_bits_without_contrast_may_be_read_unjudged():
    patterns = frames_of(1280, 11, columns=COLUMNS)
    inverses = frames_of(1280, 11, columns=COLUMNS, inverse=True)
    patterns[10][0] = inverses[10][0] = 60
    arguments: dict[str, Any] = {"codes": 1280, "size_px": WIDTH_PX}
    judged = decode_gray_code(patterns, inverses, **arguments)
    assert (judged.reasons[0] == int(Reason.CODE_MARGIN)).all()
    unjudged = decode_gray_code(patterns, inverses, unjudged_low_bits=1, **arguments)
    assert (unjudged.reasons == 0).all()
    assert (unjudged.contrast_gray == 100).all()
    assert (unjudged.code[1] == COLUMNS[1]).all()
    assert np.abs(unjudged.code[0] - COLUMNS[0]).max() == 1


def test_one_weak_bit_may_be_spared_and_two_may_not():
    patterns = frames_of(16, 4, columns=COLUMNS)
    inverses = frames_of(16, 4, columns=COLUMNS, inverse=True)
    patterns[2][0] = inverses[2][0] = 70
    arguments: dict[str, Any] = {"codes": 16, "size_px": WIDTH_PX}
    spared = decode_gray_code(patterns, inverses, spared_bits=1, **arguments)
    assert (spared.reasons == 0).all()
    assert (spared.contrast_gray == 100).all()
    patterns[0][0] = inverses[0][0] = 70
    judged = decode_gray_code(patterns, inverses, spared_bits=1, **arguments)
    assert (judged.reasons[0] == int(Reason.CODE_MARGIN)).all()
    assert (judged.reasons[1] == 0).all()
    with pytest.raises(CodeError, match="give 0 or 1"):
        decode_gray_code(patterns, inverses, spared_bits=2, **arguments)


def test_maps_are_reused_when_given_and_have_to_fit():
    patterns = frames_of(16, 4, columns=COLUMNS)
    inverses = frames_of(16, 4, columns=COLUMNS, inverse=True)
    arguments: dict[str, Any] = {"codes": 16, "size_px": WIDTH_PX}
    first = decode_gray_code(patterns, inverses, **arguments)
    expected = first.code.copy()
    first.code[:] = 99
    assert decode_gray_code(patterns, inverses, out=first, **arguments) is first
    assert (first.code == expected).all()
    turned = [[np.ascontiguousarray(frame.T) for frame in part] for part in (patterns, inverses)]
    with pytest.raises(FrameError, match="give maps of this size"):
        decode_gray_code(*turned, out=first, **arguments)


def test_codes_beyond_the_projector_are_outside():
    columns = np.arange(WIDTH_PX).reshape(1, -1)
    # Shown for 2048 codes, read as 1280: what lies beyond can only be a mistake.
    patterns = frames_of(2048, 11, columns=columns)
    inverses = frames_of(2048, 11, columns=columns, inverse=True)
    decoded = decode_gray_code(patterns, inverses, codes=1280, size_px=WIDTH_PX)
    shown = (2 * columns + 1) * 2048 // (2 * WIDTH_PX)
    assert (decoded.reasons == np.where(shown >= 1280, int(Reason.OUTSIDE_PROJECTOR), 0)).all()
    assert (decoded.code[shown < 1280] == shown[shown < 1280]).all()


def test_a_pixel_bright_in_pattern_and_inverse_is_saturated():
    patterns = frames_of(16, 4, columns=COLUMNS)
    inverses = frames_of(16, 4, columns=COLUMNS, inverse=True)
    patterns[1][0, 3] = inverses[1][0, 3] = 255
    decoded = decode_gray_code(patterns, inverses, codes=16, size_px=WIDTH_PX, saturation_gray=254)
    assert decoded.reasons[0, 3] & Reason.SATURATED
    decoded.reasons[0, 3] = 0
    assert (decoded.reasons == 0).all()


def test_references_work_per_pixel_and_a_threshold_does_not():
    rng = np.random.default_rng(5)
    albedo = rng.uniform(0.2, 1.0, COLUMNS.shape)
    patterns = [
        (albedo * f).astype(np.uint8)
        for f in frames_of(1280, 11, columns=COLUMNS, low=10, high=220)
    ]
    white = (albedo * 220).astype(np.uint8)
    black = (albedo * 10).astype(np.uint8)
    by_reference = decode_gray_code_by_reference(
        patterns, white=white, black=black, codes=1280, size_px=WIDTH_PX
    )
    assert (by_reference.code == COLUMNS).all()
    # Twice the distance from the middle is the contrast of white and black.
    assert (by_reference.contrast_gray == white.astype(int) - black).all()
    by_threshold = decode_gray_code_by_threshold(
        patterns, threshold_gray=110, codes=2048, size_px=WIDTH_PX
    )
    right = by_threshold.code == COLUMNS
    assert right[albedo > 0.51].all()
    assert right[albedo < 0.49].mean() < 0.05


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"codes": 17}, CodeError, "17 codes don't fit into 4 bits"),
        ({"codes": 0}, CodeError, "0 codes"),
        (
            {
                "patterns": [np.zeros((2, 3), np.uint8)] * 17,
                "inverses": [np.zeros((2, 3), np.uint8)] * 17,
            },
            CodeError,
            "at most 16 bits",
        ),
        ({"ignored_low_bits": 4}, CodeError, "leaves none to read"),
        ({"ignored_low_bits": 1, "unjudged_low_bits": 3}, CodeError, "leaves none to judge"),
        ({"inverses": [np.zeros((2, 3), np.uint8)] * 3}, FrameError, "4 patterns but 3 inverses"),
    ],
    ids=[
        "too-many-codes",
        "no-codes",
        "too-many-bits",
        "no-bits",
        "no-judged-bits",
        "inverse-missing",
    ],
)
def test_codes_that_do_not_fit_are_refused(change, error, message):
    arguments: dict[str, Any] = {
        "patterns": [np.zeros((2, 3), np.uint8)] * 4,
        "inverses": [np.zeros((2, 3), np.uint8)] * 4,
        "codes": 16,
        "size_px": 16,
        **change,
    }
    with pytest.raises(error, match=message):
        decode_gray_code(arguments.pop("patterns"), arguments.pop("inverses"), **arguments)


def test_camera_pixels_that_see_one_projector_pixel_are_averaged():
    columns = np.array([[5, 5, -1, 2], [5, 7, 2, 2]], dtype=np.int32)
    rows = np.array([[1, 1, 0, 0], [1, -1, 0, 3]], dtype=np.int32)
    seen = distinct_projector_pixels(columns, rows, width_px=8, height_px=4)
    assert seen.projector_px.tolist() == [[2, 0], [5, 1], [2, 3]]
    assert np.allclose(seen.camera_px, np.array([[2.5, 0.5], [1 / 3, 1 / 3], [3.0, 1.0]]))
    assert seen.n_camera_px.tolist() == [2, 3, 1]
    assert np.allclose(seen.spread_px, [np.sqrt(0.5), 2 / 3, 0])


def test_codes_off_the_projector_are_refused():
    columns = np.array([[8]], dtype=np.int32)
    with pytest.raises(CodeError, match="column 8"):
        distinct_projector_pixels(columns, np.zeros_like(columns), width_px=8, height_px=4)


def test_nothing_seen_gives_nothing():
    none = np.full((3, 4), -1, np.int32)
    seen = distinct_projector_pixels(none, none, width_px=8, height_px=4)
    assert seen.projector_px.shape == (0, 2)
