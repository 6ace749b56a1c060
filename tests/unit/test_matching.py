import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.numerics.camera_model import Pinhole, RigidTransform, compose, inverse
from backend.numerics.errors import MatchingError
from backend.numerics.matching import Matches, match, sample_partner
from backend.numerics.reasons import Reason
from backend.numerics.rectification import rectify
from backend.numerics.triangulation import triangulate_pair
from tests.surfaces import (
    LEFT,
    RIGHT,
    camera,
    looking_from,
    plane,
    seen_by_other,
    sphere,
    step,
    view,
)

WIDTH, HEIGHT, SHIFT = 64, 24, 6
_K = np.array([[100.0, 0, 31.5], [0, 100.0, 11.5], [0, 0, 1]])
STRAIGHT = Pinhole(_K, np.zeros(5), WIDTH, HEIGHT)
ASIDE = rectify(STRAIGHT, STRAIGHT, RigidTransform(np.eye(3), np.array([-20.0, 0.0, 0.0])))
"""Two equal cameras side by side: partners lie in the same row of pixels."""


def rows_of(values: np.ndarray) -> np.ndarray:
    return np.tile(np.asarray(values, np.float32), (HEIGHT, 1))


RAMP = rows_of(10 + 1.25 * np.arange(WIDTH))
SHIFTED = rows_of(10 + 1.25 * (np.arange(WIDTH) + SHIFT))
"""What the right camera sees of a plane: everything `SHIFT` px further left."""


def columns(matches: Matches) -> np.ndarray:
    """Columns of the other camera, as these cameras' rectified x is the column minus 31.5."""
    return np.asarray(matches.x_other_px + 31.5)


@given(
    scale=st.sampled_from([1.25, 0.4, 3.0, -1.25, -0.3]),
    shift=st.floats(0, 20),
    offset=st.floats(-50, 900),
)
@settings(max_examples=40, deadline=None)
def test_sub_pixel_shift_of_a_ramp_of_either_slope(scale, shift, offset):
    x = np.arange(WIDTH)
    matches = match(rows_of(offset + scale * x), rows_of(offset + scale * (x + shift)), ASIDE)
    found = np.isfinite(matches.x_other_px)
    expected = np.broadcast_to(x - shift, found.shape)
    assert found[1:-1][(expected > 1)[1:-1] & (expected < WIDTH - 2)[1:-1]].all()
    assert columns(matches)[found] == pytest.approx(expected[found], abs=2e-3)


def test_pixels_without_coordinate_have_neither_partner_nor_reason():
    hole = RAMP.copy()
    hole[5:9, 20:30] = np.nan
    matches = match(hole, SHIFTED, ASIDE)
    assert np.isnan(matches.x_other_px[5:9, 20:30]).all()
    assert (matches.reasons[5:9, 20:30] == 0).all()


def test_outside_the_other_camera_there_is_no_match():
    matches = match(RAMP, SHIFTED, ASIDE)
    assert (matches.reasons[1:-1, :SHIFT] == Reason.NO_MATCH).all()
    assert (matches.reasons[1:-1, SHIFT + 1 : -2] == 0).all()


def test_nothing_is_interpolated_over_a_hole_or_a_jump():
    """Between the last pixel before and the first behind, no partner may be invented."""
    hole = SHIFTED.copy()
    hole[:, 30] = np.nan
    matches = match(RAMP, hole, ASIDE)
    place = np.arange(WIDTH) - SHIFT
    assert np.isnan(matches.x_other_px[1:-1, (place > 29.01) & (place < 30.99)]).all()

    jump = SHIFTED.copy()
    jump[:, 30:] += 9.0
    bridged = rows_of(jump[0, 29] + np.linspace(0.5, 9.5, WIDTH) * 1.0)
    matches = match(bridged, jump, ASIDE)
    assert not np.any((columns(matches) > 29.01) & (columns(matches) < 29.99))


