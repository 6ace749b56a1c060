"""Completeness and error are counted as the definition says."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from backend.numerics.errors import NumericsError
from backend.numerics.scoring import DEFINITION, Scores, Truth, edge_band, score


def wall(height: int = 20, width: int = 30, depth_mm: float = 700.0) -> Truth:
    """A wall across the axis, one part, everything lit and seen."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    points = np.stack(
        [(x - width / 2) * 0.3, (y - height / 2) * 0.3, np.full_like(x, depth_mm)], -1
    )
    normals = np.zeros_like(points)
    normals[..., 2] = -1
    return Truth(
        points,
        normals,
        np.ones((height, width), bool),
        np.zeros((height, width), bool),
        np.zeros((height, width), np.int16),
        ("wall", "unused"),
    )


def all_pixels(truth: Truth) -> tuple[Any, Any]:
    y, x = np.mgrid[: truth.part.shape[0], : truth.part.shape[1]]
    return x.ravel(), y.ravel()


def scored(points_mm: Any, truth: Truth) -> Scores:
    """Score one point per pixel, row by row."""
    x, y = all_pixels(truth)
    return score(points_mm, x, y, truth)


def along_rays(truth: Truth, error_mm: Any) -> Any:
    points = truth.points_mm.reshape(-1, 3).astype(np.float64)
    return points + error_mm[:, None] * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_known_errors_come_back():
    truth = wall()
    random = np.random.default_rng(5)
    errors = random.normal(0.02, 0.1, truth.part.size)
    errors[:60] = 3.0  # outliers
    errors[60:90] = np.nan  # missing
    result = scored(along_rays(truth, errors), truth)
    good = errors[90:]
    assert result.total.base == 600
    assert result.total.accepted == 570
    assert result.total.completeness == pytest.approx(510 / 600)
    assert result.total.outlier_share == pytest.approx(60 / 570)
    assert result.total.rms_mm == pytest.approx(np.sqrt(np.mean(good**2)), rel=1e-4)
    assert result.total.mean_mm == pytest.approx(np.mean(np.abs(good)), rel=1e-4)
    assert result.total.median_mm == pytest.approx(np.median(np.abs(good)), rel=1e-4)
    assert result.total.bias_mm == pytest.approx(np.mean(good), rel=1e-3)
    assert result.total.std_mm == pytest.approx(np.std(np.abs(good)), rel=1e-3)
    assert list(result.parts) == ["wall"]


def test_a_shift_across_the_ray_is_no_error():
    truth = wall(height=1, width=1)
    point = truth.points_mm.reshape(-1, 3) + np.array([0.0, 5.0, 0.0], np.float32)
    result = scored(point, truth)
    assert result.total.rms_mm < 0.01


def test_edges_and_strays_are_counted_apart():
    truth = wall()
    truth.lit_and_seen[:5] = False
    truth.edge_band[5:7] = True
    result = scored(truth.points_mm.reshape(-1, 3), truth)
    assert (result.total.base, result.edge_base, result.stray) == (390, 60, 150)
    assert result.edge_accepted == 60
    assert result.total.completeness == 1.0


def test_nothing_measured_is_zero_complete_and_no_number_else():
    truth = wall()
    none = np.zeros(0, int)
    result = score(np.zeros((0, 3)), none, none, truth)
    assert result.total.completeness == 0.0
    assert np.isnan(result.total.outlier_share)
    assert np.isnan(result.total.rms_mm)


@pytest.mark.parametrize(
    ("x", "y", "sentence"),
    [([30], [0], "outside"), ([-1], [0], "outside"), ([29.6], [0], "29.6")],
)
def test_pixels_that_are_not_there_are_refused(x, y, sentence):
    with pytest.raises(NumericsError, match=sentence):
        score(np.zeros((len(x), 3)), np.array(x), np.array(y), wall())


def slanted_points(truth: Truth, x: Any, y: Any) -> tuple[Truth, Any]:
    """Lean the wall, and give its points at places between pixels."""
    height, width = truth.part.shape
    grid_y, grid_x = np.mgrid[:height, :width]

    def at(x: Any, y: Any) -> Any:
        ray = np.stack([(x - width / 2) / 2000, (y - height / 2) / 2000, np.ones_like(x)], -1)
        return ray * (700.0 / (1 + 0.8 * ray[..., 0] - 0.5 * ray[..., 1]))[..., None]

    surface = at(grid_x.astype(float), grid_y.astype(float)).astype(np.float32)
    return replace(truth, points_mm=surface), at(x, y)


