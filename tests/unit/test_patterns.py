import numpy as np
import pytest

from backend.numerics.errors import PatternError
from backend.numerics.patterns import (
    gray_code_pattern,
    pattern_coordinate,
    sine_pattern,
    stripe_pattern,
    uniform_pattern,
)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("periods", [1, 64, 42.667])
def test_fringes_are_the_formula_rounded_once(axis, periods):
    pattern = sine_pattern(
        width_px=96, height_px=60, axis=axis, periods=periods, shift_rad=0.7, offset_rad=0.2
    )
    n_px = 96 if axis == "x" else 60
    x = (np.arange(n_px) + 0.5) / n_px
    exact = 130 + 90 * np.cos(2 * np.pi * periods * x + 0.9)
    line = pattern[0] if axis == "x" else pattern[:, 0]
    assert pattern.shape == (60, 96)
    assert pattern.dtype == np.uint8
    assert np.abs(line - exact).max() <= 0.5 + 1e-9
    assert (pattern == (line[np.newaxis, :] if axis == "x" else line[:, np.newaxis])).all()


@pytest.mark.parametrize("gamma", [0.5, 2.2])
def test_with_the_gamma_inverted_the_light_is_a_sinusoid_between_the_same_ends(gamma):
    width_px = 1000
    pattern = sine_pattern(
        width_px=width_px,
        height_px=1,
        periods=3,
        shift_rad=0.0,
        low_gray=20,
        high_gray=240,
        gamma=gamma,
    )
    light = (pattern[0] / 255.0) ** gamma
    x = (np.arange(width_px) + 0.5) / width_px
    design = np.stack([np.ones(width_px), np.cos(6 * np.pi * x), np.sin(6 * np.pi * x)], axis=1)
    fit, *_ = np.linalg.lstsq(design, light, rcond=None)
    # The slope of the light's curve turns half a gray of rounding into this much light.
    tolerance = 0.5 / 255 * gamma * max(1.0, (20 / 255) ** (gamma - 1)) + 1e-9
    assert np.abs(design @ fit - light).max() < 1.1 * tolerance
    assert (pattern.min(), pattern.max()) == (20, 240)


@pytest.mark.parametrize(("codes", "bits"), [(16, 4), (1280, 11), (100, 8)])
def test_gray_code_bits_spell_the_code_and_neighbours_differ_in_one_bit(codes, bits):
    width_px = 1280
    planes = np.array(
        [
            gray_code_pattern(width_px=width_px, height_px=1, bit=bit, bits=bits, codes=codes)[0]
            == 255
            for bit in range(bits)
        ]
    )
    gray = (planes * (1 << np.arange(bits))[:, np.newaxis]).sum(axis=0)
    expected = (2 * np.arange(width_px) + 1) * codes // (2 * width_px)
    assert (gray == expected ^ (expected >> 1)).all()
    steps = np.abs(np.diff(planes.astype(int), axis=1)).sum(axis=0)
    assert set(steps) <= {0, 1}


def test_an_inverse_is_the_complement():
    for make in (
        lambda inverse: gray_code_pattern(
            width_px=64, height_px=2, bit=3, bits=6, codes=64, inverse=inverse
        ),
        lambda inverse: stripe_pattern(width_px=64, height_px=2, periods=16, inverse=inverse),
    ):
        assert (make(False).astype(int) + make(True) == 255).all()


@pytest.mark.parametrize("half_period_px", [1, 2, 3, 5])
def test_shifting_stripes_pixel_by_pixel_makes_every_boundary_an_edge_once(half_period_px):
    width_px = 60 * half_period_px
    edges = np.zeros(width_px - 1, int)
    for shift_px in range(half_period_px):
        line = stripe_pattern(
            width_px=width_px,
            height_px=1,
            periods=width_px / (2 * half_period_px),
            shift_periods=shift_px / (2 * half_period_px),
        )[0]
        edges += np.diff(line.astype(int)) != 0
    assert (edges == 1).all()


@pytest.mark.parametrize(
    ("make", "value"),
    [
        (lambda: pattern_coordinate(8, 8, "z"), "'z'"),
        (lambda: sine_pattern(width_px=8, height_px=8, periods=0, shift_rad=0), "0"),
        (
            lambda: sine_pattern(width_px=8, height_px=8, periods=1, shift_rad=0, high_gray=256),
            "256",
        ),
        (lambda: sine_pattern(width_px=8, height_px=8, periods=1, shift_rad=0, gamma=0), "gamma"),
        (lambda: gray_code_pattern(width_px=8, height_px=8, bit=4, bits=4, codes=16), "bit 4"),
        (lambda: gray_code_pattern(width_px=8, height_px=8, bit=0, bits=4, codes=17), "17 codes"),
        (lambda: stripe_pattern(width_px=8, height_px=8, periods=-1), "-1"),
        (lambda: uniform_pattern(width_px=8, height_px=8, gray=256), "256"),
        (lambda: uniform_pattern(width_px=0, height_px=8, gray=1), "0 x 8"),
    ],
)
def test_a_pattern_that_cannot_be_shown_is_refused_with_its_value(make, value):
    with pytest.raises(PatternError, match=value):
        make()
