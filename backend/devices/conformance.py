"""The suite that every rig has to pass, ours and anybody's.

In a test module of a rig's package::

    from backend.devices.conformance import RigConformance

    class TestMyRig(RigConformance):
        @pytest.fixture
        def rig(self):
            with create_rig({"address": "192.168.0.7"}) as rig:
                yield rig

Tests that need light on the sensor are skipped unless `has_light` is set: then the cameras have to look at
something that the projector lights.
"""

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from backend.devices.errors import (
    DeviceDisconnected,
    DeviceTimeout,
    FeatureError,
    GeometryError,
)
from backend.devices.protocols import (
    Camera,
    CameraSettings,
    DeviceInfo,
    Frame,
    LinkState,
    Projector,
    Rig,
    SequenceProjector,
    TriggerSource,
    Wired,
)
from backend.domain.errors import UnglareError

_UNTOLD_STEP_US = 1.0
"""Many cameras take whole microseconds without saying so."""
_UNWIRED = {TriggerSource.SOFTWARE, TriggerSource.FREE_RUN}


class RigConformance:
    """Subclass it and provide a fixture `rig` that yields an opened rig."""

    has_light = False
    """Whether the projector lights what the cameras see."""
    linear_within = 0.01
    """Largest deviation from light being proportional to exposure, as a share."""
    exposure_us = 50_000.0
    """An exposure at which the white field gives a good picture: a multiple of the frame period."""

    def light(self, share: np.ndarray) -> np.ndarray:
        """Return the light of gray levels over full scale: override it where the camera has a tone curve."""
        return share

    # ------------------------------------------------------------ identity and state

    def test_names_and_info(self, rig: Rig) -> None:
        """Every device says who it is, and the rig knows it under that name."""
        assert rig.cameras
        for name, camera in rig.cameras.items():
            assert camera.name == name
            assert isinstance(camera.info, DeviceInfo)
        assert isinstance(rig.projector.info, DeviceInfo)
        assert isinstance(rig.info, DeviceInfo)
        assert rig.name

    def test_opened_devices_are_ready(self, rig: Rig) -> None:
        """`open` leaves every device READY, a second one changes nothing."""
        rig.open()
        assert all(device.state is LinkState.READY for device in _devices(rig))

    def test_close_is_idempotent(self, rig: Rig) -> None:
        """`close` may be called twice; afterwards devices refuse work and can be opened again."""
        rig.close()
        rig.close()
        assert all(device.state is LinkState.CLOSED for device in _devices(rig))
        with pytest.raises(DeviceDisconnected, match=_first(rig).name):
            _first(rig).arm()
        rig.open()
        assert all(device.state is LinkState.READY for device in _devices(rig))

    # ------------------------------------------------------------ facts and calibration

    def test_facts_fit_the_devices(self, rig: Rig) -> None:
        """Facts name the same cameras, sizes and ranges as the devices."""
        facts = rig.facts()
        assert set(facts.cameras) == set(rig.cameras)
        assert facts.reference in rig.cameras
        for name, camera in rig.cameras.items():
            can, fact = camera.capabilities, facts.cameras[name]
            assert can.sensor_size == (fact.width_px, fact.height_px)
            # A rig may allow less than its cameras do: a projector's patterns take their time, owners set limits.
            assert fact.exposure_min_ms >= can.exposure_us.min / 1000 * (1 - 1e-9)
            assert fact.exposure_max_ms <= can.exposure_us.max / 1000 * (1 + 1e-9)
            assert fact.exposure_min_ms <= fact.exposure_max_ms
            assert fact.gain_max_db <= can.gain_db.max
            assert fact.full_well_e > 0
        if facts.projector is not None:
            size = (facts.projector.width_px, facts.projector.height_px)
            assert rig.projector.capabilities.size == size

    def test_calibration_is_rigid(self, rig: Rig) -> None:
        """What calibration there is has rotations that rotate, and the sensors' sizes."""
        calibration = rig.calibration()
        if calibration is None:
            pytest.skip("the rig hands no calibration over")
        poses = [*calibration.camera_from_world.values(), calibration.projector_from_world]
        for pose in poses:
            if pose is not None:
                np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-9)
                assert np.linalg.det(pose.R) > 0
        for name, model in calibration.cameras.items():
            size = (model.width_px, model.height_px)
            assert rig.cameras[name].capabilities.sensor_size == size

    # ------------------------------------------------------------ settings

    def test_settings_are_read_back(self, rig: Rig) -> None:
        """`configure` returns what holds, within the camera's increments."""
        for camera in rig.cameras.values():
            allowed = camera.capabilities.exposure_us
            wanted = 0.25 * allowed.min + 0.75 * min(allowed.max, max(allowed.min, 100_000.0))
            taken = camera.configure(replace(camera.settings, exposure_us=wanted))
            assert taken == camera.settings
            assert abs(taken.exposure_us - wanted) <= max(allowed.inc, _UNTOLD_STEP_US)
            assert taken.pixel_format in camera.capabilities.pixel_formats

    def test_none_keeps_the_pixel_format(self, rig: Rig) -> None:
        """Settings without a pixel format leave the camera's alone."""
        camera = _first(rig)
        before = camera.settings
        taken = camera.configure(CameraSettings(before.exposure_us, trigger=before.trigger))
        assert taken.pixel_format == before.pixel_format

    @pytest.mark.parametrize("feature", ["exposure_us", "gain_db"])
    @pytest.mark.parametrize("side", ["below", "above", "nan"])
    def test_out_of_range_is_refused(self, rig: Rig, feature: str, side: str) -> None:
        """Values outside the range are refused with the range, and the old settings hold."""
        camera = _first(rig)
        allowed = getattr(camera.capabilities, feature)
        value = {"below": allowed.min - 1, "above": allowed.max * 1.01 + 1, "nan": float("nan")}
        before = camera.settings
        with pytest.raises(FeatureError, match=re.escape(f"{allowed.max:.10g}")):
            camera.configure(replace(before, **{feature: value[side]}))
        assert camera.settings == before

    def test_unknown_choices_are_refused(self, rig: Rig) -> None:
        """Neither pixel formats nor triggers can be made up."""
        camera = _first(rig)
        with pytest.raises(FeatureError, match="Mono7"):
            camera.configure(replace(camera.settings, pixel_format="Mono7"))
        missing = set(TriggerSource) - set(camera.capabilities.trigger_sources)
        for trigger in missing:
            with pytest.raises(FeatureError):
                camera.configure(replace(camera.settings, trigger=trigger))

    def test_payload_is_locked_while_armed(self, rig: Rig) -> None:
        """Exposure may change while armed, the pixel format not."""
        camera = _first(rig)
        others = set(camera.capabilities.pixel_formats) - {camera.settings.pixel_format}
        with _armed(rig):
            camera.configure(replace(camera.settings, exposure_us=self._exposure_us(camera)))
            for other in others:
                with pytest.raises(FeatureError, match="disarm"):
                    camera.configure(replace(camera.settings, pixel_format=other))

    # ------------------------------------------------------------ frames

    def test_ten_frames_count_up(self, rig: Rig) -> None:
        """Ten triggers give ten consecutive ids, times that don't run back, the settings read back.

        A camera that runs freely doesn't wait for whoever fetches: frames may be lost, and their ids with them.
        """
        camera = _first(rig)
        with _armed(rig):
            frames = [_shot(camera) for _ in range(10)]
        ids = [frame.frame_id for frame in frames]
        assert ids == sorted(set(ids))
        if camera.settings.trigger is TriggerSource.SOFTWARE:
            assert ids == list(range(ids[0], ids[0] + 10))
        hosts = [frame.host_time_s for frame in frames]
        assert hosts == sorted(hosts)
        assert all(frame.exposure_us == camera.settings.exposure_us for frame in frames)
        stamps = [frame.timestamp_s for frame in frames if frame.timestamp_s is not None]
        if camera.capabilities.hardware_timestamp:
            assert len(stamps) == 10
        assert stamps == sorted(set(stamps))

    def test_frames_have_size_type_and_range(self, rig: Rig) -> None:
        """Every pixel format gives the sensor's size, uint8 or uint16, within its bits."""
        for camera in rig.cameras.values():
            width, height = camera.capabilities.sensor_size
            for pixel_format in camera.capabilities.pixel_formats:
                camera.configure(replace(camera.settings, pixel_format=pixel_format))
                camera.arm()
                frame = _shot(camera)
                camera.disarm()
                assert frame.data.shape == (height, width)
                assert frame.data.dtype == (np.uint8 if frame.bits == 8 else np.uint16)
                assert int(frame.data.max()) < 2**frame.bits
                assert frame.pixel_format == pixel_format

    def test_a_frame_is_the_callers(self, rig: Rig) -> None:
        """A frame that was fetched doesn't change when the next one arrives."""
        camera = _first(rig)
        with _armed(rig):
            first = _shot(camera)
            kept = first.data.copy()
            _shot(camera)
        np.testing.assert_array_equal(first.data, kept)

    def test_no_trigger_no_frame(self, rig: Rig) -> None:
        """Without a trigger `get_frame` times out, in about the time given."""
        camera = _triggered(rig)
        with _armed(rig):
            start = time.monotonic()
            with pytest.raises(DeviceTimeout, match=camera.name):
                camera.get_frame(timeout_s=0.05)
        assert time.monotonic() - start < 2.0

    def test_trigger_needs_arming(self, rig: Rig) -> None:
        """A camera that isn't armed can't be triggered."""
        camera = _triggered(rig)
        camera.disarm()
        with pytest.raises(FeatureError, match="arm"):
            camera.trigger()

    def test_abort_unblocks(self, rig: Rig) -> None:
        """`abort` from another thread ends a wait at once; the camera can be armed again."""
        camera = _triggered(rig)
        camera.arm()
        ended: list[float] = []

        def wait() -> None:
            with pytest.raises(DeviceTimeout):
                camera.get_frame(timeout_s=30.0)
            ended.append(time.monotonic())

        waiting = threading.Thread(target=wait)
        waiting.start()
        start = time.monotonic()
        camera.abort()
        waiting.join(timeout=5.0)
        assert ended
        assert ended[0] - start < 1.0
        assert camera.state is LinkState.READY
        with _armed(rig):
            _shot(camera)

    def test_free_run_brings_frames_by_itself(self, rig: Rig) -> None:
        """In free run frames come without a trigger, which is refused; `abort` ends it."""
        camera = _first(rig)
        if TriggerSource.FREE_RUN not in camera.capabilities.trigger_sources:
            pytest.skip(f"{camera.name} has no free run")
        camera.configure(
            replace(
                camera.settings,
                exposure_us=self._exposure_us(camera),
                trigger=TriggerSource.FREE_RUN,
            )
        )
        camera.arm()
        ids = [camera.get_frame(5.0).frame_id for _ in range(3)]
        assert ids == sorted(set(ids))
        with pytest.raises(FeatureError, match="Software"):
            camera.trigger()
        camera.abort()
        assert camera.state is LinkState.READY
        with pytest.raises(DeviceTimeout, match="arm again"):
            camera.get_frame(timeout_s=0.05)
        camera.arm()
        assert camera.get_frame(5.0).frame_id > ids[-1]
        camera.disarm()

    def test_reconnect_applies_settings_again(self, rig: Rig) -> None:
        """After `reconnect` the camera is READY with the settings of before."""
        camera = _first(rig)
        longer_us = self._exposure_us(camera, times=2)
        wanted = camera.configure(replace(camera.settings, exposure_us=longer_us))
        camera.reconnect()
        assert camera.state is LinkState.READY
        assert camera.settings == wanted
        with _armed(rig):
            assert _shot(camera).exposure_us == wanted.exposure_us

    # ------------------------------------------------------------ projector

    def test_patterns_are_shown_by_index(self, rig: Rig) -> None:
        """Loaded patterns can be shown in any order; other indices are refused."""
        projector = rig.projector
        projector.load([_uniform(projector, 0), _uniform(projector, 255)])
        assert projector.show(1).index == 1
        assert projector.show(0).index == 0
        assert projector.blank(128).index == -1
        for index in (2, -1):
            with pytest.raises(FeatureError):
                projector.show(index)
        with pytest.raises(FeatureError):
            projector.blank(256)

    def test_patterns_of_another_size_are_refused(self, rig: Rig) -> None:
        """Nothing is ever scaled."""
        width, height = rig.projector.capabilities.size
        with pytest.raises(GeometryError, match=str(width)):
            rig.projector.load([np.zeros((height, width + 1), np.uint8)])

    def test_a_sequence_fires_the_trigger_line(self, rig: Rig) -> None:
        """A hardware-timed run of five patterns gives five frames per camera, in order."""
        projector = rig.projector
        if not isinstance(projector, SequenceProjector):
            pytest.skip("the projector has no hardware-timed sequences")
        lines = _lines(rig)
        projector.load([_uniform(projector, 50 * index) for index in range(5)])
        for name, line in lines.items():
            camera = rig.cameras[name]
            camera.configure(replace(camera.settings, exposure_us=self.exposure_us, trigger=line))
            camera.arm(5)
        projector.arm_sequence(range(5), self.exposure_us, self.exposure_us + 20_000)
        projector.start_sequence()
        for camera in (rig.cameras[name] for name in lines):
            frames = [camera.get_frame() for _ in range(5)]
            camera.disarm()
            assert [f.frame_id - frames[0].frame_id for f in frames] == list(range(5))
            if self.has_light:
                means = [float(frame.data.mean()) for frame in frames]
                assert means == sorted(means)
                assert means[-1] > means[0] + 1

    def _exposure_us(self, camera: Camera, *, times: float = 1.0) -> float:
        """Return the suite's exposure, or a multiple of it, as far as the camera can be set to it."""
        allowed = camera.capabilities.exposure_us
        return allowed.nearest(min(max(times * self.exposure_us, allowed.min), allowed.max))

    # ------------------------------------------------------------ light

    def test_light_is_proportional_to_exposure(self, rig: Rig) -> None:
        """Twice the exposure gives twice the light above the dark level, to within noise."""
        self._need_light()
        projector, camera = rig.projector, _first(rig)
        projector.blank(128)
        dark = self._mean(rig, camera, camera.capabilities.exposure_us.min, projector_level=0)
        once = self._mean(rig, camera, self.exposure_us, projector_level=128) - dark
        twice = self._mean(rig, camera, 2 * self.exposure_us, projector_level=128) - dark
        assert once > 1
        assert twice / once == pytest.approx(2.0, rel=self.linear_within)

    def test_gain_is_in_db(self, rig: Rig) -> None:
        """6.02 dB doubles the signal."""
        self._need_light()
        camera = _first(rig)
        if camera.capabilities.gain_db.max < 6.1:
            pytest.skip("the camera has no gain")
        dark = self._mean(rig, camera, camera.capabilities.exposure_us.min, projector_level=0)
        plain = self._mean(rig, camera, self.exposure_us, projector_level=128) - dark
        loud = self._mean(rig, camera, self.exposure_us, projector_level=128, gain_db=6.0206) - dark
        assert loud / plain == pytest.approx(2.0, rel=2 * self.linear_within)

    def test_overexposure_ends_at_full_scale(self, rig: Rig) -> None:
        """What is too bright reads exactly full scale, never wraps around."""
        self._need_light()
        camera = _first(rig)
        longest = camera.capabilities.exposure_us.max
        rig.projector.blank(255)
        camera.configure(replace(camera.settings, exposure_us=longest))
        with _armed(rig):
            frame = _shot(camera, timeout_s=2.0 + longest * 1e-6)
        assert int(frame.data.max()) == 2**frame.bits - 1

    def _need_light(self) -> None:
        if not self.has_light:
            pytest.skip("the rig under test has no light (has_light = False)")

    def _mean(
        self,
        rig: Rig,
        camera: Camera,
        exposure_us: float,
        *,
        projector_level: int,
        gain_db: float = 0.0,
    ) -> float:
        """Return the mean of the pixels that are far from saturation at twice the exposure."""
        rig.projector.blank(projector_level)
        camera.configure(replace(camera.settings, exposure_us=exposure_us, gain_db=gain_db))
        with _armed(rig):
            frame = _shot(camera)
        rig.projector.blank(255)
        camera.configure(replace(camera.settings, exposure_us=self.exposure_us, gain_db=0.0))
        with _armed(rig):
            white = _shot(camera)
        full = 2**white.bits - 1
        usable = (white.data > 0.2 * full) & (white.data < 0.8 * full)
        assert usable.any(), "nothing in the picture is well exposed; change exposure_us"
        return float(full * self.light(frame.data[usable] / full).mean())

    # ------------------------------------------------------------ errors

    def test_errors_are_one_sentence_with_the_device(self, rig: Rig) -> None:
        """An operator reads the device's name, what is wrong and no line break."""
        camera = _first(rig)
        with pytest.raises(UnglareError) as caught:
            camera.configure(replace(camera.settings, exposure_us=-1.0))
        assert str(caught.value).startswith(f"{camera.name}: ")
        assert "\n" not in str(caught.value)


