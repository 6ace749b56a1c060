"""Pixels without a clear partner: settled where projector and both cameras agree, and nowhere else."""

import numpy as np

from backend.numerics.camera_model import compose, inverse
from backend.numerics.confirmation import settle
from backend.numerics.matching import match
from backend.numerics.reasons import Reason
from backend.numerics.rectification import rectify
from backend.numerics.triangulation import triangulate_pair
from tests.surfaces import LEFT, PROJECTOR, RIGHT, camera, plane, projector, view

DEVICE, LIGHT = camera(), projector()
PAIR = rectify(DEVICE, DEVICE, compose(RIGHT, inverse(LEFT)))
HERE, THERE = view(plane, DEVICE, LEFT), view(plane, DEVICE, RIGHT)
U, OTHER_U = HERE.u_px.astype(np.float32), THERE.u_px.astype(np.float32)
SIGMA = np.full(U.shape, 0.05, np.float32)
HOLE = (slice(200, 260), slice(280, 380))


def settled(u: np.ndarray, other_u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lose all points of the hole, then ask the projector: depth, sigma, reasons in the hole."""
    matches = match(U, OTHER_U, PAIR, sigma_reference_px=SIGMA, sigma_other_px=SIGMA)
    cloud, reasons = triangulate_pair(matches, PAIR), matches.reasons
    cloud.depth_mm[HOLE] = cloud.sigma_mm[HOLE] = np.nan
    reasons[HOLE] = int(Reason.NO_MATCH)
    before = cloud.depth_mm.copy()
    settle(cloud, reasons, u, SIGMA, other_u, PAIR, LIGHT, compose(PROJECTOR, inverse(LEFT)))
    kept = np.isfinite(before)
    np.testing.assert_array_equal(cloud.depth_mm[kept], before[kept])
    return cloud.depth_mm[HOLE], cloud.sigma_mm[HOLE], reasons[HOLE]


def test_what_all_three_agree_on_becomes_a_point():
    depth, sigma, reasons = settled(U, OTHER_U)
    assert np.abs(depth - HERE.points_mm[..., 2][HOLE]).max() < 2e-3
    assert (reasons == 0).all()
    assert ((sigma > 0.01) & (sigma < 0.2)).all()


def test_a_coordinate_that_the_other_camera_contradicts_stays_out():
    depth, _, reasons = settled(U + 3, OTHER_U)
    assert np.isnan(depth).all()
    assert (reasons == int(Reason.NO_MATCH)).all()


def test_where_the_other_camera_has_nothing_nothing_is_confirmed():
    depth, _, _ = settled(U, np.full_like(OTHER_U, np.nan))
    assert np.isnan(depth).all()
    missing = U.copy()
    missing[HOLE] = np.nan
    depth, _, reasons = settled(missing, OTHER_U)
    assert np.isnan(depth).all()
    assert (reasons == int(Reason.NO_MATCH)).all()
