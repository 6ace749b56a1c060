"""The simulated screen and mirror: reflection, light, time, defects, truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.devices.errors import DeviceDisconnected, RigConfigError
from backend.devices.protocols import KnowsMirrorTruth, KnowsTruth, LinkState
from backend.devices.sim import create_lcd_rig
from backend.devices.sim.lcd_layout import bow_mm
from backend.devices.sim.mirrors import PLANE, Dent, Outline, Paraboloid, Together, height_map
from backend.devices.sim.reflection import meet, reflect
from backend.devices.sim.screen import share_of_before
from backend.numerics.camera_model import Pinhole, project
from backend.numerics.patterns import sine_pattern

SMALL = {"scene": "mirror-flat", "size": "160x120", "screen_size": "480x270", "pixel_pitch_mm": 1.1}


@pytest.fixture
def opened():
    rigs = []

    def open_rig(**options):
        rigs.append(create_lcd_rig(SMALL | options))
        rigs[-1].open()
        return rigs[-1]

    yield open_rig
    for rig in rigs:
        rig.close()


def shoot(rig: Any, pattern: Any = None, exposure_ms: float = 20.0) -> Any:
    """Take one picture of a pattern, or of a uniform field of a code."""
    camera = rig.cameras["camera"]
    camera.configure(replace(camera.settings, exposure_us=1000 * exposure_ms))
    if camera.state is not LinkState.ARMED:
        camera.arm()
    if isinstance(pattern, np.ndarray):
        rig.projector.load([pattern])
        rig.projector.show(0)
    else:
        rig.projector.blank(255 if pattern is None else pattern)
    camera.trigger()
    return camera.get_frame().data


def fringe(rig: Any, axis: Any = "x", periods: float = 16, shift_rad: float = 0.0) -> Any:
    width, height = rig.projector.capabilities.size
    shape = {"width_px": width, "height_px": height, "low_gray": 0, "high_gray": 255}
    return sine_pattern(axis=axis, periods=periods, shift_rad=shift_rad, **shape)


# ---------------------------------------------------------------- rays

direction = st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.just(-1.0))
slope = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))


@settings(deadline=None)
@given(direction, slope)
def test_angle_out_is_angle_in_and_both_lie_in_one_plane_with_the_normal(towards, slopes):
    d, s = np.array([towards]), np.array([slopes])
    out = reflect(d, s)
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    normal /= np.linalg.norm(normal)
    assert np.linalg.norm(out) == pytest.approx(np.linalg.norm(d))
    assert out[0] @ normal == pytest.approx(-d[0] @ normal)
    assert np.cross(d[0], out[0]) @ normal == pytest.approx(0, abs=1e-12)


def test_rays_meet_a_paraboloid_where_algebra_says():
    origin = np.array([10.0, -180.0, 670.0])
    targets = np.random.default_rng(1).uniform(-70, 70, (50, 2))
    z = (targets**2).sum(1) / (4 * 1200.0)
    towards = np.column_stack([targets, z]) - origin
    points, slopes = meet(Paraboloid(1200.0, 1200.0), origin, towards)
    np.testing.assert_allclose(points, np.column_stack([targets, z]), atol=1e-9)
    np.testing.assert_allclose(slopes, targets / 2400.0, atol=1e-12)


@pytest.mark.parametrize("bow", [0.0, 12.0])
def test_a_flat_mirror_shows_the_screen_as_if_it_stood_behind(opened, bow):
    """Each pixel's place on the screen, mirrored at the plane and projected, is the pixel."""
    rig = opened(screen_bow_mm=bow, screen_tilt_deg=(3.0, -4.0), screen_offset_mm=(5.0, -7.0))
    known, seen = rig.calibration(), rig._load().seen
    truth = rig.mirror_truth("camera")
    shares = seen.shares[truth.seen]
    at = (shares - 0.5) * rig.config.screen_size_mm
    on_screen = np.column_stack([at, bow_mm(shares[:, 0], bow)])
    world = (on_screen - known.screen_from_world.t_mm) @ known.screen_from_world.R
    pose = known.mirror_from_world
    behind = (world @ pose.R.T + pose.t_mm) * [1, 1, -1]
    model = known.cameras["camera"]
    camera = Pinhole(model.K, model.distortion, model.width_px, model.height_px)
    pixels = project((behind - pose.t_mm) @ pose.R, camera)
    y, x = np.nonzero(truth.seen)
    assert len(x) > 3000
    np.testing.assert_allclose(pixels, np.column_stack([x, y]), atol=1e-6)


