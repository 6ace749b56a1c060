import numpy as np
import pytest

from backend.numerics.errors import NumericsError
from backend.numerics.uncertainty import NoiseModel, lattice_failure_bound, position_bound


def test_noise_adds_read_photon_and_rounding_variance():
    noise = NoiseModel(read_gray=0.5, gray_per_e=1 / 60, black_gray=8.0)
    sigma = noise.sigma_gray(np.array([0.0, 8.0, 128.0]))
    dark = 0.25 + 1 / 12
    assert sigma**2 == pytest.approx([dark, dark, dark + 120 / 60])


def test_gain_multiplies_read_noise_and_gray_levels_per_electron():
    facts = {"read_noise_e": 12.0, "full_well_e": 15300.0, "full_scale_gray": 255.0}
    low = NoiseModel.of_camera(**facts)
    high = NoiseModel.of_camera(**facts, gain_db=20.0)
    assert high.read_gray == pytest.approx(10 * low.read_gray)
    assert high.gray_per_e == pytest.approx(10 * low.gray_per_e)


@pytest.mark.parametrize(
    ("make", "value"),
    [
        (lambda: NoiseModel(read_gray=-1.0, gray_per_e=0.0), "-1"),
        (lambda: NoiseModel(read_gray=1.0, gray_per_e=float("nan")), "nan"),
        (
            lambda: NoiseModel.of_camera(read_noise_e=1.0, full_well_e=0.0, full_scale_gray=255.0),
            "full well of 0",
        ),
    ],
)
def test_what_is_no_noise_is_refused(make, value):
    with pytest.raises(NumericsError, match=value):
        make()


def test_bounds_scale_as_their_formulas_say():
    one = position_bound(sigma_gray=1.0, modulation_gray=50.0, n_steps=4, periods=[64])
    assert one == pytest.approx(np.sqrt(0.5) / 50 / (2 * np.pi * 64))
    three = position_bound(sigma_gray=1.0, modulation_gray=50.0, n_steps=4, periods=[64, 64, 64])
    assert three == pytest.approx(one / np.sqrt(3))
    # Five standard deviations, six neighbours: the tail of a normal distribution.
    assert lattice_failure_bound(np.pi * 0.1 / 5, 0.1) == pytest.approx(6 * 2.8665e-7, rel=1e-3)
