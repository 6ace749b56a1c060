"""One conformance suite over every camera driver that can run here, and what each has besides."""

import ctypes
import fcntl
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.conformance import RigConformance
from backend.devices.driver_loading import CAMERAS, load_factory, make_camera
from backend.devices.drivers import aravis_library, gentl_camera, video_camera
from backend.devices.drivers.extras import imported
from backend.devices.drivers.pylon_camera import PylonCamera
from backend.devices.drivers.sfnc import SfncControls, SfncOptions
from backend.devices.drivers.video_camera import VideoCamera, VideoOptions
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
    RigConfigError,
    UnsupportedFeature,
)
from backend.devices.peers import genicam as peer_features
from backend.devices.peers.gvsp import PIXEL_FORMATS
from backend.devices.protocols import Camera, CameraSettings, LinkState, Range, TriggerSource
from backend.devices.sim.clock import Clock
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.devices.sim.screen import SimulatedScreen

REGION = [0, 0, 160, 120]


def bench(cameras: dict[str, Camera]) -> AssembledRig:
    """Put cameras beside a display that they don't see."""
    display = SimulatedScreen(SimulatedLcdConfig(screen_size=(160, 100)), Clock(realtime=False))
    sensors = dict.fromkeys(cameras, SensorFacts())
    return AssembledRig("bench", cameras, display, sensors=sensors)


def cameras_of(driver: str, options: Mapping[str, Mapping[str, object]]) -> dict[str, Camera]:
    return {name: make_camera(name, driver, given) for name, given in options.items()}


@contextmanager
def opened(name: str, driver: str, options: Mapping[str, object]) -> Iterator[Camera]:
    camera = make_camera(name, driver, options)
    with camera:
        yield camera


# ---------------------------------------------------------------- pylon

EMULATED = {
    "left": {"serial": "0815-0000", "emulated": True, "region": REGION},
    "right": {"serial": "0815-0001", "emulated": True, "region": REGION},
}


class TestEmulatedPylonCameras(RigConformance):
    """Emulated exposures have no effect on the pictures: the suite's tests of light are skipped."""

    exposure_us = 5_000.0

    @pytest.fixture
    def rig(self) -> Iterator[AssembledRig]:
        pytest.importorskip("pypylon")
        with bench(cameras_of("pylon", EMULATED)) as rig:
            yield rig


@pytest.fixture
def emulated() -> Iterator[PylonCamera]:
    pytest.importorskip("pypylon")
    camera = make_camera("left", "pylon", EMULATED["left"])
    assert isinstance(camera, PylonCamera)
    with camera:
        camera.configure(replace(camera.settings, exposure_us=1_000.0))
        yield camera


def test_failed_buffers_are_incomplete_frames_and_the_next_one_is_whole(emulated):
    emulated.arm()
    nodes = emulated._device.GetNodeMap()
    nodes.GetNode("ForceFailedBufferCount").SetValue(2)
    nodes.GetNode("ForceFailedBuffer").Execute()
    for _ in range(2):
        emulated.trigger()
        with pytest.raises(IncompleteFrame, match=r"left: frame . arrived incomplete"):
            emulated.get_frame()
    emulated.trigger()
    assert emulated.get_frame().frame_id == 2


def test_a_pylon_camera_that_is_removed_is_lost_and_comes_back(emulated):
    wanted = emulated.settings
    emulated.arm()
    emulated._device.GetNodeMap().GetNode("FirePnPCallback").Execute()
    with pytest.raises(DeviceDisconnected, match="left: the camera is gone"):
        emulated.get_frame()
    assert emulated.state is LinkState.LOST
    emulated.reconnect()
    assert emulated.settings == wanted
    emulated.arm()
    emulated.trigger()
    emulated.get_frame()


def test_every_trigger_of_a_burst_finds_a_buffer(emulated):
    """Frames that nobody fetches meanwhile are kept, as those of a hardware-timed sequence have to be."""
    emulated.arm(24)
    for _ in range(24):
        emulated.trigger()
    ids = [emulated.get_frame().frame_id for _ in range(24)]
    assert ids == list(range(ids[0], ids[0] + 24))


