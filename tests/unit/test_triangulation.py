import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.numerics.camera_model import RigidTransform, compose, inverse, project
from backend.numerics.errors import CalibrationError
from backend.numerics.matching import Matches
from backend.numerics.rectification import rectify
from backend.numerics.triangulation import (
    projector_consistency,
    triangulate_pair,
    triangulate_projector,
)
from tests.surfaces import (
    LEFT,
    PROJECTOR,
    PROJECTOR_LENS,
    camera,
    looking_from,
    plane,
    projector,
    sphere,
    step,
    view,
)

PROJECTOR_FROM_LEFT = compose(PROJECTOR, inverse(LEFT))
THIN_PRISM = (-0.05, 0.02, 5e-4, 2e-4, 0.0, 0.01, 0.005, -0.01, 1e-3, -1e-3, 2e-3, 1e-3)


@pytest.mark.parametrize("surface", [plane, sphere, step])
@pytest.mark.parametrize("lens", [(), PROJECTOR_LENS, THIN_PRISM, (-0.25, 0.1, 0, 0, 0)])
@pytest.mark.parametrize("rows", [False, True])
def test_points_come_back_from_camera_and_projector(surface, lens, rows):
    light = projector(lens)
    above = looking_from(-20, -150) if rows else PROJECTOR
    seen = view(surface, camera(), LEFT, light=light, light_pose=above)
    measured = (seen.v_px if rows else seen.u_px).astype(np.float32)
    pose = compose(above, inverse(LEFT))
    cloud = triangulate_projector(measured, camera(), light, pose, rows=rows)
    error = np.linalg.norm(cloud.points_mm - seen.points_mm, axis=2)
    assert (np.isfinite(error) == np.isfinite(measured)).all()
    assert np.nanmax(error) < 1e-3  # rounding of the float32 coordinate


@given(
    x=st.floats(-300, 300),
    y=st.floats(-200, 200),
    z=st.floats(300, 3000),
    swap=st.booleans(),
    base=st.floats(40, 400),
    roll=st.floats(-1.6, 1.6),
)
@settings(max_examples=60, deadline=None)
def test_any_point_comes_back_from_two_rectified_columns(x, y, z, swap, base, roll):
    pose = looking_from(-base if swap else base, 20, roll_rad=roll, target_mm=2000)
    device = camera(96, 64, lens=())
    pair = rectify(device, device, pose)
    focal, turn = pair.focal_px, pair.rectified_from_reference
    ref = pair.rectified_of_reference.map()
    pixel = project(np.array([[x, y, z]]), device)[0]
    column, row = np.round(pixel).astype(int)
    if not (0 <= column < 96 and 0 <= row < 64):
        return
    # the point at this depth exactly on the pixel's ray
    ray = np.array(
        [(column - device.K[0, 2]) / device.K[0, 0], (row - device.K[1, 2]) / device.K[1, 1], 1]
    )
    point = z * ray
    in_plane = turn @ (point - inverse(pose).t_mm)
    other = np.full(ref.shape[1:], np.nan, np.float32)
    other[row, column] = focal * in_plane[0] / in_plane[2]
    nothing = np.full_like(other, 0.1)
    cloud = triangulate_pair(Matches(other, nothing, np.zeros(other.shape, np.uint16)), pair)
    # float32 rectified columns, seen through the depth's sensitivity
    tolerance = 3e-4 * z * z / (focal * base) + 1e-3
    assert cloud.points_mm[row, column] == pytest.approx(point, abs=tolerance)
    along = (
        in_plane[2] ** 2
        / (focal * abs(pair.baseline_mm))
        * 0.1
        * np.linalg.norm(ray)
        * z
        / in_plane[2]
    )
    assert cloud.sigma_mm[row, column] == pytest.approx(along, rel=1e-3)
    assert np.isnan(cloud.points_mm[np.isnan(other)]).all()


def test_points_behind_the_cameras_are_none():
    device = camera(96, 64, lens=())
    pair = rectify(device, device, RigidTransform(np.eye(3), np.array([-100.0, 0, 0])))
    far_right = np.full((64, 96), 500, np.float32)
    ones = np.ones_like(far_right)
    cloud = triangulate_pair(Matches(far_right, ones, np.zeros((64, 96), np.uint16)), pair)
    assert np.isnan(cloud.points_mm).all()
    assert np.isnan(cloud.sigma_mm).all()


def test_consistency_is_the_distance_in_the_projector():
    seen = view(sphere, camera(), LEFT)
    points, measured = seen.points_mm.astype(np.float32), seen.u_px.astype(np.float32)
    agreed = projector_consistency(points, measured + 0.75, projector(), PROJECTOR_FROM_LEFT)
    assert np.nanmax(np.abs(agreed + 0.75)) < 1e-3
    rows = projector_consistency(
        points, seen.v_px.astype(np.float32), projector(), PROJECTOR_FROM_LEFT, rows=True
    )
    assert np.nanmax(np.abs(rows)) < 1e-3
    moved = projector_consistency(
        points * np.float32(1.01), measured, projector(), PROJECTOR_FROM_LEFT
    )
    assert np.nanmin(np.abs(moved)) > 1  # 7 mm too far shows


def test_unusable_input_is_refused():
    measured = np.zeros((480, 640), np.float32)
    with pytest.raises(CalibrationError, match="map is 640x479"):
        triangulate_projector(measured[:-1].copy(), camera(), projector(), PROJECTOR_FROM_LEFT)
    tilted = projector((0.0,) * 12 + (0.1, 0.0))
    with pytest.raises(CalibrationError, match="tilted sensor"):
        triangulate_projector(measured, camera(), tilted, PROJECTOR_FROM_LEFT)
    broken = PROJECTOR_FROM_LEFT._replace(t_mm=np.full(3, np.nan))
    with pytest.raises(CalibrationError, match="the projector isn't a rotation with a finite"):
        projector_consistency(
            np.zeros((4, 4, 3), np.float32), measured[:4, :4], projector(), broken
        )