def test_the_screens_model_holds_its_corners_and_its_bow(opened):
    flat, bent = opened().calibration().screen, opened(screen_bow_mm=10.0).calibration().screen
    np.testing.assert_allclose(flat.points_mm, [[-264, -148.5, 0], [264, -148.5, 0],
                                                [-264, 148.5, 0], [264, 148.5, 0]])  # fmt: skip
    assert bent.points_mm[:, 2].min() == pytest.approx(-10.0)
    assert bent.points_mm[:, 2].max() == pytest.approx(0.0)


def test_surfaces_have_the_slopes_of_their_heights():
    outline = Outline(100.0, 80.0, round=False)
    y, x = np.meshgrid(np.linspace(40, -40, 33), np.linspace(-50, 50, 41), indexing="ij")
    grid = height_map(1e-3 * x**2 - 2e-3 * y**2 + 1e-3 * x * y, outline)
    at = np.random.default_rng(5).uniform(-30, 30, (40, 2)).T
    for surface in (Paraboloid(900.0, -700.0), Dent(0.005, 10.0, 3.0, 4.0), grid):
        for both in (surface, Together(surface, PLANE)):
            relief, h = both.relief(*at), 1e-4
            ahead, behind = both.relief(at[0] + h, at[1]), both.relief(at[0] - h, at[1])
            above, below = both.relief(at[0], at[1] + h), both.relief(at[0], at[1] - h)
            along_x = (ahead.height_mm - behind.height_mm) / (2 * h)
            along_y = (above.height_mm - below.height_mm) / (2 * h)
            np.testing.assert_allclose(relief.slope_x, along_x, atol=1e-8)
            np.testing.assert_allclose(relief.slope_y, along_y, atol=1e-8)
    expected = 1e-3 * at[0] ** 2 - 2e-3 * at[1] ** 2 + 1e-3 * at[0] * at[1]
    np.testing.assert_allclose(grid.relief(*at).height_mm, expected, atol=1e-9)


