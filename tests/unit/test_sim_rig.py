"""The simulated rig as a whole: determinism, settings, faults on request, truth."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from backend.devices.errors import (
    DeviceDisconnected,
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
)
from backend.devices.protocols import KnowsTruth, LinkState, TriggerSource
from backend.devices.sim import create_rig
from backend.devices.sim.clock import Clock

SMALL = {"scene": "plane", "size": "160x120", "projector_size": "160x100"}


def shoot(rig: Any, level: int = 255, exposure_ms: float = 50.0, camera: str = "left") -> Any:
    """Take one picture of a uniform field."""
    device = rig.cameras[camera]
    device.configure(replace(device.settings, exposure_us=1000 * exposure_ms))
    rig.projector.blank(level)
    if device.state is not LinkState.ARMED:
        device.arm()
    device.trigger()
    return device.get_frame()


@pytest.fixture
def opened():
    rigs = []

    def open_rig(**options):
        rigs.append(create_rig(SMALL | options))
        rigs[-1].open()
        return rigs[-1]

    yield open_rig
    for rig in rigs:
        rig.close()


def test_the_same_seed_gives_the_same_frames(opened):
    first, again, other = opened(seed=3), opened(seed=3), opened(seed=4)
    for exposure_ms in (50.0, 37.0):  # 37 ms depends on the moment of the trigger too
        pictures = [shoot(rig, 100, exposure_ms).data for rig in (first, again, other)]
        np.testing.assert_array_equal(pictures[0], pictures[1])
        assert (pictures[0] != pictures[2]).mean() > 0.1


def test_frames_do_not_depend_on_the_number_of_threads(opened):
    import numba

    before = numba.get_num_threads()
    many = shoot(opened(seed=9)).data
    numba.set_num_threads(1)
    try:
        one = shoot(opened(seed=9)).data
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(many, one)


def test_every_frame_and_every_camera_has_its_own_noise(opened):
    rig = opened()
    frames = [shoot(rig).data.astype(float) for _ in range(2)]
    frames.append(shoot(rig, camera="right").data.astype(float))
    noise = [frame - frame.mean() for frame in (frames[0] - frames[1], frames[0] - frames[2])]
    assert noise[0].std() > 0.5
    correlation = np.corrcoef(noise[0].ravel()[1:], noise[0].ravel()[:-1])[0, 1]
    assert abs(correlation) < 0.03


@pytest.mark.parametrize("bits", [8, 12])
def test_facts_say_how_dark_frames_look(opened, bits):
    rig = opened(bit_depth=bits, contrast_ratio=1e9, ambient_e_per_ms=0.0)
    fact = rig.facts().cameras["left"]
    dark = shoot(rig, level=0, exposure_ms=1.0)
    assert dark.bits == fact.bit_depth == bits
    assert dark.data.mean() == pytest.approx(fact.black_level_gray, abs=0.1)
    if bits == 12:
        sigma_gray = fact.read_noise_e * fact.full_scale_gray / fact.full_well_e
        assert dark.data.std() == pytest.approx(sigma_gray, rel=0.03)


def test_calibration_and_truth_agree(opened):
    """The truth's points, projected by the calibration, land on their own pixels."""
    import cv2

    rig = opened(size="320x240", scene="sphere")
    calibration, truth = rig.calibration(), rig.truth("left")
    y, x = np.nonzero(truth.base)
    model = calibration.cameras["left"]
    points = truth.points_mm[y, x].astype(np.float64)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), model.K, model.distortion)
    np.testing.assert_allclose(pixels[:, 0], np.column_stack([x, y]), atol=1e-3)
    assert calibration.camera_from_world["right"].t_mm[0] == pytest.approx(-180, rel=0.02)


def test_the_truth_of_both_cameras_is_one_surface(opened):
    rig = opened(size="320x240", scene="sphere")
    pose = rig.calibration().camera_from_world["right"]
    left, right = rig.truth("left"), rig.truth("right")
    there = left.points_mm[left.base] @ pose.R.T + pose.t_mm
    centre = np.array([right.points_mm[right.base], there], dtype=object)
    radii = [np.linalg.norm(p - sphere_centre(p), axis=1) for p in centre]
    assert all(np.abs(r - 60).max() < 0.05 for r in radii)


def sphere_centre(points: Any) -> Any:
    """Fit a sphere by linear least squares."""
    design = np.column_stack([2 * points, np.ones(len(points))]).astype(float)
    return np.linalg.lstsq(design, (points.astype(float) ** 2).sum(1), rcond=None)[0][:3]


def test_one_camera_sees_more_than_two(opened):
    rig = opened(scene="high-contrast")
    assert isinstance(rig, KnowsTruth)
    alone, both = rig.truth("left", ["left"]), rig.truth("left")
    assert (both.lit_and_seen & ~alone.lit_and_seen).sum() == 0
    assert alone.lit_and_seen.sum() > both.lit_and_seen.sum()


