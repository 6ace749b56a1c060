import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.numerics.camera_model import RigidTransform, compose, inverse, project, rays
from backend.numerics.errors import CalibrationError
from backend.numerics.rectification import Canvas, rectify
from tests.surfaces import camera, looking_from


def on_canvas(xy: np.ndarray, canvas: Canvas) -> np.ndarray:
    x, y = xy[:, 0] - canvas.x0_px, xy[:, 1] - canvas.y0_px
    return np.asarray(
        (x >= 0) & (x <= canvas.width_px - 1) & (y >= 0) & (y <= canvas.height_px - 1)
    )


def rectified(
    points: np.ndarray,
    device_from_reference: RigidTransform,
    turn_from_reference: np.ndarray,
    focal: float,
) -> np.ndarray:
    """Project points, given in the reference frame, onto a device's rectified plane."""
    centre = inverse(device_from_reference).t_mm
    turned = (points - centre) @ turn_from_reference.T
    return np.asarray(focal * turned[:, :2] / turned[:, 2:])


@given(
    base=st.floats(60, 300),
    height=st.floats(-60, 60),
    rolls=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
    target=st.floats(350, 1500),
    swap=st.booleans(),
    seed=st.integers(0, 99),
)
@settings(max_examples=30, deadline=None)
def test_nothing_that_both_cameras_see_is_lost_and_partners_share_a_row(
    base, height, rolls, target, swap, seed
):
    left = looking_from(-base / 2, 0, roll_rad=rolls[0], target_mm=target)
    right = looking_from(base / 2, height, roll_rad=rolls[1], target_mm=target)
    a, b = (right, left) if swap else (left, right)
    other_from_reference = compose(b, inverse(a))
    first, second = camera(320, 240), camera(400, 200)
    pair = rectify(first, second, other_from_reference)

    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 1, (4000, 2)) * [first.width_px - 1, first.height_px - 1]
    pixels[:400, 0] = rng.choice([0, first.width_px - 1], 400)  # the borders above all
    slopes = rays(pixels, first)
    points = np.column_stack([slopes, np.ones(4000)]) * rng.uniform(
        0.5 * target, 2 * target, (4000, 1)
    )
    seen = project(points, second, other_from_reference)
    both = ((seen >= 0) & (seen <= [second.width_px - 1, second.height_px - 1])).all(axis=1)
    here = RigidTransform(np.eye(3), np.zeros(3))
    at_first = rectified(points[both], here, pair.rectified_from_reference, pair.focal_px)
    at_second = rectified(
        points[both], other_from_reference, pair.rectified_from_reference, pair.focal_px
    )
    assert on_canvas(at_first, pair.reference).all()
    assert on_canvas(at_second, pair.other).all()
    assert at_first[:, 1] == pytest.approx(at_second[:, 1], abs=1e-6)
    turned = points[both] @ pair.rectified_from_reference.T
    disparity = at_first[:, 0] - at_second[:, 0]
    assert turned[:, 2] * disparity == pytest.approx(
        np.full(both.sum(), pair.focal_px * pair.baseline_mm), rel=1e-6
    )


@pytest.mark.parametrize("swap", [False, True])
def test_lattices_agree_with_the_camera_model(swap):
    a, b = looking_from(-90, 0, roll_rad=0.05), looking_from(90, 10)
    a, b = (b, a) if swap else (a, b)
    device = camera()
    pair = rectify(device, device, compose(b, inverse(a)))
    to_plane, to_pixel = pair.rectified_of_reference.map(), pair.pixel_of_reference.map()
    y, x = np.mgrid[10:470:23, 10:630:19]
    column = np.round(to_plane[0, y, x]).astype(int) - pair.reference.x0_px
    row = np.round(to_plane[1, y, x]).astype(int) - pair.reference.y0_px
    inside = (row >= 0) & (row < pair.reference.height_px)
    back = to_pixel[:, row[inside], column[inside]]
    # there and back through two lattices, rounded to whole pixels of the plane in between
    assert np.abs(back[0] - x[inside]).max() < 0.8
    assert np.abs(back[1] - y[inside]).max() < 0.8


def test_wide_convergence_gets_a_coarser_canvas_not_a_larger_one():
    def rig(x_mm: float) -> RigidTransform:
        return looking_from(x_mm, 0, target_mm=200)

    wide = camera(640, 480, lens=())._replace(
        K=np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    )
    pair = rectify(wide, wide, compose(rig(150), inverse(rig(-150))))
    for canvas in (pair.reference, pair.other):
        assert canvas.width_px * canvas.height_px < 4.1 * 640 * 480
    assert pair.focal_px < 400


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (RigidTransform(np.eye(3), np.zeros(3)), "stand 0 mm apart"),
        (RigidTransform(np.eye(3), np.array([0.0, 0.0, -80.0])), "look along the line"),
        (
            RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.array([80.0, 0, 0])),
            "look along the line|80 deg",
        ),
        (RigidTransform(np.eye(3), np.array([np.nan, 0.0, 0.0])), "finite translation"),
    ],
)
def test_impossible_pairs_are_refused(pose, message):
    with pytest.raises(CalibrationError, match=message):
        rectify(camera(), camera(), pose)