def test_two_places_with_the_same_coordinate_are_ambiguous():
    twice = SHIFTED.copy()
    twice[:, 40:50] = twice[:, 10:20]
    matches = match(RAMP, twice, ASIDE)
    middle = slice(10 + SHIFT + 2, 20 + SHIFT - 2)
    assert (matches.reasons[2:-2, middle] == Reason.AMBIGUOUS_MATCH).all()
    assert np.isnan(matches.x_other_px[2:-2, middle]).all()


def test_two_pixels_of_the_reference_with_the_same_coordinate_fail_the_check():
    twice = RAMP.copy()
    twice[:, 40:50] = twice[:, 10:20]
    matches = match(twice, SHIFTED, ASIDE)
    for start in (10, 40):
        assert (matches.reasons[2:-2, start + 2 : start + 8] == Reason.LEFT_RIGHT_CHECK).all()


@pytest.mark.parametrize("surface", [plane, sphere, step])
@pytest.mark.parametrize("swap", [False, True])
def test_either_camera_may_be_the_reference(surface, swap):
    device = camera()
    a, b = (RIGHT, LEFT) if swap else (LEFT, RIGHT)
    here, there = view(surface, device, a), view(surface, device, b)
    pair = rectify(device, device, compose(b, inverse(a)))
    matches = match(here.u_px.astype(np.float32), there.u_px.astype(np.float32), pair)
    cloud = triangulate_pair(matches, pair)
    error = np.linalg.norm(cloud.points_mm - here.points_mm, axis=2)
    seen = seen_by_other(surface, here, a, device, b)
    found = np.isfinite(error)
    assert (found & seen).sum() > 0.97 * seen.sum()
    assert not found[np.isfinite(here.u_px) & ~seen].sum() > 0.02 * seen.sum()
    if (
        surface is not sphere
    ):  # straight lines are interpolated exactly, up to the lens and perspective
        assert np.nanmax(error) < 2e-3


def test_cameras_mounted_on_their_side_and_of_different_size():
    """Fringes run across the pictures' rows then; nothing in the matching knows rows."""
    upright, tilted = camera(640, 480), camera(480, 640)
    a, b = looking_from(-90, 0, roll_rad=np.pi / 2), looking_from(90, 0, roll_rad=-np.pi / 2 + 0.1)
    here, there = view(plane, upright, a), view(plane, tilted, b)
    pair = rectify(upright, tilted, compose(b, inverse(a)))
    cloud = triangulate_pair(
        match(here.u_px.astype(np.float32), there.u_px.astype(np.float32), pair), pair
    )
    error = np.linalg.norm(cloud.points_mm - here.points_mm, axis=2)
    seen = seen_by_other(plane, here, a, tilted, b)
    assert np.isfinite(error)[seen].mean() > 0.98
    assert np.nanmax(error) < 5e-3


def test_values_of_the_partner_are_fetched():
    matches = match(RAMP, SHIFTED, ASIDE)
    partner = sample_partner(rows_of(np.arange(WIDTH)), matches, ASIDE)
    found = np.isfinite(matches.x_other_px)
    assert found.any()
    assert partner[found] == pytest.approx(columns(matches)[found], abs=0.51)
    assert np.isnan(partner[~found]).all()


@pytest.mark.parametrize(
    ("reference", "other", "message"),
    [
        (np.full_like(RAMP, np.nan), RAMP, "no pixel of the reference camera"),
        (RAMP, np.full_like(RAMP, np.nan), "no pixel of the other camera"),
        (RAMP[:-1].copy(), RAMP, "reference camera's map is 64x23"),
        (RAMP, RAMP[:-1].copy(), "other camera's map is 64x23"),
        (np.ones_like(RAMP), np.ones_like(RAMP), "doesn't change"),
    ],
)
def test_unusable_maps_are_refused(reference, other, message):
    with pytest.raises(MatchingError, match=message):
        match(reference, other, ASIDE)