def test_uncalibrated_on_request(opened):
    assert opened(calibrated=False).calibration() is None


def test_a_second_rig_like_the_first_reuses_the_cast(opened):
    first, second = opened(seed=1), opened(seed=2, read_noise_e=3.0)
    assert first._world is second._world
    assert first._world is not opened(distance_mm=720.0)._world


# ---------------------------------------------------------------- what goes wrong


def test_a_camera_is_lost_and_comes_back(opened):
    rig = opened(fail_after_frames=2)
    shoot(rig)
    shoot(rig)
    with pytest.raises(DeviceDisconnected, match=r"left: control was lost after 2 frames"):
        shoot(rig)
    camera = rig.cameras["left"]
    assert camera.state is LinkState.LOST
    with pytest.raises(DeviceDisconnected, match="reconnect"):
        camera.arm()
    camera.reconnect()
    assert shoot(rig).frame_id > 2


def test_a_camera_is_lost_for_good(opened):
    rig = opened(fail_after_frames=0, fail_for_good=True)
    with pytest.raises(DeviceDisconnected):
        shoot(rig)
    with pytest.raises(DeviceDisconnected, match="fail_for_good"):
        rig.cameras["left"].reconnect()


def test_frames_arrive_incomplete(opened):
    rig = opened(drop_every=3)
    outcomes = []
    for _ in range(6):
        try:
            shoot(rig)
            outcomes.append("ok")
        except IncompleteFrame:
            outcomes.append("dropped")
    assert IncompleteFrame.retryable
    assert outcomes == ["ok", "ok", "dropped"] * 2


def test_a_frame_never_comes(opened):
    rig = opened(hang_at_frame=1)
    shoot(rig)
    with pytest.raises(DeviceTimeout, match="frame 1 wasn't delivered"):
        shoot(rig)
    shoot(rig)


def test_faults_befall_one_camera_only(opened):
    rig = opened(fail_after_frames=0, fault_device="right")
    shoot(rig)
    with pytest.raises(DeviceDisconnected, match="right"):
        shoot(rig, camera="right")


def test_the_projector_is_lost(opened):
    rig = opened(projector_fail_after_shows=1)
    shoot(rig)
    with pytest.raises(DeviceDisconnected, match="projector: no answer after 1 patterns"):
        shoot(rig)
    rig.projector.reconnect()
    shoot(rig)


def test_a_line_exposure_longer_than_the_pattern_is_refused(opened):
    rig = opened()
    camera = rig.cameras["left"]
    camera.configure(replace(camera.settings, exposure_us=30_000, trigger=TriggerSource.LINE1))
    camera.arm()
    rig.projector.load([np.zeros((100, 160), np.uint8)])
    rig.projector.arm_sequence([0], 20_000, 25_000)
    with pytest.raises(FeatureError, match="outlasts the pattern"):
        rig.projector.start_sequence()


def test_an_edge_during_an_exposure_is_lost(opened):
    rig = opened()
    camera = rig.cameras["left"]
    camera.configure(replace(camera.settings, exposure_us=20_000, trigger=TriggerSource.LINE1))
    camera.arm()
    rig.projector.load([np.zeros((100, 160), np.uint8)] * 4)
    rig.projector.arm_sequence(range(4), 20_000, 20_000)  # no time for the readout
    rig.projector.start_sequence()
    assert [camera.get_frame().timestamp_s for _ in range(2)] == pytest.approx([0.0, 0.04])
    with pytest.raises(DeviceTimeout):
        camera.get_frame(timeout_s=0.01)


def test_hot_pixels_read_full_scale_always(opened):
    rig = opened(hot_pixel_share=0.001)
    hot = [np.flatnonzero(shoot(rig, level=0, exposure_ms=1.0).data == 255) for _ in range(2)]
    assert len(hot[0]) == pytest.approx(19, abs=1)
    np.testing.assert_array_equal(hot[0], hot[1])


def test_a_virtual_clock_runs_forward_only():
    clock = Clock(realtime=False)
    clock.wait_until(5.0, threading.Event())
    clock.wait_until(3.0, threading.Event())
    assert clock.now_s() == 5.0


def test_waiting_in_real_time_ends_when_cancelled():
    clock, cancelled = Clock(realtime=True), threading.Event()
    cancelled.set()
    clock.wait_until(1000.0, cancelled)
    assert clock.now_s() < 100.0


def test_a_real_time_rig_takes_the_exposures_time(opened):
    rig = opened(realtime=True)
    start = time.monotonic()
    shoot(rig, exposure_ms=50.0)
    assert time.monotonic() - start >= 0.05


def test_cameras_that_expose_at_once_wait_for_the_one_world() -> None:
    with create_rig(SMALL | {"seed": 12345}) as rig, ThreadPoolExecutor(2) as threads:
        pictures = threads.map(lambda name: shoot(rig, camera=name), rig.cameras)
        assert all(frame.data.max() > 20 for frame in pictures)
