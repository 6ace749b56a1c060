"""The homography of a table from codes, some of them wrong."""

import numpy as np
import pytest

from backend.numerics.errors import CalibrationError
from backend.numerics.homography import fit_homography, map_points

TRUE = np.array([[0.9, 0.05, 20.0], [-0.03, 1.1, -5.0], [2e-5, -3e-5, 1.0]])


def points(n=400, seed=1):
    return np.random.default_rng(seed).uniform(0, 600, (n, 2))


def test_it_is_found_among_wrong_codes_and_noise():
    random = np.random.default_rng(2)
    camera = points()
    projector = map_points(TRUE, camera) + random.normal(0, 0.3, (400, 2))
    projector[:120] = random.uniform(0, 600, (120, 2))
    fit = fit_homography(camera, projector)
    off = map_points(fit.matrix, camera) - map_points(TRUE, camera)
    assert np.abs(off).max() < 0.3
    assert fit.inlier_share == pytest.approx(0.7, abs=0.02)
    assert fit.rms_px == pytest.approx(0.3 * np.sqrt(2), abs=0.1)


def test_the_same_points_give_the_same_matrix():
    camera = points()
    projector = np.rint(map_points(TRUE, camera))
    first, second = (fit_homography(camera, projector).matrix for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize(
    ("camera", "word"),
    [
        (points(3), "needs 4 points"),
        (np.column_stack([np.arange(50.0), 2 * np.arange(50.0) + 7]), "one line"),
        (np.full((20, 2), 3.0), "one line"),
        (np.full((20, 2), np.nan), "finite"),
    ],
    ids=["three points", "collinear", "one place", "not finite"],
)
def test_points_that_fit_no_homography_are_refused_in_a_sentence(camera, word):
    with pytest.raises(CalibrationError, match=word):
        fit_homography(camera, points(len(camera)))


def test_collinear_places_in_the_projector_are_refused_too():
    line = np.column_stack([np.arange(50.0), np.arange(50.0)])
    with pytest.raises(CalibrationError, match="projector lie on one line"):
        fit_homography(points(50), line)


def test_what_a_homography_sends_behind_is_no_place():
    matrix = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    mapped = map_points(matrix, np.array([[10.0, 0], [20.0, 5], [150.0, 5]]))
    assert np.isfinite(mapped[:2]).all()
    assert np.isnan(mapped[2]).all()
