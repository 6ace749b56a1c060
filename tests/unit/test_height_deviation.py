"""What a wrong height costs in projector pixels: against the formula of a parallel rig, and by its laws."""

import numpy as np
import pytest

from backend.numerics.camera_model import Pinhole, RigidTransform, project, rays
from backend.numerics.errors import CalibrationError
from backend.numerics.height_deviation import (
    Plane,
    dilation_px,
    facing_plane,
    height_deviation,
    plane_of_homography,
)
from tests import surfaces

TABLE = Plane(np.array([0.0, 0.0, 700.0]), np.array([0.0, 0.0, -1.0]))


def device(width_px: int, height_px: int, focal: float) -> Pinhole:
    K = np.array([[focal, 0, (width_px - 1) / 2], [0, focal, (height_px - 1) / 2], [0, 0, 1.0]])
    return Pinhole(K, np.zeros(5), width_px, height_px)


CAMERA, PROJECTOR = device(640, 480, 1216.0), device(1024, 768, 1792.0)
BESIDE = RigidTransform(np.eye(3), np.array([-100.0, 0.0, 0.0]))


def test_a_parallel_rig_follows_its_formula():
    heights = np.array([1.0, 5.0, 20.0, -20.0])
    found = height_deviation(heights, CAMERA, PROJECTOR, BESIDE, TABLE)
    expected = 1792.0 * 100.0 * np.abs(heights) / (700.0 * (700.0 - heights))
    np.testing.assert_allclose(found.median_px, expected, rtol=1e-9)
    np.testing.assert_allclose(found.largest_px, expected, rtol=1e-9)


def test_no_error_costs_nothing_and_more_costs_more():
    camera, projector = surfaces.camera(), surfaces.projector()
    pose = surfaces.PROJECTOR
    plane = facing_plane(camera, projector, pose)
    found = height_deviation(np.array([0.0, 5, 10, 20, 40]), camera, projector, pose, plane)
    assert found.median_px[0] < 1e-9
    assert (np.diff(found.median_px) > 0).all()
    assert (found.largest_px >= found.median_px).all()


def test_the_dilation_covers_both_sides():
    # 20 mm up cost 1792 * 100 * 20 / (700 * 680) = 7.53 px, 20 mm down less
    assert dilation_px(20.0, CAMERA, PROJECTOR, BESIDE, TABLE) == 8
    assert dilation_px(0.0, CAMERA, PROJECTOR, BESIDE, TABLE) == 1


def test_a_table_behind_the_camera_is_refused():
    behind = Plane(np.array([0.0, 0.0, -700.0]), np.array([0.0, 0.0, 1.0]))
    with pytest.raises(CalibrationError, match="table"):
        height_deviation(np.array([1.0]), CAMERA, PROJECTOR, BESIDE, behind)
    with pytest.raises(CalibrationError, match="range of heights"):
        dilation_px(800.0, CAMERA, PROJECTOR, BESIDE, TABLE)


def test_the_facing_plane_stands_where_the_axes_meet():
    camera, projector = device(640, 480, 1216.0), device(1024, 768, 1792.0)
    pose = surfaces.looking_from(120, -40, target_mm=650)
    plane = facing_plane(camera, projector, pose)
    assert plane.point_mm[2] == pytest.approx(650, abs=1e-6)
    parallel = RigidTransform(np.eye(3), np.array([-100.0, 0.0, 0.0]))
    with pytest.raises(CalibrationError, match="don't meet"):
        facing_plane(camera, projector, parallel)


def test_the_plane_of_a_homography_is_the_table():
    normal = np.array([0.1, -0.2, -1.0]) / np.linalg.norm([0.1, -0.2, -1.0])
    table = Plane(np.array([0.0, 0.0, 720.0]), normal)
    pixels = np.array([[100.0, 100], [500, 90], [520, 400], [90, 380]])
    directions = np.column_stack([rays(pixels, CAMERA), np.ones(4)])
    points = directions * ((table.point_mm @ normal) / (directions @ normal))[:, None]
    places = project(points, PROJECTOR, BESIDE)
    found = plane_of_homography(_homography(pixels, places), CAMERA, PROJECTOR, BESIDE)
    np.testing.assert_allclose(found.normal, normal, atol=1e-6)
    assert (found.point_mm - table.point_mm) @ normal == pytest.approx(0, abs=1e-5)


def test_a_homography_into_the_dark_is_refused():
    away = np.array([[1.0, 0, 1e6], [0, 1, 0], [0, 0, 1]])
    with pytest.raises(CalibrationError, match="calibrate the table again"):
        plane_of_homography(away, CAMERA, PROJECTOR, BESIDE)


def _homography(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    return np.asarray(np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3))
