"""Chains from control value to gray level: their table of phase errors, and what a chain may not do."""

import numpy as np
import pytest

from backend.devices.errors import RigConfigError
from backend.devices.sim.chains import CHAINS, FULL_WELL_E, READ_NOISE_E, Chain, measured_curve


def mean_error_mrad(chain: Chain, steps: int, *, noise: bool = True) -> float:
    """Measure the mean |phase error| over all phases, raw gray levels over the full range."""
    rng = np.random.default_rng(7) if noise else None
    phase = np.linspace(-np.pi, np.pi, 40_000, endpoint=False)
    shifts = 2 * np.pi * np.arange(steps) / steps
    control = np.cos(phase[None] + shifts[:, None])
    gray = chain.gray(chain.luminance(chain.code(control)), 1.0, rng).astype(np.float64)
    found = -np.angle(np.tensordot(np.exp(1j * shifts), gray, axes=1))
    return 1000 * float(np.mean(np.abs(np.angle(np.exp(1j * (found - phase))))))


@pytest.mark.parametrize(
    ("letter", "steps", "expected_mrad"),
    [
        *[("B", 4, 8.8), ("C", 4, 21.3), ("D", 4, 78.0), ("E", 4, 77.0), ("F", 4, 104.0)],
        *[("G", 4, 25.6), ("B", 8, 4.5), ("D", 8, 4.7), ("G", 8, 8.0), ("D", 12, 3.8)],
    ],
)
def test_raw_phase_errors_are_the_published_ones(
    letter: str, steps: int, expected_mrad: float
) -> None:
    assert mean_error_mrad(CHAINS[letter], steps) == pytest.approx(expected_mrad, rel=0.07)


def test_a_linear_chain_has_nothing_but_quantisation() -> None:
    assert mean_error_mrad(CHAINS["A"], 4, noise=False) < 4


@pytest.mark.parametrize("letter", CHAINS)
def test_every_chain_rises_and_keeps_its_ends(letter: str) -> None:
    chain = CHAINS[letter]
    luminance = chain.luminance(np.arange(256))
    assert luminance[0] == pytest.approx(chain.black)
    assert luminance[-1] == pytest.approx(1.0)
    gray = chain.gray(luminance, bits=12, quantised=False)
    assert (np.diff(gray) >= 0).all()
    assert 0 < gray[0] < gray[-1] <= 4095


def test_control_values_become_the_nearest_codes() -> None:
    codes = CHAINS["B"].code(np.array([-1.0, -0.5, 0.0, 0.5, 1.0, 1.2, -3.0]))
    np.testing.assert_array_equal(codes, [0, 64, 128, 191, 255, 255, 0])


def test_noise_is_shot_and_read_noise() -> None:
    luminance = np.full(200_000, 0.4)
    chain = CHAINS["A"]
    gray = chain.gray(luminance, 1.0, np.random.default_rng(3), bits=16, quantised=False)
    electrons = gray * FULL_WELL_E / 65535
    mean = FULL_WELL_E * 0.95 * 0.4
    assert electrons.mean() == pytest.approx(mean, rel=1e-3)
    assert electrons.var() == pytest.approx(mean + READ_NOISE_E**2, rel=0.02)


def test_twice_the_exposure_is_twice_the_light_until_it_clips() -> None:
    chain, luminance = CHAINS["B"], np.array([0.1, 0.4])
    once = chain.gray(luminance, 1.0, quantised=False)
    np.testing.assert_allclose(chain.gray(luminance, 2.0, quantised=False), 2 * once)
    assert chain.gray(luminance, 4.0).tolist() == [97, 255]


def test_a_measured_table_passes_through_its_points() -> None:
    curve = measured_curve(np.array([0.0, 0.25, 1.0]), np.array([0.0, 0.1, 1.0]))
    np.testing.assert_allclose(curve(np.array([0.0, 0.125, 0.25, 1.0])), [0.0, 0.05, 0.1, 1.0])


@pytest.mark.parametrize(
    ("codes", "light"),
    [([0.0], [0.0]), ([0.0, 1.0], [1.0, 0.0]), ([0.5, 0.2], [0.0, 1.0]), ([0.0, 1.0], [0.0, 1.1])],
)
def test_a_table_that_is_no_response_is_refused(codes: list[float], light: list[float]) -> None:
    with pytest.raises(RigConfigError, match="table"):
        measured_curve(np.array(codes), np.array(light))
