"""Phase errors: zero at multiples of pi/4 whatever a memoryless response does, and as large as predicted elsewhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.devices.sim.chains import CHAINS
from backend.numerics.phase_prediction import (
    Fringes,
    ScreenResponse,
    predict_phase_error,
    shown_codes,
    stepped_phase,
)

RAW = np.arange(256.0)


@given(st.lists(st.floats(0.01, 1.0), min_size=16, max_size=16), st.integers(0, 7))
def test_four_steps_have_no_error_at_multiples_of_an_eighth_of_a_period(
    rises: list[float], eighth: int
) -> None:
    """The paper's validation lines lie at such phases."""
    phase = eighth * np.pi / 4
    response = np.cumsum(rises)
    cosine = np.cos(phase + np.arange(4) * np.pi / 2)

    values = np.interp(np.round(cosine, 12), np.linspace(-1, 1, 16), response)

    error = (float(stepped_phase(values)) - phase + np.pi) % (2 * np.pi) - np.pi
    assert abs(error) < 1e-9


@pytest.mark.parametrize("steps", [3, 4, 5, 8, 12])
def test_predicted_noise_of_a_linear_chain_is_the_formula(steps: int) -> None:
    sigma, modulation = 2.0, 100.0
    control = np.linspace(-1, 1, 33)
    response = ScreenResponse(control, 127 + modulation * control, np.full(33, sigma), 255.0)

    predicted = predict_phase_error(response, Fringes(RAW, -1.0, 1.0), steps=steps)

    normal = np.sqrt(2 / steps) * sigma / modulation * np.sqrt(2 / np.pi)
    assert predicted.all_rad == pytest.approx(normal, rel=0.03)
    assert predicted.noise_rad == pytest.approx(normal, rel=0.03)


def test_without_noise_a_straight_table_has_only_the_codes_rounding() -> None:
    control = np.linspace(-1, 1, 33)
    response = ScreenResponse(control, 127 + 100 * control, np.zeros(33), 255.0)

    predicted = predict_phase_error(response, Fringes(RAW, -1.0, 1.0), steps=4)

    assert predicted.shape_rad < 0.003


@pytest.mark.parametrize("letter", ["A", "B", "C", "D", "E"])
@pytest.mark.parametrize("steps", [4, 8])
def test_prediction_and_measurement_agree(letter: str, steps: int) -> None:
    chain, rng = CHAINS[letter], np.random.default_rng(17)
    control = np.linspace(-1, 1, 65)
    fields = chain.gray(np.repeat(chain.luminance(chain.code(control))[:, None], 2000, 1), 1.0, rng)
    shown_at = chain.code(control) / 127.5 - 1
    response = ScreenResponse(shown_at, fields.mean(1), fields.std(1), 255.0)
    fringes = Fringes(RAW, -1.0, 1.0)
    phase = rng.uniform(0, 2 * np.pi, 20_000)
    codes = shown_codes(phase[:, None] + 2 * np.pi * np.arange(steps) / steps, fringes)

    gray = chain.gray(chain.luminance(codes.astype(np.uint8)), 1.0, rng)

    error = (stepped_phase(RAW[gray]) - phase + np.pi) % (2 * np.pi) - np.pi
    predicted = predict_phase_error(response, fringes, steps=steps)
    assert predicted.all_rad == pytest.approx(np.abs(error).mean(), rel=0.08)


def test_the_same_prediction_every_time() -> None:
    control = np.linspace(-1, 1, 17)
    response = ScreenResponse(control, 127 + 100 * control, np.full(17, 1.5), 255.0)

    twice = [predict_phase_error(response, Fringes(RAW, -0.8, 0.9), steps=4) for _ in range(2)]

    assert twice[0] == twice[1]
