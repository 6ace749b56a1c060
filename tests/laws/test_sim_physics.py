"""Laws of light and of sensors, measured on the simulated rig's pictures."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from backend.devices.sim import create_rig, refresh
from backend.devices.sim.optics import projected, veil
from backend.devices.sim.sensor import Sensor

PLANE = {
    "scene": "plane",
    "size": "320x240",
    "projector_size": "320x200",
    "bit_depth": 12,
    "ambient_e_per_ms": 0.0,
    "projector_aperture_mm": 0.0,
    "contrast_ratio": 1e9,
}
CENTRE = (slice(100, 140), slice(140, 180))


@pytest.fixture(scope="module")
def take():
    """Take one picture of a pattern with a rig of given options, in gray levels."""
    rigs = {}

    def picture(pattern=255, exposure_ms=25.0, gain_db=0.0, camera="left", **options):
        key = tuple(sorted(options.items()))
        if key not in rigs:
            rigs[key] = create_rig(PLANE | options)
            rigs[key].open()
        rig = rigs[key]
        width, height = rig.config.projector_size
        rig.projector.load([np.broadcast_to(np.uint8(pattern), (height, width)).copy()])
        rig.projector.show(0)
        device = rig.cameras[camera]
        device.configure(replace(device.settings, exposure_us=1000 * exposure_ms, gain_db=gain_db))
        device.arm()
        device.trigger()
        return device.get_frame().data.astype(np.float64)

    yield picture
    for rig in rigs.values():
        rig.close()


# ---------------------------------------------------------------- sensor


def flat_pictures(electrons: Any, *, n: int = 2, **options: Any) -> list[Any]:
    settings: dict[str, Any] = {
        "full_well_e": 15300.0,
        "read_noise_e": 12.0,
        "black_level_gray8": 4.0,
        "dark_current_e_per_ms": 0.0,
        "blooming_share": 0.0,
        "glare_share": 0.0,
        "hot_pixel_share": 0.0,
        "seed": 1,
    }
    gain_db = options.pop("gain_db", 0.0)
    bits = options.pop("bits", 12)
    sensor = Sensor(**(settings | options))
    light = np.broadcast_to(np.float32(electrons), (300, 400)).astype(np.float32)
    return [
        sensor.picture(light, light, exposure_ms=1.0, gain_db=gain_db, bits=bits, frame_key=k)
        for k in range(n)
    ]


@pytest.mark.parametrize("gain_db", [0.0, 6.0])
def test_photon_transfer_gives_full_well_and_read_noise(gain_db):
    """Variance over mean is a line: its slope the gray levels per electron, its start the read noise."""
    means, variances = [], []
    for electrons in (0, 500, 1000, 2000, 4000, 6500):
        a, b = (p.astype(float) for p in flat_pictures(electrons, gain_db=gain_db))
        means.append((a.mean() + b.mean()) / 2 - 64)
        variances.append((a - b).var() / 2)
    slope, start = np.polyfit(means, variances, 1, w=1 / np.array(variances))
    gray_per_e = 4095 / 15300 * 10 ** (gain_db / 20)
    assert slope == pytest.approx(gray_per_e, rel=0.02)
    assert np.sqrt(start - 1 / 12) == pytest.approx(12 * gray_per_e, rel=0.03)


def test_noise_is_normal():
    (picture,) = flat_pictures(8000, n=1)
    z = (picture - picture.mean()) / picture.std()
    assert np.mean(z**3) == pytest.approx(0.0, abs=0.03)
    assert np.mean(z**4) == pytest.approx(3.0, abs=0.06)
    assert np.mean(np.abs(z) > 3) == pytest.approx(0.0027, abs=0.0006)


def test_noise_is_white_in_space_and_time():
    frames = np.stack([p.astype(float) for p in flat_pictures(8000, n=4)])
    frames -= frames.mean()
    limit = 4 / np.sqrt(frames[0].size) * frames.var()
    for dy, dx in ((0, 1), (1, 0), (1, 1), (0, 2)):
        shifted = np.roll(frames[0], (dy, dx), (0, 1))
        assert abs((frames[0] * shifted).mean()) < limit
    for k in (1, 2, 3):
        assert abs((frames[0] * frames[k]).mean()) < limit


@pytest.mark.parametrize("bits", [8, 12])
def test_saturation_is_clean(bits):
    (picture,) = flat_pictures(16200, n=1, bits=bits)
    assert (picture == 2**bits - 1).all()
    assert picture.dtype == (np.uint8 if bits == 8 else np.uint16)


def test_bit_depths_see_the_same_charge():
    eight, twelve = (flat_pictures(5000, n=1, bits=bits)[0].mean() for bits in (8, 12))
    assert (twelve - 64) / (eight - 4) == pytest.approx(4095 / 255, rel=2e-3)


def test_blooming_runs_along_columns_and_loses_no_more_than_it_says():
    light = np.zeros((300, 400), np.float32)
    light[140:160, 200] = 1e6
    light[:, 300] = 1000.0
    options = {"read_noise_e": 0.0, "black_level_gray8": 0.0}
    clean, bloomed = (
        flat_pictures(light, n=1, blooming_share=share, **options)[0].astype(float)
        for share in (0.0, 0.01)
    )
    extra = bloomed - clean
    assert extra[:, 200].max() > 100
    columns = np.flatnonzero(extra.sum(axis=0))
    assert list(columns) == [200]
    spilled_e = extra[:, 200].sum() * 15300 / 4095
    assert 0 < spilled_e <= 0.01 * 20 * 1e6
    assert extra[120:140, 200].sum() == pytest.approx(extra[160:180, 200].sum(), rel=0.05)


# ---------------------------------------------------------------- light


def test_light_is_linear_in_exposure(take):
    rates = [
        (take(exposure_ms=k * 1000 / 120)[CENTRE].mean() - 64) / (k * 1000 / 120)
        for k in (1, 2, 3, 5)
    ]
    np.testing.assert_allclose(rates, rates[0], rtol=2e-3)


def test_light_falls_with_the_square_of_the_distance(take):
    near = take(distance_mm=600.0)[CENTRE].mean() - 64
    far = take(distance_mm=900.0)[CENTRE].mean() - 64
    assert near / far == pytest.approx((900 / 600) ** 2, rel=0.02)


def test_gamma_is_a_power(take):
    white = take()[CENTRE].mean() - 64
    for gamma in (1.0, 2.2):
        gray = take(128, gamma=gamma)[CENTRE].mean() - 64
        assert gray / white == pytest.approx((128 / 255) ** gamma, rel=5e-3)


def test_white_is_as_bright_as_the_data_sheet_says(take):
    """A facing wall of albedo 0.85 at 700 mm, seen from beside and lit from above."""
    electrons = (take(exposure_ms=25.0, glare_share=0.0)[CENTRE].mean() - 64) * 15300 / 4095
    lit = 0.85 * 300 * 25 * (700 / np.hypot(700, 40)) ** 3
    assert electrons == pytest.approx(lit, rel=5e-3)


def test_glare_takes_its_share_and_loses_nothing():
    light = np.zeros((240, 320), np.float32)
    light[100:140, 140:180] = 1000.0
    scattered = veil(light)
    assert scattered.sum() == pytest.approx(light.sum(), rel=0.02)
    assert scattered.max() < 0.5 * light.max()
    assert scattered.min() > 0


def test_glare_brightens_what_is_dark(take):
    half = np.zeros((200, 320), np.uint8)
    half[:, :160] = 255
    spread = take(half, glare_share=0.02) - take(half, glare_share=0.0)
    dark_side = spread[100:140, 200:260].mean()
    bright = take(half, glare_share=0.0)[100:140, 60:120].mean() - 64
    assert 0.05 * 0.02 < dark_side / bright < 0.02


# ---------------------------------------------------------------- projector


@pytest.mark.parametrize("sigma_px", [0.5, 0.7, 1.2])
def test_an_edge_is_as_blurred_as_asked(sigma_px):
    """Square pixels tile to a perfect step, so the edge's gradient has the variance of the lens."""
    pattern = np.zeros((40, 200), np.uint8)
    pattern[:, 100:] = 255
    light = refresh.mean_light(1.0, 1e9)
    row = projected(pattern, light, sigma_px**2)[20]
    u = np.arange(60, 140, 0.05)
    gradient = np.diff(np.interp(u, np.arange(200), row))
    middle = (u[1:] + u[:-1]) / 2
    assert (gradient * middle).sum() / gradient.sum() == pytest.approx(99.5, abs=1e-3)
    variance = (gradient * (middle - 99.5) ** 2).sum() / gradient.sum()
    assert variance == pytest.approx(sigma_px**2, rel=0.01)


