import numpy as np
import pytest

from backend.numerics.planning import FringeCoding, phase_information
from backend.numerics.uncertainty import NoiseModel


@pytest.mark.parametrize("rate", [0.2, 1.0, 4.0])
@pytest.mark.parametrize("steps", [4, 5, 8])
def test_predicted_noise_is_what_a_camera_shows(rate, steps):
    """Shot, read and rounding noise of simulated fringes against the formula, within 2 %."""
    noise = NoiseModel(read_gray=0.3, gray_per_e=255 / 15_300, black_gray=6)
    coding, time_ms = FringeCoding(steps=steps), 50.0
    rng = np.random.default_rng(steps)
    truth = rng.uniform(-np.pi, np.pi, 60_000)
    shifts = 2 * np.pi * np.arange(steps)[:, None] / steps
    share = (coding.high_share + coding.low_share) / 2 + (
        coding.high_share - coding.low_share
    ) / 2 * np.cos(truth + shifts)
    electrons = rng.poisson(rate * time_ms * share * 60)
    gray = np.round(6 + electrons / 60 + rng.normal(0, 0.3, electrons.shape))
    phase = np.angle((gray * np.exp(-1j * shifts)).sum(axis=0))
    error = np.angle(np.exp(1j * (phase - truth)))
    information = phase_information(np.array([rate]), np.array([time_ms]), noise, coding)
    assert information.shape == (1, 1)
    assert np.std(error) * np.sqrt(information[0, 0]) == pytest.approx(1, abs=0.02)
