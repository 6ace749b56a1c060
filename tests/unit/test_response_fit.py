"""The line of each pixel's response."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.numerics.errors import FrameError
from backend.numerics.response_fit import fit_response, light_of_code


def frames_of(gain, offset, light, *, full=255):
    return [
        np.clip(np.rint(gain * p + offset), 0, full).astype(np.uint8 if full < 256 else np.uint16)
        for p in light
    ]


@given(
    gain=st.floats(0.05, 12.0),
    offset=st.floats(0.0, 20.0),
    light=st.lists(st.integers(1, 255), min_size=2, max_size=8, unique=True),
)
def test_the_line_goes_through_what_isnt_saturated(gain, offset, light):
    light = np.array(sorted([0, *light]), np.float64)
    frames = frames_of(np.full((2, 3), gain), offset, light)
    fit = fit_response(frames, light, saturation_gray=254)
    usable = [i for i, frame in enumerate(frames) if frame[0, 0] < 254]
    assert fit.samples[0, 0] == len(usable)
    if len(usable) < 2:
        assert np.isnan(fit.gain).all()
        return
    span = light[usable[-1]] - light[usable[0]]
    assert fit.gain[0, 0] == pytest.approx(gain, abs=1.01 / span + 1e-3)
    predicted = fit.gain[0, 0] * light[usable] + fit.offset_gray[0, 0]
    measured = [frames[i][0, 0] for i in usable]
    assert np.abs(predicted - measured).max() < 1.0


def test_the_residual_is_that_of_the_samples_about_the_line():
    frames = [np.full((1, 1), gray, np.uint8) for gray in (10, 32, 50)]
    fit = fit_response(frames, np.array([0.0, 10.0, 20.0]), saturation_gray=255)
    line = np.polyfit([0, 10, 20], [10, 32, 50], 1)
    expected = np.sqrt(np.mean((np.polyval(line, [0, 10, 20]) - [10, 32, 50]) ** 2))
    assert fit.residual_gray.item() == pytest.approx(expected, abs=1e-3)


def test_twelve_bits_are_exact_enough():
    light = np.array([0.0, 3.0, 50.0, 255.0])
    frames = frames_of(np.full((1, 1), 15.9), 64.0, light, full=4095)
    fit = fit_response(frames, light, saturation_gray=4094)
    assert fit.gain.item() == pytest.approx(15.9, rel=1e-3)


def test_a_pixel_with_one_sample_has_no_response():
    frames = [np.full((1, 1), gray, np.uint8) for gray in (10, 255, 255)]
    fit = fit_response(frames, np.array([0.0, 50.0, 100.0]), saturation_gray=255)
    assert np.isnan([fit.gain.item(), fit.offset_gray.item(), fit.residual_gray.item()]).all()


@pytest.mark.parametrize(
    ("frames", "light"),
    [
        ([np.zeros((1, 1), np.uint8)] * 2, np.array([50.0, 50.0])),
        ([np.zeros((1, 1), np.uint8)] * 2, np.array([50.0])),
        ([np.zeros((1, 1), np.uint8), np.zeros((2, 1), np.uint8)], np.array([0.0, 50.0])),
    ],
    ids=["one brightness", "numbers differ", "sizes differ"],
)
def test_fields_that_tell_nothing_are_refused(frames, light):
    with pytest.raises(FrameError):
        fit_response(frames, light, saturation_gray=255)


def test_gamma_turns_codes_into_light():
    assert light_of_code([0.0, 127.5, 255.0], 2.0).tolist() == [0.0, 63.75, 255.0]