def test_defocus_grows_away_from_the_focus(take):
    """A sphere's rim lies 60 mm behind its pole: fringes lose contrast there."""
    u = np.arange(320)
    shifts = [np.rint(127 + 120 * np.cos(2 * np.pi * u / 4 + k * np.pi / 2)) for k in range(4)]
    contrasts = []
    for aperture in (0.0, 60.0):
        options = {"projector_aperture_mm": aperture, "scene": "step", "glare_share": 0.0}
        i = [take(p, **options) - 64 for p in shifts]
        contrast = np.hypot(i[0] - i[2], i[1] - i[3]) / np.maximum(sum(i) / 2, 1)
        contrasts.append(
            [np.median(contrast[100:140, 90:110]), np.median(contrast[100:140, 240:260])]
        )
    sharp, soft = np.array(contrasts)
    assert soft[0] / sharp[0] > 0.98  # the treads 0 and 26 mm behind the focus
    assert soft[1] / sharp[1] < 0.9 * soft[0] / sharp[0]


@pytest.mark.parametrize(
    ("exposure_ms", "rms_percent"), [(10.0, 11.2), (20.0, 7.2), (40.0, 2.8), (103.7, 1.3)]
)
def test_light_flickers_unless_exposed_for_whole_periods(exposure_ms, rms_percent):
    """Gray level 100 of an 8-bit DLP at 120 Hz, triggered at any moment; the figures of a study."""
    mean = refresh.mean_light(1.0, 1e12)
    phases = np.random.default_rng(2).random(4000)
    light = [refresh.light_during(mean, exposure_ms, 1000 / 120, p)[100] for p in phases]
    assert 100 * np.std(light) / mean[100] == pytest.approx(rms_percent, rel=0.3)
    assert np.mean(light) == pytest.approx(mean[100], rel=0.02)


