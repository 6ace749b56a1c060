"""From what pixels can take to what the projector may give, and whether a code can be trusted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.numerics.code_certainty import agreeing, fill_runs, second_contrast
from backend.numerics.flat_guess import plane_positions
from backend.numerics.intensity_mask import light_at, light_need, scatter, smooth, widen_dark
from backend.numerics.second_look import Looks, second_light
from backend.numerics.unqualified import (
    OVER_EXPOSED,
    UNDER_EXPOSED,
    UNKNOWN_PLACE,
    count_shares,
    judge_pixels,
)

NAN = float("nan")


def gray(rows: list[list[int]]) -> np.ndarray:
    return np.array(rows, np.uint8)


def f32(rows: list[list[float]]) -> np.ndarray:
    return np.array(rows, np.float32)


@given(gain=st.floats(0.01, 30), offset=st.floats(0, 30))
def test_the_light_asked_for_brings_the_target_or_is_all_there_is(gain, offset):
    need = light_need(
        np.full((1, 1), gain, np.float32),
        np.full((1, 1), offset, np.float32),
        target_gray=217,
        contrast_gray=15,
        least_factor=0.001,
    )
    gray = gain * 255 * need.most.item() + offset
    assert gray <= 217 * 1.001
    assert gray == pytest.approx(217, rel=1e-3) or need.most.item() == 1
    assert need.least.item() <= max(need.most.item(), 15 / (gain * 255) * 1.001)


def test_a_pixel_that_returns_nothing_may_have_all_the_light():
    zero = np.zeros((1, 1), np.float32)
    need = light_need(zero, zero, target_gray=217, contrast_gray=15, least_factor=0.01)
    assert need.most.item() == 1


def test_of_several_pixels_at_one_place_the_dazzled_one_decides():
    into = np.ones((2, 3), np.float32)
    values = f32([[0.5, 0.2, 0.7, NAN]])
    columns = f32([[1.4, 0.6, 2.0, 0.0]])
    scatter(values, columns, np.zeros_like(columns), into=into)
    assert into[0].tolist() == pytest.approx([1, 0.2, 0.7])
    assert into[1].tolist() == [1, 1, 1]


def test_places_outside_the_projector_are_left_out():
    into = np.ones((1, 2), np.float32)
    columns = f32([[-1, 2, NAN, np.inf]])
    scatter(np.zeros_like(columns), columns, np.zeros_like(columns), into=into)
    assert into.tolist() == [[1, 1]]


@given(radius=st.floats(1, 6), seed=st.integers(0, 99))
def test_widening_only_darkens_and_reaches_the_radius(radius, seed):
    factor = np.random.default_rng(seed).uniform(0.2, 1, (20, 20)).astype(np.float32)
    factor[10, 10] = 0.1
    widened = widen_dark(factor, radius)
    assert (widened <= factor).all()
    y, x = np.mgrid[:20, :20]
    inside = np.hypot(y - 10, x - 10) <= np.floor(radius)
    assert np.allclose(widened[inside], 0.1)


def test_smoothing_takes_roughness_and_leaves_steps():
    random = np.random.default_rng(3)
    step = np.where(np.arange(80) < 40, 0.1, 1.0) * np.ones((60, 1))
    rough = (step * np.exp(random.normal(0, 0.05, step.shape))).astype(np.float32)
    smoothed = smooth(rough, 2.0)
    assert np.log(smoothed[5:-5, 5:35]).std() < 0.35 * np.log(rough[5:-5, 5:35]).std()
    assert smoothed[:, 39].mean() == pytest.approx(0.1, rel=0.05)
    assert smoothed[:, 40].mean() == pytest.approx(1.0, rel=0.05)


def test_the_light_at_a_place_is_interpolated_and_unknown_where_the_place_is():
    factor = f32([[0, 1], [0, 1]])
    seen = light_at(factor, f32([[0.25, NAN]]), f32([[0.5, 0.0]]))
    assert seen[0, 0] == pytest.approx(0.25, abs=0.02)
    assert np.isnan(seen[0, 1])


def test_a_lone_code_is_no_neighbour_of_anyone():
    columns = np.tile(np.arange(7, dtype=np.float32), (5, 1))
    rows = np.tile(np.arange(5, dtype=np.float32)[:, None], (1, 7))
    columns[2, 3] = 400
    agree = agreeing(columns, rows, tolerance_px=2)
    assert not agree[2, 3]
    assert agree.sum() == 34


def test_runs_are_filled_between_ends_of_one_surface_only():
    row = f32([[1, NAN, NAN, 4, NAN, 90, NAN, NAN, NAN, 94, NAN]])
    filled = fill_runs(row, np.isnan(row), longest_px=2)
    assert filled[0, :4].tolist() == [1, 2, 3, 4]
    assert np.isnan(filled[0, [4, 6, 7, 8, 10]]).all()


def test_only_what_may_be_filled_is():
    row = f32([[1, NAN, NAN, 4]])
    filled = fill_runs(row, np.array([[False, True, False, False]]), longest_px=9)
    assert filled[0, 1] == 2
    assert np.isnan(filled[0, 2])


def test_one_weak_bit_is_no_reason_to_doubt():
    patterns = [gray([[200, 200]]), gray([[101, 101]]), gray([[150, 100]])]
    inverses = [gray([[10, 10]]), gray([[100, 100]]), gray([[10, 100]])]
    assert second_contrast(patterns, inverses).tolist() == [[140, 1]]


def test_every_line_belongs_to_one_look_and_is_lit_by_it_alone():
    looks = Looks(6.0, 5)
    lines = np.linspace(-90, 90, 721, dtype=np.float32)
    own = looks.own(lines)
    assert set(own.tolist()) == set(range(5))
    inside = np.array([looks.lit(lines, n, 0.0) for n in range(5)])
    assert (inside.sum(axis=0) == 1).all()
    assert (inside.argmax(axis=0) == own).all()
    wider = np.array([looks.lit(lines, n, 2.0) for n in range(5)])
    assert (wider.sum(axis=0) <= 2).all()
    assert wider[own, np.arange(lines.size)].all()


def test_noise_is_no_second_light():
    white, alone = f32([[100.0, 100.0]]), f32([[98.0, 60.0]])
    share = second_light(white, alone, np.zeros_like(white), noise_gray=3.0)
    assert share.tolist() == [[0.0, pytest.approx(0.4)]]


def test_unqualified_pixels_are_counted_by_how_bright_they_answer():
    white = gray([[255, 100, 9, 255, 100, 8]])
    contrast = f32([[90, 90, 1, 90, 90, 1]])
    lit = np.array([[True, True, True, True, True, False]])
    placed = np.array([[True, False, True, True, True, True]])
    labels = judge_pixels(white, contrast, lit, placed, saturation_gray=254, min_contrast_gray=4)
    assert labels.tolist() == [[OVER_EXPOSED, UNKNOWN_PLACE, UNDER_EXPOSED, OVER_EXPOSED, 0, 0]]
    most = f32([[0.05, 0.5, 1.0, 0.5, 1.0, 1.0]])
    shares = count_shares({"left": labels}, {"left": lit}, {"left": most})
    assert shares == pytest.approx((0.4, 0.2, 0.5, 0.5, 1.0))


def test_a_plane_maps_every_pixel():
    columns, rows = plane_positions(np.diag([2.0, 3.0, 1.0]), width_px=4, height_px=3)
    assert columns.shape == rows.shape == (3, 4)
    assert (columns[2, 3], rows[2, 3]) == (6, 6)