def _devices(rig: Rig) -> list[Camera | Projector]:
    return [*rig.cameras.values(), rig.projector]


def _first(rig: Rig) -> Camera:
    return next(iter(rig.cameras.values()))


def _triggered(rig: Rig) -> Camera:
    """Return the first camera, if it can be triggered by software."""
    camera = _first(rig)
    if TriggerSource.SOFTWARE not in camera.capabilities.trigger_sources:
        pytest.skip(f"{camera.name} runs freely, it has no software trigger")
    return camera


def _lines(rig: Rig) -> dict[str, TriggerSource]:
    """Return the trigger lines of the cameras that the projector drives."""
    if isinstance(rig, Wired):
        lines = dict(rig.trigger_lines)
    else:  # a rig that doesn't say is wired to the first line of every camera
        lines = {
            name: min(there)
            for name, camera in rig.cameras.items()
            if (there := set(camera.capabilities.trigger_sources) - _UNWIRED)
        }
    if not lines:
        pytest.skip("no camera is wired to the projector's trigger output")
    return lines


def _shot(camera: Camera, timeout_s: float = 5.0) -> Frame:
    if camera.settings.trigger is TriggerSource.SOFTWARE:
        camera.trigger()
    return camera.get_frame(timeout_s)


def _uniform(projector: Projector, level: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    width, height = projector.capabilities.size
    return np.full((height, width), level, np.uint8)


@contextmanager
def _armed(rig: Rig) -> Iterator[None]:
    for camera in rig.cameras.values():
        camera.arm()
    try:
        yield
    finally:
        for camera in rig.cameras.values():
            camera.disarm()
