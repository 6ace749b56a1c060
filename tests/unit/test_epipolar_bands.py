"""Epipolar lines are the same seen from camera and projector; bands tell which of them are lit."""

import numpy as np
import pytest

from backend.numerics.camera_model import compose, inverse
from backend.numerics.epipolar_bands import (
    Bands,
    bands_around,
    epipolar_lines,
    nothing_yet,
    take_in,
)
from backend.numerics.errors import CalibrationError
from tests import surfaces


@pytest.mark.parametrize("pose", [surfaces.LEFT, surfaces.RIGHT])
@pytest.mark.parametrize("surface", [surfaces.plane, surfaces.sphere])
def test_a_camera_pixel_and_its_light_lie_on_the_same_line(pose, surface):
    camera, projector = surfaces.camera(), surfaces.projector()
    projector_from_camera = compose(surfaces.PROJECTOR, inverse(pose))
    lines = epipolar_lines(camera, projector, projector_from_camera)
    seen = surfaces.view(surface, camera, pose)
    lit = np.isfinite(seen.u_px) & (seen.u_px > 1) & (seen.v_px > 1)
    lit &= (seen.u_px < 1278) & (seen.v_px < 798)
    u, v = seen.u_px[lit], seen.v_px[lit]
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    right, low = u - left, v - top
    table = lines.projector_px
    found = (1 - low) * ((1 - right) * table[top, left] + right * table[top, left + 1])
    found += low * ((1 - right) * table[top + 1, left] + right * table[top + 1, left + 1])
    np.testing.assert_allclose(found, lines.camera_px[lit], atol=0.01)


def test_neighbouring_rows_are_about_a_pixel_apart():
    pose = compose(surfaces.PROJECTOR, inverse(surfaces.LEFT))
    lines = epipolar_lines(surfaces.camera(), surfaces.projector(), pose)
    step = np.abs(np.diff(lines.projector_px, axis=0))
    assert np.median(step) == pytest.approx(1.0, rel=0.05)


def test_a_camera_above_the_projector_is_refused():
    above = surfaces.looking_from(0, 100)
    with pytest.raises(CalibrationError, match="above each other"):
        epipolar_lines(surfaces.camera(), surfaces.projector(), above)


def test_any_two_bands_are_lit_apart_by_some_bit_and_borders_by_one_only():
    bands = Bands(-100.0, 25.0, 4)
    middles = (-100 + 25 * (np.arange(16) + 0.5)).astype(np.float32)
    lit = np.array([bands.lit(middles, bit, inverse=False) for bit in range(4)])
    assert len({tuple(column) for column in lit.T}) == 16
    assert (np.abs(np.diff(lit.astype(int), axis=1)).sum(axis=0) == 1).all()
    for bit in range(4):
        dark = bands.lit(middles, bit, inverse=True)
        assert (dark == ~lit[bit]).all()


def test_a_margin_leaves_out_what_is_near_a_border():
    bands = Bands(0.0, 10.0, 1)
    lines = np.array([8.0, 9.5, 10.5, 12.0, np.nan], np.float32)
    well = bands.well_lit(lines, 0, inverse=False, margin_px=1.0)
    assert well[:4].tolist() == [False, False, False, True]


def test_bands_hold_the_lines_they_were_made_for():
    lines = np.random.default_rng(1).normal(50, 20, 5000).astype(np.float32)
    bands = bands_around(lines, 3)
    assert bands.low_px < np.percentile(lines, 0.5)
    assert bands.low_px + 8 * bands.width_px > np.percentile(lines, 99.5)
    with pytest.raises(CalibrationError, match="has an epipolar line"):
        bands_around(np.full(5, np.nan, np.float32), 3)


def full(value: float) -> np.ndarray:
    return np.full((1, 2), value, np.float32)


def test_the_darkest_measurement_wins_and_equal_ones_are_averaged():
    best = nothing_yet((1, 2))
    serves = np.array([[True, False]])
    take_in(best, full(10.3), full(0.1), full(2.0), serves)
    take_in(best, full(12.0), full(0.1), full(1.0), serves)  # less light: the other was mixed
    take_in(best, full(12.1), full(0.1), full(1.01), serves)  # as dark, and agrees
    take_in(best, full(13.0), full(0.1), full(1.01), serves)  # as dark, and contradicts
    take_in(best, full(9.0), full(0.1), full(1.5), serves)
    assert best.projector_px[0, 0] == pytest.approx(12.05, abs=1e-5)
    assert best.sigma_px[0, 0] == pytest.approx(0.1 / np.sqrt(2), rel=1e-5)
    assert np.isnan(best.projector_px[0, 1])


def test_averaging_lowers_the_noise_as_predicted():
    rng = np.random.default_rng(4)
    best = nothing_yet((100, 100))
    for _ in range(4):
        noisy = rng.normal(100, 0.1, (100, 100)).astype(np.float32)
        light = rng.normal(1.0, 0.005, (100, 100)).astype(np.float32)
        sigma = np.full((100, 100), 0.1, np.float32)
        take_in(best, noisy, sigma, light, np.ones((100, 100), bool))
    assert best.projector_px.std() == pytest.approx(0.05, rel=0.1)
    assert best.sigma_px.mean() == pytest.approx(0.05, rel=0.05)