def test_an_emulated_camera_takes_the_pictures_of_a_folder(tmp_path):
    pytest.importorskip("pypylon")
    rng = np.random.default_rng(5)
    pictures = rng.integers(0, 256, (3, 48, 64), np.uint8)
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    options = {"serial": "0815-0000", "emulated": True, "pictures": str(tmp_path)}
    with opened("left", "pylon", options) as camera:
        assert camera.capabilities.sensor_size == (64, 48)
        camera.arm()
        for expected in (*pictures, pictures[0]):
            camera.trigger()
            np.testing.assert_array_equal(camera.get_frame().data, expected)


def test_a_region_that_does_not_fit_is_refused(emulated):
    options = {**EMULATED["left"], "region": [0, 0, 160, 12_000]}
    camera = make_camera("right", "pylon", options)
    with pytest.raises(FeatureError, match=r"right: Height 12000 of region .* is not within 1 to 4096 px"):  # fmt: skip
        camera.open()
    assert camera.state is LinkState.CLOSED


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "left: give either the address"),
        ({"address": "127.77.1.9", "serial": "1"}, "left: give either the address"),
        ({"address": "127.77.1.9", "emulated": True}, "left: an emulated camera has"),
        ({"serial": "1", "pictures": "here"}, "left: an emulated camera has"),
        ({"serial": "1", "exposure_us": 0}, "left: option exposure_us can't be 0"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, sentence):
    with pytest.raises(RigConfigError, match=sentence):
        make_camera("left", "pylon", options)


@pytest.mark.parametrize("driver", ["aravis", "pylon"])
@pytest.mark.parametrize("address", ["255.255.255.255", "239.0.0.1", "camera-1", "192.168.10", "192.168.10.2 "])  # fmt: skip
def test_what_is_no_single_address_never_gets_as_far_as_a_library(driver, address):
    """Aravis asks everybody for a name that it doesn't know, pylon sends to whatever the address means."""
    with pytest.raises(RigConfigError, match=f"left: option address can't be '{address}': write .*192.168"):  # fmt: skip
        make_camera("left", driver, {"address": address})


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"address": "127.77.1.9"}, "no camera answers at 127.77.1.9 .*check cable"),
        ({"serial": 123}, "no camera answers with serial number 123 .*check cable"),
        ({"serial": "0815-9999", "emulated": True}, "serial number 0815-9999 .*PYLON_CAMEMU"),
    ],
)
def test_a_pylon_camera_that_is_not_there_is_one_sentence(options, sentence):
    """Each is looked for by unicast, on USB or among the emulated ones: nothing is broadcast."""
    pytest.importorskip("pypylon")
    with pytest.raises(DeviceNotFound, match=sentence) as caught:
        make_camera("left", "pylon", options).open()
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- Aravis


class TestAravisOnItsOwnFakeCamera(RigConformance):
    """Somebody else's GigE Vision camera: old names of features, frame numbers that wrap, light of its own."""

    exposure_us = 10_000.0

    @pytest.fixture
    def rig(self) -> Iterator[AssembledRig]:
        with fake_camera("127.0.0.1"):
            options = {"left": {"address": "127.0.0.1", "region": [0, 0, 128, 96]}}
            with bench(cameras_of("aravis", options)) as rig:
                yield rig


