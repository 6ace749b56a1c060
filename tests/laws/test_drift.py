"""A smooth drift of the calibration is recognised, and what single parts do isn't."""

import numpy as np
import pytest

from backend.numerics.drift import take_off_drift


def surface(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[0:height, 0:width]
    return np.asarray(0.4 - 0.8 * x / width + 0.5 * (y / height) ** 2, np.float32)


def drift_of(deviation: np.ndarray) -> np.ndarray:
    left = deviation.copy()
    take_off_drift(left)
    drift: np.ndarray = deviation - left
    return drift


@pytest.mark.parametrize("missing", [0.0, 0.5])
def test_a_quadratic_surface_is_found_through_noise_and_holes(missing):
    rng = np.random.default_rng(3)
    truth = surface(320, 416)
    deviation = truth + rng.normal(0, 0.05, truth.shape).astype(np.float32)
    deviation[rng.random(truth.shape) < missing] = np.nan
    assert np.abs(drift_of(deviation) - truth)[np.isfinite(deviation)].max() < 0.02


def test_a_part_that_is_wrong_as_a_whole_has_no_say():
    truth = surface(320, 416)
    deviation = truth.copy()
    deviation[96:288, 0:160] += 5.0
    assert np.abs(drift_of(deviation) - truth).max() < 0.1


def test_too_little_is_no_drift():
    deviation = np.full((64, 64), np.nan, np.float32)
    deviation[:40, :40] = 3.0
    assert not np.nan_to_num(drift_of(deviation)).any()
