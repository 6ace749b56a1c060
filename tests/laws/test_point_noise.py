"""The uncertainty that a point carries is the one that it has."""

import numpy as np
import pytest

from backend.numerics.camera_model import compose, inverse
from backend.numerics.matching import match
from backend.numerics.rectification import rectify
from backend.numerics.triangulation import Cloud, triangulate_pair, triangulate_projector
from tests.surfaces import LEFT, PROJECTOR, RIGHT, camera, plane, projector, step, view


def along_ray(cloud: Cloud, truth: np.ndarray) -> np.ndarray:
    """Signed error along each pixel's ray."""
    length = np.linalg.norm(truth, axis=2)
    error = np.linalg.norm(cloud.points_mm, axis=2) - length
    return np.asarray(error[np.isfinite(error)])


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("surface", [plane, step])
@pytest.mark.parametrize("sigmas_px", [(0.08, 0.08), (0.01, 0.06)])
def test_stereo_points_scatter_as_predicted(surface, swap, sigmas_px):
    a, b = (RIGHT, LEFT) if swap else (LEFT, RIGHT)
    here, there = view(surface, camera(), a), view(surface, camera(), b)
    pair = rectify(camera(), camera(), compose(b, inverse(a)))
    maps = [np.full(here.u_px.shape, sigma, np.float32) for sigma in sigmas_px]
    matches = match(
        here.noisy(sigmas_px[0], 1),
        there.noisy(sigmas_px[1], 2),
        pair,
        sigma_reference_px=maps[0],
        sigma_other_px=maps[1],
    )
    cloud = triangulate_pair(matches, pair)
    error = along_ray(cloud, here.points_mm)
    score = error / cloud.sigma_mm[np.isfinite(cloud.sigma_mm)]
    assert score.size > 200_000
    # At an occlusion edge a hidden point may find another one of the same projector column.
    outliers = np.abs(score) > 6
    assert outliers.mean() < 2e-5
    assert np.std(score[~outliers]) == pytest.approx(1, abs=0.02)
    assert abs(score[~outliers].mean()) < 0.05


@pytest.mark.parametrize("lens", [(), (-0.05, 0.02, 5e-4, 2e-4, 0.0)])
def test_projector_points_scatter_as_predicted(lens):
    light, pose = projector(lens), compose(PROJECTOR, inverse(LEFT))
    seen = view(plane, camera(), LEFT, light=light)
    sigma = np.full(seen.u_px.shape, 0.05, np.float32)
    cloud = triangulate_projector(
        seen.noisy(0.05, 3), camera(), light, pose, sigma_projector_px=sigma
    )
    score = along_ray(cloud, seen.points_mm) / cloud.sigma_mm[np.isfinite(cloud.sigma_mm)]
    assert np.std(score) == pytest.approx(1, abs=0.01)


def test_error_is_noise_and_nothing_else():
    """Without noise what remains of a plane is rounding: a thousandth of the 0.031 mm of a scan."""
    here, there = view(plane, camera(), LEFT), view(plane, camera(), RIGHT)
    pair = rectify(camera(), camera(), compose(RIGHT, inverse(LEFT)))
    cloud = triangulate_pair(
        match(here.u_px.astype(np.float32), there.u_px.astype(np.float32), pair), pair
    )
    assert np.std(along_ray(cloud, here.points_mm)) < 2e-4
    assert abs(along_ray(cloud, here.points_mm).mean()) < 5e-5


def test_depth_noise_grows_with_distance_squared_and_falls_with_the_baseline():
    """sigma_Z = Z^2 / (f b) sigma_d, at the centre of parallel cameras."""
    from backend.numerics.camera_model import RigidTransform
    from backend.numerics.matching import Matches

    device = camera(64, 48, lens=())
    sigma = np.full((48, 64), 0.1, np.float32)
    found = {}
    for base in (50.0, 100.0):
        pair = rectify(device, device, RigidTransform(np.eye(3), np.array([-base, 0, 0])))
        columns = pair.rectified_of_reference.map()[0]
        for depth in (500.0, 1000.0):
            x_other = (columns - pair.focal_px * base / depth).astype(np.float32)
            cloud = triangulate_pair(Matches(x_other, sigma, np.zeros((48, 64), np.uint16)), pair)
            found[base, depth] = cloud.sigma_mm[19, 34]  # on the axis
    assert found[50, 1000] / found[50, 500] == pytest.approx(4, rel=1e-3)
    assert found[50, 1000] / found[100, 1000] == pytest.approx(2, rel=1e-3)
    assert found[100, 1000] == pytest.approx(1000**2 / (device.K[1, 1] * 100) * 0.1, rel=2e-3)
