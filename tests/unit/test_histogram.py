import numpy as np
import pytest

from backend.numerics.errors import HistogramError
from backend.numerics.histogram import (
    dark_level,
    foreground_range,
    pooled_histogram,
    smoothed,
)


def test_dark_level_ignores_hot_pixels():
    black = np.random.default_rng(0).normal(8, 2, (200, 200)).round().astype(np.uint8)
    black[:2] = 255
    dark = dark_level(black)
    assert dark.level_gray == pytest.approx(8, abs=0.5)
    assert dark.sigma_gray == pytest.approx(2, rel=0.6)


def test_dark_level_of_a_noiseless_camera_is_limited_by_rounding():
    assert dark_level(np.full((8, 8), 3, np.uint8)).limit_gray == pytest.approx(
        3 + 3 * 0.2887, abs=1e-3
    )


def test_cameras_are_pooled_without_their_own_background():
    left = np.array([[0, 10, 200]], np.uint8)
    right = np.array([[10, 12], [200, 30]], np.uint8)
    counts = pooled_histogram([left, right], [5.0, 10.0], full_scale_gray=255)
    assert counts[10] == 1
    assert counts[12] == 1
    assert counts[200] == 2
    assert counts.sum() == 5


@pytest.mark.parametrize(
    ("pictures", "limits", "message"),
    [
        ([np.zeros((2, 2), np.uint8)], [3.0], "no pixel is brighter"),
        ([np.full((2, 2), 300, np.uint16)], [3.0], "above full scale 255"),
        ([np.full((2, 2), 30, np.uint8)], [3.0, 4.0], "one level per picture"),
    ],
)
def test_refuses(pictures, limits, message):
    with pytest.raises(HistogramError, match=message):
        pooled_histogram(pictures, limits, full_scale_gray=255)


@pytest.mark.parametrize("full_scale", [255, 4095])
def test_smoothing_keeps_the_pixels_and_has_the_width_of_8_bit_levels(full_scale):
    counts = np.zeros(full_scale + 1)
    counts[full_scale // 2] = 1000
    smooth = smoothed(counts, sigma_gray=3.5)
    gray = np.arange(full_scale + 1) * 255 / full_scale
    mean = np.average(gray, weights=smooth)
    assert smooth.sum() == pytest.approx(1000)
    assert np.sqrt(np.average((gray - mean) ** 2, weights=smooth)) == pytest.approx(3.5, rel=0.01)


def test_smoothing_keeps_pixels_at_the_ends():
    counts = np.zeros(256)
    counts[[0, 255]] = 10
    assert smoothed(counts).sum() == pytest.approx(20)


@pytest.mark.parametrize(("levels", "message"), [([], "is empty"), ([77], "same gray level 77")])
def test_range_needs_two_levels(levels, message):
    counts = np.zeros(256)
    counts[levels] = 5
    with pytest.raises(HistogramError, match=message):
        foreground_range(counts)
