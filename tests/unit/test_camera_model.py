import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    compose,
    inverse,
    project,
    ray_lattice,
    rays,
)
from backend.numerics.errors import CalibrationError
from tests.surfaces import LEFT, RIGHT, camera

LENSES = {
    "none": (),
    "plain": (-0.12, 0.15, 1e-3, -5e-4, 0.02),
    "rational": (0.3, -0.1, 1e-4, -2e-4, 0.01, 0.35, -0.05, 0.02),
    "thin prism": (-0.1, 0.05, 1e-3, 1e-3, 0.0, 0.01, 0.0, 0.0, 1e-3, -1e-3, 2e-3, 1e-3),
    "tilted": (-0.1, 0.05, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.02, -0.01),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@given(x=st.floats(0, 639), y=st.floats(0, 479), depth=st.floats(100, 5000))
@settings(max_examples=30)
def test_a_point_on_a_pixels_ray_projects_onto_the_pixel(lens, x, y, depth):
    device = camera(lens=lens)
    slopes = rays(np.array([[x, y]]), device)
    back = project(np.column_stack([slopes, [1.0]]) * depth, device)
    assert back[0] == pytest.approx([x, y], abs=1e-6)


@pytest.mark.parametrize("size", [(640, 480), (33, 2), (64, 17), (1283, 961)])
def test_lattice_gives_every_pixels_ray(size):
    device = camera()._replace(width_px=size[0], height_px=size[1])
    grid = ray_lattice(device).map()
    x, y = np.meshgrid(np.arange(0, size[0], 7), np.arange(0, size[1], 5))
    exact = rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(float), device)
    error_px = np.abs(grid[:, y.ravel(), x.ravel()].T - exact) * device.K[0, 0]
    assert grid.dtype == np.float32
    assert grid.shape == (2, size[1], size[0])
    assert error_px.max() < 1e-4


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(project(np.array([[0.0, 0.0, -5.0]]), camera())).all()


def test_poses_compose_and_invert():
    right_from_left = compose(RIGHT, inverse(LEFT))
    point = np.array([12.0, -7.0, 650.0])
    in_left, in_right = LEFT.R @ point + LEFT.t_mm, RIGHT.R @ point + RIGHT.t_mm
    assert right_from_left.R @ in_left + right_from_left.t_mm == pytest.approx(in_right)


GOOD = camera()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (GOOD._replace(K=np.full((3, 3), np.nan)), "left camera holds numbers that aren't finite"),
        (GOOD._replace(distortion=np.array([np.inf] * 5)), "aren't finite"),
        (GOOD._replace(K=np.zeros((3, 3))), "positive focal lengths"),
        (GOOD._replace(K=GOOD.K.T.copy()), "last row 0 0 1"),
        (GOOD._replace(distortion=np.zeros(7)), "7 distortion coefficients"),
        (GOOD._replace(height_px=0), "640x0 px"),
    ],
)
def test_unusable_cameras_are_refused_by_name(changed: Pinhole, message: str):
    with pytest.raises(CalibrationError, match=message):
        check_pinhole(changed, "the left camera")


@pytest.mark.parametrize(
    ("R", "message"),
    [
        (np.ones((3, 3)), "isn't a rotation"),
        (np.full((3, 3), np.nan), "isn't a rotation"),
        (np.diag([1.0, 1, -1]), "mirrors"),
    ],
)
def test_unusable_poses_are_refused(R, message):
    with pytest.raises(CalibrationError, match=message):
        check_transform(RigidTransform(R, np.zeros(3)), "the right camera")


def test_a_lens_that_folds_the_picture_is_refused():
    with pytest.raises(CalibrationError, match="can't be inverted"):
        ray_lattice(camera(lens=(-8.0, 0.0, 0.0, 0.0, 0.0)))
