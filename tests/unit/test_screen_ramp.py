"""Ramps: what is refused, what is left out, and back from gray level to control value."""

import numpy as np
import pytest

from backend.numerics.errors import ResponseError
from backend.numerics.linearisation import (
    interval_of,
    inverse_table,
    predistortion,
    quoted_error,
)
from backend.numerics.screen_ramp import control_of_gray, gray_of_control, monotone_ramp

CONTROL = np.linspace(-1, 1, 33)
GAMMA = 5 + 237 * ((CONTROL + 1) / 2) ** 2.2


REFUSED = {
    "falls": (np.where(CONTROL > 0.5, GAMMA - 40, GAMMA), "isn't monotone"),
    "flat": (np.full(33, 80.0), "0 gray levels|1 gray levels"),
    "clipped": (np.full(33, 255.0), "gray levels that differ"),
    "not finite": (np.where(CONTROL > 0.9, np.nan, GAMMA), "aren't finite"),
}


@pytest.mark.parametrize(("gray", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_ramps_that_tell_nothing_are_refused(gray: np.ndarray, sentence: str) -> None:
    with pytest.raises(ResponseError, match=sentence):
        monotone_ramp(CONTROL, gray)


def test_control_values_out_of_order_are_refused() -> None:
    with pytest.raises(ResponseError, match="aren't increasing"):
        monotone_ramp(CONTROL[::-1], GAMMA)


def test_clipped_and_flat_ends_are_left_out() -> None:
    gray = np.clip(1.3 * GAMMA, 20, 255)

    ramp = monotone_ramp(CONTROL, gray)

    assert ramp.gray_low == pytest.approx(20, abs=0.5)
    assert ramp.gray_high < 255
    assert (np.diff(ramp.gray) > 0).all()


def test_noise_doesnt_make_a_ramp_fall() -> None:
    noisy = GAMMA + np.where(np.arange(33) % 2, 0.1, -0.1)

    assert (np.diff(monotone_ramp(CONTROL, noisy).gray) > 0).all()


def test_there_and_back_again() -> None:
    ramp = monotone_ramp(CONTROL, GAMMA)
    gray = np.arange(30, 240)

    back = gray_of_control(CONTROL, GAMMA, control_of_gray(ramp, 256)[gray])

    np.testing.assert_allclose(back, gray, atol=0.1)


def test_gray_levels_outside_the_ramp_have_no_control_value_but_a_continued_table() -> None:
    ramp = monotone_ramp(CONTROL, GAMMA)
    control, table = control_of_gray(ramp, 256), inverse_table(ramp, 256)

    assert np.isnan(control[[0, 4, 243, 255]]).all()
    assert np.isfinite(table).all()
    assert (np.diff(table) > 0).all()


def test_predistorted_fringes_are_straight() -> None:
    ramp = monotone_ramp(CONTROL, GAMMA)
    within = interval_of(control_of_gray(ramp, 256), 20, 230)

    codes = predistortion(ramp, within, 256)

    gray = gray_of_control(CONTROL, GAMMA, codes / 127.5 - 1)
    assert np.abs(quoted_error(gray, np.linspace(-1, 1, 256))).max() < 0.1
    assert gray[0] == pytest.approx(20, abs=0.2)
    assert gray[-1] == pytest.approx(230, abs=0.2)


@pytest.mark.parametrize(("low", "high"), [(100, 100), (200, 100), (-3, 100), (0, 200), (50, 255)])
def test_intervals_outside_the_ramp_are_refused(low: int, high: int) -> None:
    control = control_of_gray(monotone_ramp(CONTROL, GAMMA), 256)

    with pytest.raises(ResponseError, match="interval"):
        interval_of(control, low, high)