def test_a_dent_is_as_deep_as_asked_and_ends_at_its_rim():
    dent = Dent(0.005, 10.0, 20.0, 10.0)
    relief = dent.relief(np.array([20.0, 30.0, 31.0]), np.array([10.0, 10.0, 10.0]))
    np.testing.assert_allclose(relief.height_mm, [-0.005, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("scene", "depth_um", "lowest_mm"),
    [("mirror-flat", None, 0.0), ("mirror-dent-flat", None, -0.005), ("mirror-flat", 20, -0.02)],
)
def test_only_scenes_with_a_dent_have_one_unless_asked(opened, scene, depth_um, lowest_mm):
    truth = opened(scene=scene, dent_depth_um=depth_um).mirror_truth("camera")
    heights_mm = truth.points_mm[truth.seen][:, 2]
    assert heights_mm.min() == pytest.approx(lowest_mm, rel=0.03, abs=1e-9)


# ---------------------------------------------------------------- light


@pytest.mark.parametrize("letter", ["A", "C", "D", "E", "G"])
def test_a_uniform_field_reads_what_the_chain_says(opened, letter):
    rig = opened(chain=letter, noise=False)
    inside = rig.mirror_truth("camera").seen.copy()
    inside[:60] = False  # a row or so of margin comes with the lower half's middle
    for code in (0, 90, 200):
        picture = shoot(rig, code, exposure_ms=20.0)
        ratio = 20.0 / rig.config.nominal_exposure_ms
        expected = rig.chain.gray(rig.chain.luminance(np.array([code])), ratio)
        middle = picture[60, 70:90]
        assert np.abs(middle.astype(int) - int(expected[0])).max() <= 1


def test_light_is_proportional_to_exposure_and_noise_to_its_root(opened):
    rig = opened(chain="A", bit_depth=12, viewing_loss=0.0)
    seen = rig.mirror_truth("camera").seen
    patch = np.zeros_like(seen)
    patch[45:75, 60:100] = seen[45:75, 60:100]
    means, variances = [], []
    for exposure_ms in (5.0, 10.0, 20.0):
        frames = np.stack([shoot(rig, 255, exposure_ms)[patch].astype(float) for _ in range(8)])
        means.append(frames.mean())
        variances.append(frames.var(axis=0, ddof=1).mean())
    np.testing.assert_allclose(np.divide(means, means[0]), [1, 2, 4], rtol=2e-3)
    electrons = np.array(means) * 12000 / 4095
    expected = (electrons + 36) * (4095 / 12000) ** 2 + 1 / 12
    np.testing.assert_allclose(variances, expected, rtol=0.05)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_fringes_tell_where_on_the_screen_each_pixel_looks(opened, axis):
    """Linear, without noise, 12 bit: nothing but rounding of display codes and gray levels is left."""
    rig = opened(chain="A", noise=False, bit_depth=12, scene="mirror-parabola")
    shifts = np.arange(4) * np.pi / 2
    frames = np.stack([shoot(rig, fringe(rig, axis, 16, s)).astype(float) for s in shifts])
    found = -np.angle(np.tensordot(np.exp(1j * shifts), frames, axes=1))
    shares = rig._load().seen.shares[..., "xy".index(axis)]
    error = np.angle(np.exp(1j * (found - 2 * np.pi * 16 * shares)))
    inner = rig.mirror_truth("camera").seen.copy()
    inner[:, 1:] &= inner[:, :-1]
    error_mrad = 1e3 * error[inner]
    assert len(error_mrad) > 3000
    assert np.sqrt(np.mean(error_mrad**2)) < 4.0
    assert abs(error_mrad.mean()) < 0.5


@pytest.mark.parametrize("periods", [4, 20, 41, 82])
def test_fine_fringes_fade_as_a_pixels_mean_does(opened, periods):
    """A pixel that sees several screen pixels averages them: contrast is the sinc of periods per pixel."""
    options = {"noise": False, "screen_blur_mm": 0.0, "lens_blur_px": 0.0, "size": "64x48"}
    rig = opened(chain="A", bit_depth=12, **options)
    seen = rig.mirror_truth("camera").seen
    wide = 2 * float(np.median(rig._load().footprints.half_u_px[seen]))
    shifts = np.arange(4) * np.pi / 2
    frames = np.stack([shoot(rig, fringe(rig, "x", periods, s)).astype(float) for s in shifts])
    contrast = np.abs(np.tensordot(np.exp(1j * shifts), frames, axes=1)) * 2 / frames.sum(axis=0)
    share = periods / 480
    expected = 0.98 / 1.02 * abs(np.sinc(share * wide)) * np.sinc(share)
    assert np.median(contrast[seen]) == pytest.approx(expected, abs=0.03)


def test_around_the_mirror_it_is_dark_and_its_edge_is_soft(opened):
    rig = opened(chain="A", noise=False)
    picture = shoot(rig, 255, exposure_ms=33.333)
    truth = rig.mirror_truth("camera")
    assert picture[0, 0] == round(255 * 0.95 * 0.004)
    assert np.median(picture[truth.seen]) == pytest.approx(255 * 0.95, abs=1)
    between = (picture > 20) & (picture < 200)
    assert 50 < between.sum() < 600


def test_the_same_seed_gives_the_same_frames(opened):
    rigs = opened(seed=3), opened(seed=3), opened(seed=4)
    first, again, other = (shoot(rig, 100) for rig in rigs)
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.1


# ---------------------------------------------------------------- time


@pytest.mark.parametrize(
    ("since_s", "response_s", "expected"),
    [(10.0, 0.0, 0.0), (10.5, 0.0, 0.5), (12.0, 0.0, 1.0), (-90.0, 1.0, 0.0), (12.0, 3.0, 1.0)],
)
def test_share_of_the_pattern_before(since_s, response_s, expected):
    assert share_of_before(since_s, response_s, 10.0, 1.0) == pytest.approx(expected)


def test_the_share_is_the_mean_of_the_exponential():
    t = np.linspace(10.0, 11.0, 200_001)
    left = np.where(t < 10.2, 1.0, np.exp(-(t - 10.2) / 0.3))
    assert share_of_before(10.2, 0.3, 10.0, 1.0) == pytest.approx(left.mean(), rel=1e-4)


def test_a_shot_taken_too_early_mixes_the_patterns(opened):
    early = opened(settle_ms=0.0, response_ms=8.0, chain="A", noise=False)
    ready = opened(response_ms=8.0, chain="A", noise=False)
    middle = np.s_[55:65, 75:85]
    for rig in (early, ready):
        shoot(rig, 0, exposure_ms=30.0)
    white_early, white = (shoot(rig, 255, exposure_ms=10.0)[middle] for rig in (early, ready))
    assert white.mean() == pytest.approx(255 * 0.95 * 0.3, abs=1)
    assert 0.1 * white.mean() < white_early.mean() < 0.8 * white.mean()


# ---------------------------------------------------------------- what goes wrong


@pytest.mark.parametrize("defect", ["dropped", "duplicated", "dimmed"])
def test_one_patterned_frame_has_the_defect_and_no_other(opened, defect):
    good = opened(noise=False, chain="A")
    bad = opened(noise=False, chain="A", defect_frame=2, defect=defect)
    frames = []
    for rig in (good, bad):
        shoot(rig, 255)  # uniform fields don't count
        frames.append([shoot(rig, fringe(rig, shift_rad=k)) for k in range(4)])
    differs = [not np.array_equal(a, b) for a, b in zip(*frames, strict=True)]
    assert differs == [False, False, True, False]
    third = frames[1][2]
    assert {
        "dropped": third.max() == 0,
        "duplicated": np.array_equal(third, frames[1][1]),
        "dimmed": third.max() == pytest.approx(0.7 * frames[0][2].max(), abs=1),
    }[defect]


def test_a_mirror_outside_the_view_leaves_the_picture_dark(opened):
    rig = opened(aim_mm=(900.0, 0.0))
    assert not rig.mirror_truth("camera").seen.any()
    assert not rig.truth("camera").lit_and_seen.any()
    assert shoot(rig, 255).max() < 60


def test_the_screen_can_be_lost(opened):
    rig = opened(projector_fail_after_shows=1)
    rig.projector.blank(0)
    with pytest.raises(DeviceDisconnected, match="screen: no answer after 1 patterns"):
        rig.projector.blank(0)
    rig.projector.reconnect()
    rig.projector.blank(0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scene": "plane"}, "no mirror 'plane'"),
        ({"chain": "Z"}, "chain can't be 'Z'"),
        ({"tone": "sepia"}, "tone curve 'sepia'"),
        ({"display": "/nowhere.csv"}, "display /nowhere.csv can't be read"),
        ({"focal_x_mm": 0}, "focal_x_mm can't be 0"),
        ({"colour": 1}, "no option 'colour'"),
        ({"fault_device": "left"}, "left is not camera"),
    ],
)
def test_what_cant_be_built_is_refused_in_one_sentence(options, words):
    with pytest.raises(RigConfigError, match=words) as caught:
        create_lcd_rig(SMALL | options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [("1,2\n3,4\n", "2x2 heights"), ("1,nan\n" * 5, "with holes"), ("a,b\n", "can't be read")],
)
def test_a_file_without_heights_is_refused(tmp_path, content, words):
    file = tmp_path / "mirror.csv"
    file.write_text(content)
    with pytest.raises(RigConfigError, match=words):
        create_lcd_rig(SMALL | {"scene": f"mirror:{file}"}).open()