def test_points_between_pixels_are_measured_along_their_own_rays():
    random = np.random.default_rng(3)
    x, y = random.uniform(0, 29, 400), random.uniform(0, 19, 400)
    truth, points = slanted_points(wall(), x, y)
    errors = random.normal(0, 0.05, 400)
    moved = points + errors[:, None] * points / np.linalg.norm(points, axis=1, keepdims=True)
    result = score(moved, x, y, truth)
    assert result.total.accepted == 400
    assert result.total.rms_mm == pytest.approx(np.sqrt(np.mean(errors**2)), rel=2e-3)
    assert result.total.bias_mm == pytest.approx(np.mean(errors), abs=1e-4)


@pytest.mark.parametrize(
    ("x", "y", "pixels"),
    [(5.0, 5.0, 1), (5.5, 5.0, 2), (5.5, 5.5, 4), (5.2, 5.0, 1), (5.3, 5.0, 2), (0.0, 0.4, 2)],
)
def test_a_point_counts_for_the_pixels_within_half_a_diagonal(x, y, pixels):
    truth, points = slanted_points(wall(), np.array([x]), np.array([y]))
    result = score(points, np.array([x]), np.array([y]), truth)
    assert result.total.completeness * result.total.base == pytest.approx(pixels)


def test_points_farther_apart_than_pixels_are_incomplete():
    """Samples every 1.4 px leave none out along a row, samples every 3 px leave out a third."""
    y = np.repeat(np.arange(20), 100)
    for pitch_px, complete in ((1.4, 1.0), (3.0, 2 / 3)):
        x = np.tile((np.arange(100) + 0.5) * pitch_px, 20)
        inside = x < 29
        truth, points = slanted_points(wall(), x[inside], y[inside].astype(float))
        result = score(points, x[inside], y[inside], truth)
        assert result.total.completeness == pytest.approx(complete, abs=0.05)


def test_an_outlier_between_good_points_makes_no_pixel_incomplete_that_they_fill():
    truth = wall()
    x, y = np.array([5.0, 5.2, 8.0]), np.array([5.0, 5.0, 5.0])
    points = truth.points_mm[5, [5, 5, 8]].astype(float)
    points[1:, 2] += 3.0
    result = score(points, x, y, truth)
    assert result.total.completeness * result.total.base == pytest.approx(1)
    assert result.total.outlier_share == pytest.approx(2 / 3)


def test_what_was_given_up_as_saturated_is_counted_per_part():
    truth = wall()
    truth.part[:, 15:] = 1
    truth.edge_band[:2] = True
    given_up = np.zeros((20, 30), bool)
    given_up[:11, 15:] = True
    none = np.zeros(0, int)
    result = score(np.zeros((0, 3)), none, none, truth, over_exposed=given_up)
    assert result.parts["wall"].over_exposed_share == 0.0
    assert result.parts["unused"].over_exposed_share == 0.5
    assert np.isnan(score(np.zeros((0, 3)), none, none, truth).total.over_exposed_share)


def test_a_depth_step_is_an_edge_two_pixels_to_either_side():
    truth = wall()
    truth.points_mm[:, 15:] *= 1.05
    band = edge_band(truth.points_mm, truth.normals, truth.lit_and_seen, truth.lit_and_seen)
    assert list(np.flatnonzero(band.any(axis=0))) == [13, 14, 15, 16]
    assert band[:, 13:17].all()


@pytest.mark.parametrize("which", ["lit", "seen"])
def test_a_shadow_line_is_an_edge(which):
    truth = wall()
    masks = {"lit": np.ones((20, 30), bool), "seen": np.ones((20, 30), bool)}
    masks[which][8:] = False
    band = edge_band(truth.points_mm, truth.normals, masks["lit"], masks["seen"])
    assert list(np.flatnonzero(band.all(axis=1))) == [6, 7, 8, 9]
    assert not np.delete(band, range(6, 10), axis=0).any()


def test_neither_slope_nor_crease_is_an_edge():
    """A roof whose halves fall off by 75 degrees: neighbours differ by a millimetre in depth."""
    rays = wall(depth_mm=700.0).points_mm / np.float32(700)
    slope = np.tan(np.deg2rad(75.0))
    normals = np.zeros_like(rays)
    normals[..., 0] = np.where(rays[..., 0] < 0, -slope, slope)
    normals[..., 2] = -1
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # planes through (0, 0, 700): depth along each ray
    depth = (700 * normals[..., 2]) / (rays * normals).sum(-1)
    points = (rays * depth[..., None]).astype(np.float32)
    assert np.abs(np.diff(points[..., 2], axis=1)).max() > 1.0
    everything = np.ones(points.shape[:2], bool)
    assert not edge_band(points, normals, everything, everything).any()


def test_the_definition_names_every_limit():
    for word in ("2 px", "0.5 mm", "along the same pixel's ray", "counted apart"):
        assert word in DEFINITION
