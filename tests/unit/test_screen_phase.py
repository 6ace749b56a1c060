"""Fringes of a reflection: phase, coarse-to-fine positions, and what can't be unwrapped."""

import numpy as np
import pytest

from backend.numerics.errors import FrequencyError
from backend.numerics.screen_phase import check_periods, phase_ripple_rad, screen_position
from backend.numerics.sine_code import SineCode

SHARE = np.linspace(0.001, 0.999, 3000).reshape(30, 100)


def fringes(code, share=SHARE, *, low=20.0, high=230.0, dtype=np.uint8, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    middle, swing = (low + high) / 2, (high - low) / 2
    frames = []
    for periods, shifts in zip(code.periods, code.shifts_rad, strict=True):
        for shift in shifts:
            gray = middle + swing * np.cos(2 * np.pi * periods * share + shift)
            frames.append(np.rint(gray + noise * rng.standard_normal(share.shape)).astype(dtype))
    return frames


@pytest.mark.parametrize("steps", [3, 4, 8, 12])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    "periods", [(0.9,), (0.9, 4, 16, 64), (0.9, 3.9, 15.9, 63.9), (1.0, 5.5, 30.25)]
)
def test_positions_are_found_from_coarse_to_fine(periods, steps, direction):
    code = SineCode.equal_steps(periods, steps, direction=direction)
    found = screen_position(fringes(code, dtype=np.uint16, high=60_000.0), code)
    assert np.abs(found.share - SHARE).max() < 2e-5 / periods[-1] + 2e-7
    assert found.residual_cycles.max() < 1e-3
    assert np.allclose(found.modulation, (60_000 - 20) / 2, rtol=1e-4)
    assert np.allclose(found.mean_gray, 30_010, rtol=1e-4)


def test_phases_are_those_of_the_formula_for_four_steps():
    code = SineCode.equal_steps((0.9, 4), 4, direction=-1)
    frames = fringes(code)
    found = screen_position(frames, code)
    i = [f.astype(float) for f in frames[4:]]
    assert np.allclose(found.wrapped_rad[1], np.arctan2(i[1] - i[3], i[0] - i[2]), atol=1e-5)


def test_noise_at_the_screens_edges_does_not_wrap():
    share = np.full((50, 50), 0.002)
    code = SineCode.equal_steps((0.9, 4, 16), 4)
    found = screen_position(fringes(code, share, noise=3.0), code)
    assert np.abs(found.share - 0.002).max() < 0.01


def test_every_period_makes_positions_better():
    errors = []
    for periods in [(0.9,), (0.9, 4), (0.9, 4, 16), (0.9, 4, 16, 64)]:
        code = SineCode.equal_steps(periods, 4)
        found = screen_position(fringes(code, noise=2.0), code)
        errors.append(np.sqrt(np.mean((found.share - SHARE) ** 2)) * periods[-1])
    # The noise of the phase is the same for all, so positions are better by the number of periods.
    assert max(errors) / min(errors) < 1.1


def test_values_linearise_and_say_what_is_not_trusted():
    code = SineCode.equal_steps((0.9, 4), 4)
    straight = fringes(code)
    bent = [np.rint(255 * (f / 255.0) ** 0.5).astype(np.uint8) for f in straight]
    values = 255 * (np.arange(256) / 255.0) ** 2
    raw, read = screen_position(bent, code), screen_position(bent, code, values)
    assert np.abs(read.share - SHARE).max() < 0.3 * np.abs(raw.share - SHARE).max()
    values[bent[0][3, 7]] = np.nan
    assert np.isnan(screen_position(bent, code, values).share[3, 7])


def test_extremes_are_those_of_all_frames():
    code = SineCode.equal_steps((0.9, 4), 4)
    frames = fringes(code)
    frames[5][2, 3] = 255
    frames[6][2, 3] = 0
    found = screen_position(frames, code)
    assert (found.darkest_gray[2, 3], found.brightest_gray[2, 3]) == (0, 255)
    assert np.array_equal(found.brightest_gray, np.max(frames, axis=0))


@pytest.mark.parametrize(
    ("periods", "words"),
    [
        ((), "at least one"),
        ((4.0, 16.0), "the coarsest has 4 periods"),
        ((0.9, 4.0, 4.0), "one count twice"),
    ],
)
def test_periods_that_cannot_be_unwrapped_are_refused(periods, words):
    with pytest.raises(FrequencyError, match=words):
        check_periods(periods)


def test_frames_and_steps_have_to_be_as_many():
    code = SineCode.equal_steps((0.9, 4), 4)
    with pytest.raises(FrequencyError, match="7 frames were given for 8 steps"):
        screen_position(fringes(code)[:7], code)


@pytest.mark.parametrize("steps", [4, 8])
def test_a_ripple_is_measured_to_a_tenth(steps):
    rng = np.random.default_rng(1)
    phase = 2 * np.pi * 16 * SHARE
    wrapped = phase + 0.02 * np.cos(steps * phase + 0.4) + 0.03 * rng.standard_normal(SHARE.shape)
    wrapped[:2] += 1.0  # pixels at an edge
    found = phase_ripple_rad(
        wrapped.astype(np.float32), SHARE.astype(np.float32), periods=16, harmonic=steps
    )
    assert found == pytest.approx(0.02, rel=0.1)


def test_too_few_pixels_have_no_ripple():
    few = np.full((3, 3), np.nan, np.float32)
    assert np.isnan(phase_ripple_rad(few, few, periods=4, harmonic=4))
