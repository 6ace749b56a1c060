import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st

from backend.numerics.errors import NumericsError
from backend.numerics.filters import (
    pixel_angle,
    remove,
    valid_points,
    within_box,
    within_limits,
    without_outliers,
    without_specks,
)
from backend.numerics.lattice import LATTICE_STEP, Lattice
from tests.surfaces import LEFT, Surface, camera, plane, sphere, step, view

ANGLE = pixel_angle(camera().K)
SIGMA = 0.03


def noisy_cloud(surface: Surface, seed: int = 0) -> np.ndarray:
    depth = view(surface, camera(), LEFT).points_mm[..., 2]
    noise = np.random.default_rng(seed).normal(scale=SIGMA, size=depth.shape)
    return np.asarray(depth + noise, np.float32)


@pytest.mark.parametrize("surface", [plane, sphere, step])
@pytest.mark.parametrize("known", [True, False])
def test_outliers_are_found_and_little_else(surface, known):
    points = noisy_cloud(surface)
    rng = np.random.default_rng(1)
    places = np.argwhere(valid_points(points))
    planted = places[rng.choice(len(places), 500, replace=False)]
    shift = rng.choice([-1, 1], 500) * rng.uniform(0.012, 0.06, 500)
    points[planted[:, 0], planted[:, 1]] *= (1 + shift).astype(np.float32)
    sigma = np.full(points.shape, SIGMA, np.float32) if known else None
    before = points.copy()
    kept = without_outliers(points, sigma_mm=sigma, pixel_angle_rad=ANGLE)
    assert (~kept.keep[planted[:, 0], planted[:, 1]]).mean() > 0.995
    # the sphere's limb is steeper than any limit within a few pixels
    assert kept.removed - 500 < (0.005 if surface is sphere else 1e-4) * len(places)
    assert kept.removed == len(places) - np.count_nonzero(kept.keep)
    np.testing.assert_array_equal(points, before)


def test_edge_of_a_hole_is_not_an_outlier():
    points = noisy_cloud(plane)
    points[100:300, 200:203] = np.nan
    points[150, 250:600] = np.nan
    kept = without_outliers(points, pixel_angle_rad=ANGLE)
    assert kept.removed == 0


def test_a_thin_wire_stays_and_a_single_point_goes():
    points = noisy_cloud(plane)
    points[:, 320] *= np.float32(0.9)
    points[50, 100] *= np.float32(0.9)
    kept = without_outliers(points, pixel_angle_rad=ANGLE)
    lit = valid_points(points)[:, 320]
    assert kept.keep[:, 320][lit].mean() > 0.99
    assert not kept.keep[50, 100]


def test_box_keeps_its_borders():
    depth = np.array([[500, 700, 600, np.nan]], np.float32)
    nodes = np.zeros((2, 4, 4))
    nodes[0] = 51 / 600 * (np.arange(4) * LATTICE_STEP - 1)  # x is 51 mm at pixel 2
    rays = Lattice(nodes, 4, 1)
    kept = within_box(depth, rays, (-50, -np.inf, 500), (50, np.inf, 700))
    assert kept.keep.tolist() == [[True, True, False, False]]
    assert kept.removed == 1
    with pytest.raises(NumericsError, match="is empty"):
        within_box(depth, rays, (0, 0, 5), (1, 1, 4))


def test_limits_include_their_ends_and_ignore_what_is_not_known():
    points = np.ones((1, 4), np.float32)
    values = np.array([[0.1, 0.2, 0.3, np.nan]], np.float32)
    kept = within_limits(points, values, highest=float(values[0, 1]))
    assert kept.keep.tolist() == [[True, True, False, True]]
    assert within_limits(points, values, lowest=0.15).removed == 1


@pytest.mark.parametrize(("least", "removed"), [(0, 0), (9, 0), (10, 9), (11, 9)])
def test_specks_below_the_size_go(least, removed):
    points = np.full((60, 80), np.nan, np.float32)
    points[5:35, 5:45] = 700
    points[50:53, 60:63] = 702
    kept = without_specks(points, least_pixels=least, pixel_angle_rad=ANGLE)
    assert kept.removed == removed


def test_a_patch_that_touches_at_another_depth_is_a_speck():
    points = np.full((60, 80), 700, np.float32)
    points[10:13, 10:13] = 760
    kept = without_specks(points, least_pixels=20, pixel_angle_rad=ANGLE)
    assert kept.removed == 9
    assert not kept.keep[10:13, 10:13].any()


@given(st.integers(0, 2**32 - 1))
def test_removing_leaves_the_others_bit_for_bit(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(6, 7)).astype(np.float32)
    points[rng.random((6, 7)) < 0.3] = np.nan
    kept = within_limits(points, points.copy(), highest=0.2)
    after = points.copy()
    remove(after, kept)
    assert (valid_points(after) == kept.keep).all()
    np.testing.assert_array_equal(after[kept.keep], points[kept.keep])
    assert kept.removed == valid_points(points).sum() - kept.keep.sum()


def test_limits_widen_with_the_noise_that_is_known():
    depth = np.ones((1, 4), np.float32)
    values = np.array([[0.5, -0.5, 0.5, 0.5]], np.float32)
    sigma = np.array([[0.2, 0.2, 0.01, np.nan]], np.float32)
    kept = within_limits(depth, values, lowest=-0.1, highest=0.1, sigma=sigma, sigmas=2.0)
    assert kept.keep.tolist() == [[True, True, False, False]]


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_patches_are_what_a_flood_from_each_pixel_reaches(seed, least):
    """Against a labelling that is written down in a few lines; strips of rows join across their borders."""
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((150, 9)) < 0.45, np.nan, 700).astype(np.float32)
    label, _ = scipy.ndimage.label(np.isfinite(depth))
    size = np.bincount(label.ravel())
    size[0] = 0
    kept = without_specks(depth, least_pixels=least, pixel_angle_rad=ANGLE)
    np.testing.assert_array_equal(kept.keep, size[label] >= least)