@pytest.mark.parametrize("periods", [1, 2, 3, 12])
def test_whole_periods_do_not_flicker(periods):
    mean = refresh.mean_light(1.0, 1e12)
    for phase in (0.0, 0.1, 0.77):
        light = refresh.light_during(mean, periods * 1000 / 120, 1000 / 120, phase)
        np.testing.assert_allclose(light, mean, rtol=1e-5, atol=1e-7)
    assert refresh.whole_periods(round(periods * 1e6 / 120) / 1000, 1000 / 120)
    assert not refresh.whole_periods(periods * 1000 / 120 + 0.5, 1000 / 120)


# ---------------------------------------------------------------- geometry


def test_a_planes_truth_is_a_plane():
    with create_rig(PLANE) as rig:
        truth, calibration = rig.truth("left"), rig.calibration()
    points = truth.points_mm[truth.part == 0].astype(np.float64)
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    residual = (points - middle) @ axes[2]
    assert residual.std() < 1e-4
    assert abs(np.median(truth.normals[truth.part == 0] @ axes[2])) == pytest.approx(1, abs=1e-5)
    assert calibration is not None
    assert calibration.camera_from_world["left"].t_mm @ np.ones(3) == 0


def test_fringes_stand_where_calibration_and_truth_say(take):
    """The phase of every lit pixel is that of the projector column its true point projects to."""
    import cv2

    u = np.arange(320)
    options = {"glare_share": 0.0, "read_noise_e": 0.0, "full_well_e": 1e6, "scene": "sphere"}
    options |= {"white_e_per_ms": 2e4, "lens_blur_px": 0.0}
    i = [
        take(np.rint(127 + 120 * np.cos(2 * np.pi * (u + 0.5) / 20 + k * np.pi / 2)), **options)
        for k in range(4)
    ]
    phase = np.arctan2(i[3] - i[1], i[0] - i[2])
    with create_rig(PLANE | {"scene": "sphere"}) as rig:
        truth, calibration = rig.truth("left"), rig.calibration()
    assert calibration is not None
    pose, model = calibration.projector_from_world, calibration.projector
    assert pose is not None
    assert model is not None
    points = truth.points_mm[truth.base].astype(np.float64)
    rotation, _ = cv2.Rodrigues(pose.R)
    pixels, _ = cv2.projectPoints(points, rotation, pose.t_mm, model.K, model.distortion)
    expected = 2 * np.pi * (pixels[:, 0, 0] + 0.5) / 20
    error = np.angle(np.exp(1j * (phase[truth.base] - expected)))
    assert np.sqrt(np.mean(error**2)) < 0.01


def test_a_mirror_shows_and_throws_the_projectors_picture(tmp_path):
    """A floor mirror before a wall: the wall is seen in the floor, and lit by it a second time."""
    (tmp_path / "corner.obj").write_text(
        "v -80 -60 0\nv 80 -60 0\nv 80 60 0\nv -80 60 0\n"
        "v -80 -60 90\nv 80 -60 90\n"
        "g wall\nf 1 2 3 4\ng floor\nf 1 5 6 2\n"
    )
    pictures = []
    for mirror in (0.0, 0.5):
        (tmp_path / "table.json").write_text(
            '{"turn_deg": [30, 0, 0], "materials": {"wall": {"albedo": 0.5},'
            f' "floor": {{"albedo": 0.02, "mirror": {mirror}}}}}}}'
        )
        options = PLANE | {"scene": f"mesh:{tmp_path}/corner.obj?{tmp_path}/table.json"}
        with create_rig(options) as rig:
            truth = rig.truth("left")
            camera = rig.cameras["left"]
            camera.configure(replace(camera.settings, exposure_us=25_000))
            rig.projector.blank(255)
            camera.arm()
            camera.trigger()
            pictures.append(camera.get_frame().data.astype(float) - 64)
    plain, mirrored = pictures
    wall, floor = (truth.base & (truth.part == k) for k in (0, 1))
    assert mirrored[floor].mean() > 5 * plain[floor].mean()  # the wall is seen in it
    gain = mirrored / np.maximum(plain, 1)
    rows = np.nonzero(wall)[0]
    low, high = np.quantile(rows, 0.9), np.quantile(rows, 0.05)
    assert np.median(gain[int(low)][wall[int(low)]]) > 1.1  # lit twice near the floor
    assert np.median(gain[int(high)][wall[int(high)]]) == pytest.approx(1.0, abs=0.03)
