"""Figures of a measured mirror against the truth: each error shows up in its own figure."""

import numpy as np
import pytest

from backend.numerics.errors import NumericsError
from backend.numerics.mirror_scoring import MirrorTruth, score_mirror
from backend.numerics.pinhole import RigidTransform


@pytest.fixture
def truth() -> MirrorTruth:
    y, x = np.mgrid[-20:21, -30:31].astype(float)
    z = (x**2 + y**2) / 4800
    seen = x**2 + y**2 < 300
    points = np.where(seen[..., None], np.stack([x, y, z], -1), np.nan)
    slopes = np.where(seen, np.stack([x, y]) / 2400, np.nan)
    return MirrorTruth(points, slopes, seen, RigidTransform(np.eye(3), np.zeros(3)))


def test_the_truth_itself_is_perfect(truth):
    figures = score_mirror(truth.slopes, truth.points_mm[..., 2] + 3.0, truth)
    assert figures.base == figures.measured == truth.seen.sum()
    assert figures.slope_rms_urad == 0
    assert figures.height_rms_um == pytest.approx(0, abs=1e-9)
    assert figures.height_mean_um == pytest.approx(3000)


def test_slope_noise_and_slope_bias_are_told_apart(truth):
    rng = np.random.default_rng(2)
    wrong = truth.slopes + 1e-6 * rng.normal(0, 15, truth.slopes.shape)
    wrong[0] += 40e-6
    figures = score_mirror(wrong, truth.points_mm[..., 2], truth)
    assert figures.slope_ripple_urad == pytest.approx(15, rel=0.1)
    assert figures.slope_x_mean_urad == pytest.approx(40, rel=0.1)
    assert figures.slope_rms_urad == pytest.approx(np.sqrt(15**2 + 40**2 / 2), rel=0.1)


def test_a_tilted_height_map_is_only_tilted(truth):
    tilted = truth.points_mm[..., 2] + 1e-5 * truth.points_mm[..., 0]
    figures = score_mirror(truth.slopes, tilted, truth)
    assert figures.height_rms_um > 0.05
    assert figures.height_tilt_free_rms_um == pytest.approx(0, abs=1e-9)


def test_what_isnt_measured_isnt_counted(truth):
    none = np.full(truth.slopes.shape, np.nan)
    figures = score_mirror(none, none[0], truth)
    assert figures.measured == 0
    assert np.isnan(figures.slope_rms_urad)
    assert np.isnan(figures.height_rms_um)


def test_maps_of_another_size_are_refused(truth):
    with pytest.raises(NumericsError, match="same camera"):
        score_mirror(np.zeros((2, 4, 4)), np.zeros((4, 4)), truth)


def test_in_another_frame_the_truth_is_the_same_mirror(truth):
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    turned = truth.in_frame(RigidTransform(turn, np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(turned.normals[truth.seen], truth.normals[truth.seen] @ turn.T)
    back = turned.in_frame(truth.mirror_from_camera)
    np.testing.assert_allclose(back.points_mm[truth.seen], truth.points_mm[truth.seen], atol=1e-12)
    np.testing.assert_allclose(back.slopes, truth.slopes, atol=1e-12)


def test_normals_point_to_the_viewer(truth):
    normals = truth.normals[truth.seen]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert (normals[:, 2] > 0.99).all()
