"""Edges of stripes: the paper's worked numbers, laws of gain and offset, and gaps that are too bright."""

import numpy as np
import pytest

from backend.numerics.edges import (
    bridge_saturated,
    decode_bridged_gray_code,
    extrapolated_edge,
    interpolated_edge,
)
from backend.numerics.errors import CodeError, FrameError
from backend.numerics.patterns import gray_code_pattern


def numbers(*values):
    return [np.array([value], np.float64) for value in values]


@pytest.mark.parametrize(
    ("left_px", "left", "right", "expected"),
    [
        (899, (61, 34), (29, 64), 899.4),
        (899, (80, 28), (25, 62), 899.6),
        (1293, (133, 80), (83, 141), 1293.5),
    ],
    ids=["figure 16", "figure 18", "figure 19"],
)
def test_interpolation_gives_the_papers_numbers(left_px, left, right, expected):
    edge = interpolated_edge(*numbers(left_px, left[0], right[0], left[1], right[1]))
    assert round(edge.item(), 1) == expected


def test_extrapolation_gives_the_papers_number():
    edge = extrapolated_edge(*numbers(1292, 226, 255, 1294, 255, 155))
    assert edge.item() == pytest.approx(1293.775, abs=1e-3)


def test_gain_and_offset_do_not_move_an_edge():
    rng = np.random.default_rng(1)
    samples = rng.uniform(10, 200, (4, 500))
    left = np.full(500, 7.0)
    plain = interpolated_edge(left, *samples)
    np.testing.assert_allclose(
        interpolated_edge(left, *(0.3 * samples + 40)), plain, rtol=1e-6, atol=1e-6
    )


def test_an_edge_scatters_as_its_slope_and_noise_predict():
    rng = np.random.default_rng(2)
    sigma_gray, n = 1.5, 200_000
    for left, right in ((60.0, -60.0), (20.0, -100.0)):
        middle = np.array([80 + left / 2, 80 + right / 2, 80 - left / 2, 80 - right / 2])
        samples = middle[:, None] + rng.normal(0, sigma_gray, (4, n))
        t = left / (left - right)
        predicted = np.sqrt(2 * ((1 - t) ** 2 + t**2)) * sigma_gray / (left - right)
        assert np.std(interpolated_edge(np.zeros(n), *samples)) == pytest.approx(
            predicted, rel=0.01
        )


def row(*values):
    return np.array([values], np.uint8)


# The white stripe's light spills into the black one: both pictures read 255 from 4 to 7.
PATTERN = row(255, 255, 255, 255, 255, 255, 255, 255, 155, 40, 30)
INVERSE = row(30, 60, 155, 200, 255, 255, 255, 255, 255, 255, 255)


def bridged(pattern=PATTERN, inverse=INVERSE, **settings):
    return bridge_saturated(
        pattern, inverse, **{"min_contrast_gray": 5, "saturation_gray": 255, **settings}
    )


def test_a_saturated_gap_is_split_where_the_lines_meet():
    # 200 + 55 (x - 3) = 255 - 100 (x - 7): x = 5.58
    found = bridged()
    np.testing.assert_array_equal(found.pattern[0], [1] * 6 + [0] * 5)
    np.testing.assert_array_equal(found.inverse[0], [0] * 6 + [1] * 5)
    np.testing.assert_array_equal(np.flatnonzero(found.extrapolated), [4, 5, 6, 7])


def test_the_gap_of_the_inverse_edge_is_split_alike():
    found = bridged(INVERSE, PATTERN)
    np.testing.assert_array_equal(found.inverse[0], [1] * 6 + [0] * 5)


def test_columns_are_bridged_down_the_picture():
    found = bridged(PATTERN.T.copy(), INVERSE.T.copy(), axis="y")
    np.testing.assert_array_equal(found.pattern[:, 0], [1] * 6 + [0] * 5)


def test_a_highlight_within_a_stripe_has_the_stripes_colour():
    found = bridged(row(255, 255, 255, 255), row(40, 255, 255, 40))
    np.testing.assert_array_equal(found.pattern[0], [1, 1, 1, 1])


@pytest.mark.parametrize(
    ("settings", "pattern", "inverse"),
    [
        ({"longest_gap_px": 3}, PATTERN, INVERSE),
        ({}, PATTERN[:, 4:], INVERSE[:, 4:]),
        ({"min_contrast_gray": 100}, PATTERN, INVERSE),
    ],
    ids=["too long", "at the picture's border", "too little contrast beside it"],
)
def test_other_gaps_stay_unknown(settings, pattern, inverse):
    found = bridged(pattern, inverse, **settings)
    assert not found.extrapolated.any()
    assert not found.known[(pattern == 255) & (inverse == 255)].any()


def code_frames(columns, bits, codes, *, spill):
    """Pictures of every bit; at an edge the white stripe's light saturates `spill` px on either side."""
    pairs = []
    for inverse in (False, True):
        frames = []
        for bit in reversed(range(bits)):
            line = gray_code_pattern(
                width_px=codes, height_px=1, bit=bit, bits=bits, codes=codes, inverse=inverse
            )[0][columns].astype(float)
            spread = np.convolve(line, np.ones(2 * spill + 1), mode="same") / (spill - 1)
            frames.append(np.clip(np.round(spread), 0, 255).astype(np.uint8)[None])
        pairs.append(frames)
    return pairs


def test_a_code_is_read_through_saturated_edges():
    columns = np.repeat(np.arange(16), 24)
    patterns, inverses = code_frames(columns, 4, 16, spill=3)
    found = decode_bridged_gray_code(patterns, inverses, codes=16, size_px=16)
    inner = slice(24, -24)
    assert (found.gray.reasons[0, inner] == 0).all()
    assert np.abs(found.gray.code[0] - columns)[inner].max() <= 1
    assert (found.gray.code[0] == columns)[inner].mean() > 0.95
    assert 0 < found.extrapolated.mean() < 0.5


def test_pictures_that_do_not_fit_are_refused():
    with pytest.raises(FrameError, match="one size"):
        bridged(PATTERN, INVERSE[:, :5])
    with pytest.raises(CodeError, match="1 patterns and 0 inverses"):
        decode_bridged_gray_code([PATTERN], [], codes=2, size_px=2)
