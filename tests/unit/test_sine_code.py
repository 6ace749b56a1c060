import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.numerics.errors import FrequencyError
from backend.numerics.sine_code import SineCode, step_fit


@given(
    n_steps=st.integers(3, 16),
    phase_rad=st.floats(-3.14, 3.14),
    modulation=st.floats(0.1, 100.0),
    mean=st.floats(-50.0, 200.0),
    offset_rad=st.floats(-10.0, 10.0),
    direction=st.sampled_from([1, -1]),
)
def test_weights_recover_the_sinusoid(n_steps, phase_rad, modulation, mean, offset_rad, direction):
    shifts_rad = offset_rad + direction * 2 * np.pi * np.arange(n_steps) / n_steps
    frames = mean + modulation * np.cos(phase_rad + shifts_rad)
    cosine, sine, background = step_fit(shifts_rad).weights @ frames
    assert np.allclose(
        [cosine, sine, background],
        [modulation * np.cos(phase_rad), modulation * np.sin(phase_rad), mean],
        atol=1e-8,
    )


def test_noise_gain_of_even_steps_is_two_over_n_and_of_uneven_ones_is_measured():
    assert step_fit(2 * np.pi * np.arange(5) / 5).noise_gain == pytest.approx(2 / 5)
    shifts_rad = np.array([0.0, 0.9, 2.0, 4.4])
    fit = step_fit(shifts_rad)
    rng = np.random.default_rng(3)
    n, sigma, modulation = 200_000, 0.01, 1.0
    phase_rad = rng.uniform(-np.pi, np.pi, n)
    frames = modulation * np.cos(phase_rad + shifts_rad[:, np.newaxis]) + rng.normal(
        0, sigma, (4, n)
    )
    cosine, sine, _ = fit.weights @ frames
    error = np.angle(np.exp(1j * (np.arctan2(sine, cosine) - phase_rad)))
    assert error.var() / (sigma / modulation) ** 2 == pytest.approx(fit.noise_gain, rel=0.02)


@pytest.mark.parametrize(
    "shifts_rad",
    [(), (0.0,), (0.0, 1.0), (0.0, 1.0, 1.0), (0.0, 2 * np.pi, 4 * np.pi), (0.0, 1.0, np.nan)],
)
def test_steps_that_do_not_determine_a_phase_are_refused(shifts_rad):
    with pytest.raises(FrequencyError, match="64 periods"):
        SineCode((64.0,), (shifts_rad,))


@pytest.mark.parametrize("periods", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_frequencies_are_refused(periods):
    with pytest.raises(FrequencyError, match="number > 0"):
        SineCode((periods,), ((0.0, 1.0, 2.0),))


def test_numbers_of_frequencies_and_steps_have_to_agree():
    with pytest.raises(FrequencyError, match="2 frequencies and 1 sets"):
        SineCode((1.0, 2.0), ((0.0, 1.0, 2.0),))