@pytest.mark.parametrize("suffix", ["npy", "csv"])
def test_heights_from_a_file_make_the_mirror(tmp_path, opened, suffix):
    """Rows run from the top: the mirror of a file whose first row is high is high at +y."""
    file = tmp_path / f"mirror.{suffix}"
    heights = np.repeat(np.linspace(0.1, -0.1, 9)[:, None], 11, axis=1)
    np.save(file, heights) if suffix == "npy" else np.savetxt(file, heights, delimiter=",")
    truth = opened(scene=f"mirror:{file}").mirror_truth("camera")
    points = truth.points_mm[truth.seen]
    np.testing.assert_allclose(points[:, 2], points[:, 1] * 0.2 / 120.0, atol=1e-9)


def test_a_measured_screen_can_be_a_file(tmp_path, opened):
    file = tmp_path / "screen.csv"
    file.write_text("0,2\n128,30\n255,102\n")
    rig = opened(display=str(file))
    assert rig.chain.black == pytest.approx(2 / 102)
    np.testing.assert_allclose(rig.chain.luminance(np.array([0, 128, 255])) * 102, [2, 30, 102])


# ---------------------------------------------------------------- truth


def test_truth_of_points_and_truth_of_the_mirror_agree(opened):
    rig = opened(scene="mirror-dent")
    pose = rig.calibration().mirror_from_world
    assert isinstance(rig, KnowsTruth)
    assert isinstance(rig, KnowsMirrorTruth)
    points, exact = rig.truth("camera"), rig.mirror_truth("camera")
    in_mirror = points.points_mm[exact.seen] @ pose.R.T + pose.t_mm
    np.testing.assert_allclose(in_mirror, exact.points_mm[exact.seen], atol=2e-4)
    np.testing.assert_array_equal(points.lit_and_seen, exact.seen)
    towards_camera = -points.points_mm[exact.seen]
    assert ((points.normals[exact.seen] * towards_camera).sum(1) > 0).all()


def test_a_rig_without_its_mirrors_pose_keeps_the_rest(opened):
    known = opened(mirror_pose_known=False).calibration()
    assert known.mirror_from_world is None
    assert known.screen is not None
    assert opened(calibrated=False).calibration() is None