@contextmanager
def fake_camera(address: str) -> Iterator[None]:
    """Run the camera that comes with Aravis in threads of its own."""
    try:
        library = ctypes.CDLL(aravis_library.LIBRARY)
    except OSError as error:
        pytest.skip(str(error))
    library.arv_gv_fake_camera_new.restype = ctypes.c_void_p
    # Its address is one that every machine has, and two of them would share the port without a word.
    with (Path(tempfile.gettempdir()) / "unglare-tests-aravis.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        camera = ctypes.c_void_p(library.arv_gv_fake_camera_new(address.encode(), b"FAKE1"))
        try:
            if not library.arv_gv_fake_camera_is_running(camera):
                pytest.skip(f"another program has the GigE Vision port of {address}")
            yield
        finally:
            library.g_object_unref(camera)


# ---------------------------------------------------------------- GenTL


def viky() -> Path:
    genicam = pytest.importorskip("genicam")
    pytest.importorskip("harvesters")
    return Path(genicam.__file__).parent / "viky.cti"


class TestGentlCameras(RigConformance):
    """The producer of genicam's wheel: free run, an exposure that can't be set, no light."""

    exposure_us = 50_000.0

    @pytest.fixture
    def rig(self) -> Iterator[AssembledRig]:
        known = {"producer": str(viky()), "exposure_us": 50_000}
        options = {"left": {**known, "serial": 0}, "right": {**known, "serial": 1}}
        with bench(cameras_of("gentl", options)) as rig:
            yield rig


def test_a_gentl_camera_is_found_by_serial_number_or_not_at_all():
    options = {"producer": str(viky()), "serial": "9", "exposure_us": 50_000}
    with pytest.raises(DeviceNotFound, match=r"left: no camera has serial number 9 of viky.cti, there are: 0, 1, 2"):  # fmt: skip
        make_camera("left", "gentl", options).open()


def test_a_gentl_camera_that_is_in_use_is_refused_and_the_other_goes_on():
    options = {"producer": str(viky()), "serial": "0", "exposure_us": 50_000}
    with opened("left", "gentl", options) as camera:
        camera.arm()
        with pytest.raises(DeviceBusy, match="right: another program controls"):
            make_camera("right", "gentl", options).open()
        camera.get_frame()


def test_an_exposure_that_nobody_knows_is_refused():
    with pytest.raises(UnsupportedFeature, match=r"left: has no exposure .*exposure_us: 20000"):
        make_camera("left", "gentl", {"producer": str(viky()), "serial": "0"}).open()


@pytest.mark.parametrize("content", [None, b"no library"])
def test_a_producer_that_is_not_one_is_one_sentence(tmp_path, content):
    viky()
    producer = tmp_path / "other.cti"
    if content is not None:
        producer.write_bytes(content)
    with pytest.raises(DeviceNotFound, match=r"left: .*GenTL producer .*other.cti"):
        make_camera("left", "gentl", {"producer": str(producer), "serial": "0"}).open()


def test_a_camera_that_was_given_back_can_be_opened_by_another():
    options = {"producer": str(viky()), "serial": "0", "exposure_us": 50_000}
    for name in ("left", "right"):
        with opened(name, "gentl", options) as camera:
            camera.arm()
            camera.get_frame()
    assert not gentl_camera._producers


def nodes_in_memory() -> tuple[Any, list[tuple[int, bytes]], object]:
    """Let GenICam's own reader have a camera whose registers are bytes in memory; its writes are listed.

    The port comes last: whoever reads keeps it, GenICam doesn't.
    """
    genapi = imported("left", "genicam.genapi", "gentl")
    memory, writes = bytearray(1 << 17), []

    class Port(genapi.AbstractPort):  # type: ignore[misc,name-defined]  # of a library without types
        def is_open(self) -> bool:
            return True

        def get_access_mode(self) -> int:
            return int(genapi.EAccessMode.RW)

        def read(self, address: int, length: int) -> bytes:
            return bytes(memory[address : address + length])

        def write(self, address: int, value: bytes) -> None:
            memory[address : address + len(value)] = value
            writes.append((address, bytes(value)))

    formats = {name: PIXEL_FORMATS[name] for name in ("Mono8", "Mono12")}
    exposures, gains = Range(20.0, 1e6, 1.0, "us"), Range(0.0, 24.0, 0.1, "dB")
    described = peer_features.describe(
        peer_features.CameraDescription(
            "Maker", "Camera", formats, ["Software", "Line1"], exposures, gains, Range(576, 9000, 4)
        )
    )
    nodes, port = genapi.NodeMap(), Port()
    nodes.load_xml_from_string(described.decode())
    nodes.connect(port, "Device")
    nodes.get_node("PixelFormat").value = "Mono8"
    nodes.get_node("ExposureTime").value = 1000.0
    return nodes, writes, port


def test_a_producers_camera_takes_exposure_gain_format_and_trigger():
    """The features that `viky` lacks, through GenICam's own reader of descriptions."""
    viky()
    nodes, writes, _port = nodes_in_memory()
    features = gentl_camera.GentlFeatures(nodes)
    made = SfncControls("left", features, SfncOptions(), buffered_frames=3, hardware_timestamp=True)
    made.prepare()
    can = made.capabilities()
    assert can.exposure_us == Range(20.0, 1e6, 0.0, "us")
    assert can.gain_db == Range(0.0, 24.0, 0.0, "dB")
    assert can.pixel_formats == ("Mono8", "Mono12")
    assert can.trigger_sources == (TriggerSource.SOFTWARE, TriggerSource.LINE1, TriggerSource.FREE_RUN)  # fmt: skip
    for wanted in (
        CameraSettings(2500.5, 6.0, "Mono12", None, TriggerSource.LINE1),
        CameraSettings(2500.5, 0.0, "Mono8", None, TriggerSource.FREE_RUN),
        CameraSettings(700.0, 0.0, "Mono8", None, TriggerSource.SOFTWARE),
    ):
        assert made.apply(wanted, made.read()) == wanted
    features.run("TriggerSoftware")
    assert writes[-1] == (peer_features.TRIGGER_SOFTWARE.address, (1).to_bytes(4))


# ---------------------------------------------------------------- video


def write_pictures(folder: Path, count: int = 40) -> str:
    for number in range(count):
        picture = np.full((120, 160), number, np.uint8)
        cv2.imwrite(str(folder / f"im_{number:03d}.png"), picture)
    return str(folder / "im_%03d.png")


def write_video(path: Path, count: int = 40) -> str:
    """Write a lossless video whose frames say which they are."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 30, (160, 120))
    assert video.isOpened()
    for number in range(count):
        video.write(np.full((120, 160, 3), number, np.uint8))
    video.release()
    return str(path)


class FakeDevice:
    """A webcam as OpenCV shows it: settings are clamped, pictures come in colour and say their number."""

    def __init__(self, *, exposures: tuple[float, float] | None = (3, 2047)) -> None:
        self.exposures = exposures
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: 160.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 120.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_EXPOSURE: 250.0,
            cv2.CAP_PROP_GAIN: 5.0,
        }
        self.number = 0
        self.there = True
        self.released = False
        self.stuck = threading.Event()
        self.stuck.set()

    def isOpened(self) -> bool:  # noqa: N802  OpenCV's name
        return self.there

    def set(self, prop: int, value: float) -> bool:
        if prop not in self.values:
            return False
        if prop in (cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE) and not self.exposures:
            return False
        if prop == cv2.CAP_PROP_EXPOSURE and self.exposures:
            value = min(max(value, self.exposures[0]), self.exposures[1])
        if prop == cv2.CAP_PROP_GAIN:
            value = min(value, 100.0)
        self.values[prop] = value
        return True

    def get(self, prop: int) -> float:
        return self.values.get(prop, -1.0)

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.stuck.wait(20.0)
        if not self.there:
            return False, None
        size = int(self.values[cv2.CAP_PROP_FRAME_HEIGHT]), int(self.values[cv2.CAP_PROP_FRAME_WIDTH])  # fmt: skip
        self.number += 1
        return True, np.full((*size, 3), self.number % 256, np.uint8)

    def release(self) -> None:
        self.released = True


class TestVideoFiles(RigConformance):
    """A series of pictures and a video file stand in for webcams."""

    exposure_us = 33_000.0

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[AssembledRig]:
        options = {
            "left": {"source": write_pictures(tmp_path), "exposure_us": 33_000},
            "right": {"source": write_video(tmp_path / "video.avi"), "exposure_us": 33_000},
        }
        with bench(cameras_of("video", options)) as rig:
            yield rig


class TestVideoDevices(RigConformance):
    """A webcam in memory, whose exposure can be set."""

    exposure_us = 10_000.0

    @pytest.fixture
    def rig(self) -> Iterator[AssembledRig]:
        camera = VideoCamera("left", VideoOptions(source=0), open_capture=lambda *_: FakeDevice())
        with bench({"left": camera}) as rig:
            yield rig


@contextmanager
def webcam(device: FakeDevice, **options: object) -> Iterator[VideoCamera]:
    given = VideoOptions.model_validate({"source": 0, **options})
    with VideoCamera("left", given, open_capture=lambda *_: device) as camera:
        yield camera


def test_a_device_says_which_exposures_it_has():
    with webcam(FakeDevice()) as camera:
        assert camera.capabilities.exposure_us == Range(300.0, 204_700.0, 100.0, "us")
        taken = camera.configure(replace(camera.settings, exposure_us=12_345.0))
        assert taken.exposure_us == 12_300.0


def test_a_device_without_exposure_needs_one_in_the_rig_file():
    with pytest.raises(UnsupportedFeature, match="left: has no exposure that could be set"):
        VideoCamera("left", VideoOptions(source=0), open_capture=lambda *_: FakeDevice(exposures=None)).open()  # fmt: skip
    with webcam(FakeDevice(exposures=None), exposure_us=33_000) as camera:
        assert camera.capabilities.exposure_us == Range(33_000.0, 33_000.0, 0.0, "us")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"properties": {"GAIN": 200}}, "GAIN 200 isn't taken, the device says 100"),
        ({"properties": {"ZOOM": 1}}, "ZOOM 1 isn't taken, the device says -1"),
        ({"properties": {"CHARM": 1}}, "OpenCV has no property CHARM"),
    ],
)
def test_what_a_device_does_not_take_is_refused(options, sentence):
    device = FakeDevice()
    with pytest.raises(FeatureError, match=f"left: {sentence}"):
        VideoCamera("left", VideoOptions.model_validate({"source": 0, **options}), open_capture=lambda *_: device).open()  # fmt: skip
    assert device.released


def test_an_exposure_that_is_taken_otherwise_leaves_the_old_one():
    device = FakeDevice()
    with webcam(device) as camera:
        before = camera.settings
        device.exposures = (3, 500)  # less than it said
        with pytest.raises(FeatureError, match=r"left: EXPOSURE 1000 isn't taken, .* says 500"):
            camera.configure(replace(before, exposure_us=100_000.0))
        assert camera.settings == before
        assert device.values[cv2.CAP_PROP_EXPOSURE] == before.exposure_us / 100


def test_frames_that_waited_before_arming_or_another_exposure_are_thrown_away():
    device = FakeDevice()
    with webcam(device) as camera:
        before = device.number
        camera.arm()
        assert camera.get_frame().data[0, 0] == before + 5  # four waited
        camera.configure(replace(camera.settings, exposure_us=20_000.0))
        assert camera.get_frame().data[0, 0] == before + 5 + 6  # and one was being exposed


def test_a_device_that_is_stuck_is_a_timeout_and_can_be_left():
    device = FakeDevice()
    with webcam(device) as camera:
        camera.arm()
        device.stuck.clear()
        started_s = time.monotonic()
        with pytest.raises(DeviceTimeout, match=r"left: no frame came within 0.2 s; take it again"):
            camera.get_frame(timeout_s=0.2)
        camera.close()
        assert time.monotonic() - started_s < 15.0, "it is stuck for 20 s"
        device.stuck.set()


def test_a_device_that_was_pulled_is_lost_and_comes_back():
    device = FakeDevice()
    with webcam(device) as camera:
        wanted = camera.configure(replace(camera.settings, exposure_us=20_000.0))
        camera.arm()
        camera.get_frame()
        device.there = False
        with pytest.raises(DeviceDisconnected, match="left: the device delivers no picture"):
            camera.get_frame()
        threading.Timer(0.3, lambda: setattr(device, "there", True)).start()
        camera.reconnect()
        assert camera.settings == wanted


@pytest.mark.parametrize("write", [write_pictures, write_video])
def test_files_are_played_in_order_and_again(tmp_path, write):
    place = tmp_path / "played"
    if write is write_pictures:
        place.mkdir()
    options = {"source": write(place if place.is_dir() else place.with_suffix(".avi"), 5), "exposure_us": 1}  # fmt: skip
    with opened("left", "video", options) as camera:
        camera.arm()
        values = [int(camera.get_frame().data[0, 0]) for _ in range(8)]
    assert values == [0, 1, 2, 3, 4, 0, 1, 2]


@pytest.mark.parametrize("source", [77, "/dev/video77", "nowhere/im_%03d.png", "nowhere/video.avi"])
def test_a_source_that_is_not_there_is_one_sentence(capfd, source):
    with pytest.raises(DeviceNotFound, match=f"left: video source {source} can't be opened"):
        make_camera("left", "video", {"source": source}).open()
    assert capfd.readouterr().err == ""


def test_pictures_of_16_bit_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "im_000.png"), np.zeros((12, 16), np.uint16))
    options = {"source": str(tmp_path / "im_%03d.png"), "exposure_us": 1}
    with pytest.raises(UnsupportedFeature, match=r"left: .* has uint16 pictures; only 8 bits"):
        make_camera("left", "video", options).open()


def test_devices_are_listed_as_the_system_knows_them(tmp_path):
    for node, index, name in (("video0", 0, "Webcam"), ("video1", 1, "Webcam"), ("video12", 0, "Capture")):  # fmt: skip
        (tmp_path / node).mkdir()
        (tmp_path / node / "index").write_text(f"{index}\n")
        (tmp_path / node / "name").write_text(f"{name}\n")
    assert video_camera._listed(tmp_path) == [(0, "Webcam"), (12, "Capture")]


# ---------------------------------------------------------------- missing libraries


@pytest.mark.parametrize(
    ("driver", "options", "blocked", "command"),
    [
        ("pylon", {"serial": "1"}, "pypylon.pylon", r"pip install 'unglare\[pylon\]'"),
        ("gentl", {"producer": __file__, "serial": "1"}, "harvesters.core", r"pip install 'unglare\[gentl\]'"),
        ("aravis", {"serial": "1"}, None, "apt-get install libaravis-0.8-0"),
    ],
)  # fmt: skip
def test_a_missing_library_is_one_sentence_with_the_command(
    monkeypatch, driver, options, blocked, command
):
    if blocked is None:
        monkeypatch.setattr(aravis_library, "LIBRARY", "libnowhere-0.so")
        aravis_library.aravis.cache_clear()
    else:
        monkeypatch.setitem(sys.modules, blocked, None)
    try:
        with pytest.raises(DeviceNotFound, match=f"left: .*; run: {command}") as caught:
            make_camera("left", driver, options).open()
    finally:
        aravis_library.aravis.cache_clear()
    assert "\n" not in str(caught.value)


def test_an_usb_camera_that_is_not_there_is_looked_for_on_usb_only():
    try:
        aravis_library.aravis()
    except aravis_library.AravisMissingError as error:
        pytest.skip(str(error))
    with pytest.raises(DeviceNotFound, match="left: no camera answers with serial number 7; check"):
        make_camera("left", "aravis", {"serial": 7}).open()


def test_every_driver_says_which_options_it_takes():
    for driver in ("aravis", "pylon", "gentl", "video"):
        model = getattr(load_factory(CAMERAS, "left", driver), "options_model", None)
        assert model is not None
        assert model.model_fields
