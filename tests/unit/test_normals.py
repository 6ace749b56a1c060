import numpy as np
import pytest

from backend.numerics.errors import CalibrationError
from backend.numerics.normals import normals
from tests.surfaces import (
    LEFT,
    PLANE_NORMAL,
    SPHERE_CENTRE,
    camera,
    plane,
    sphere,
    step,
    view,
)


def angles_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.asarray(np.degrees(np.arccos(np.clip((found * truth).sum(axis=-1), -1, 1))))


def test_plane_has_its_normal_everywhere_through_a_distorting_lens():
    seen = view(plane, camera(), LEFT)
    found = normals(seen.points_mm.astype(np.float32), camera())
    assert found.dtype == np.float32
    assert np.nanmax(angles_deg(found, LEFT.R @ PLANE_NORMAL)) < 0.1
    assert np.linalg.norm(found[np.isfinite(found[..., 0])], axis=-1) == pytest.approx(1, abs=1e-6)
    assert (np.isfinite(found[..., 0]) == np.isfinite(seen.u_px)).mean() > 0.999


def test_sphere_has_radial_normals_towards_the_camera():
    seen = view(sphere, camera(), LEFT)
    centre = LEFT.R @ SPHERE_CENTRE + LEFT.t_mm
    truth = (seen.points_mm - centre) / np.linalg.norm(
        seen.points_mm - centre, axis=2, keepdims=True
    )
    error = angles_deg(normals(seen.points_mm.astype(np.float32), camera()), truth)
    assert np.nanmedian(error) < 0.05
    assert np.nanpercentile(error, 99) < 1.5
    assert np.isfinite(error).sum() > 0.99 * np.isfinite(seen.u_px).sum()


def test_a_jump_bends_no_normal():
    seen = view(step, camera(), LEFT)
    found = normals(seen.points_mm.astype(np.float32), camera())
    assert np.nanmax(angles_deg(found, LEFT.R @ np.array([0.0, 0, -1]))) < 0.2


def test_lonely_points_and_lines_have_no_normal():
    points = view(plane, camera(), LEFT).points_mm.astype(np.float32)
    alone, line = points.copy(), points.copy()
    keep = np.zeros(points.shape[:2], bool)
    keep[200:203, 300] = True
    alone[~keep] = np.nan
    keep[:, 300] = True
    line[~keep] = np.nan
    assert np.isnan(normals(alone, camera())).all()
    assert np.isnan(normals(line, camera())).all()


def test_another_size_is_refused():
    with pytest.raises(CalibrationError, match="cloud is 640x40 px"):
        normals(np.zeros((40, 640, 3), np.float32), camera())
