"""Scattered correspondences: points come back where they were, and rows tell what doesn't fit."""

import numpy as np
import pytest

from backend.numerics.camera_model import project
from backend.numerics.code_points import triangulate_code
from backend.numerics.errors import CalibrationError
from tests.unit import procam


@pytest.fixture
def truth():
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-100, 100, (500, 2)), rng.uniform(500, 700, 500)])
    return points


def positions(points):
    camera, projector, pose = procam.devices()
    return project(points, camera), project(points, projector, pose)


def test_points_come_back_where_they_were(truth):
    camera_px, projector_px = positions(truth)
    result = triangulate_code(camera_px, projector_px, *procam.devices())
    np.testing.assert_allclose(result.points_mm, truth, atol=1e-6)
    np.testing.assert_allclose(result.row_residual_px, 0, atol=1e-8)


def test_a_wrong_row_shows_in_the_residual_and_hardly_in_the_point(truth):
    camera_px, projector_px = positions(truth)
    result = triangulate_code(camera_px, projector_px + np.array([0, 5]), *procam.devices())
    np.testing.assert_allclose(result.row_residual_px, -5, atol=0.1)
    assert np.abs(result.points_mm - truth).max() < 1.0


def test_sigma_is_how_far_a_point_moves_per_column(truth):
    camera_px, projector_px = positions(truth)
    step_px = 0.01
    before = triangulate_code(camera_px, projector_px, *procam.devices())
    after = triangulate_code(camera_px, projector_px + np.array([step_px, 0]), *procam.devices())
    moved = np.linalg.norm(after.points_mm - before.points_mm, axis=1) / step_px
    np.testing.assert_allclose(before.sigma_per_px_mm, moved, rtol=0.05)


def test_rays_that_do_not_meet_in_front_have_no_point():
    camera, projector, pose = procam.devices()
    crossed = np.array([[0.0, 60.0]]), np.array([[127.0, 48.0]])
    result = triangulate_code(*crossed, camera, projector, pose)
    assert np.isnan(result.points_mm).all()


def test_a_singular_camera_is_refused(truth):
    camera, projector, pose = procam.devices()
    camera_px, projector_px = positions(truth)
    broken = camera._replace(K=np.zeros((3, 3)))
    with pytest.raises(CalibrationError, match="focal lengths"):
        triangulate_code(camera_px, projector_px, broken, projector, pose)
