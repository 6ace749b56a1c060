"""GigE Vision for real: the Aravis driver against cameras that speak the protocol, over loopback."""

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace

import numpy as np
import pytest

from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.conformance import RigConformance
from backend.devices.drivers import gige_link
from backend.devices.drivers.aravis_camera import AravisCamera, AravisOptions
from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
)
from backend.devices.peers import genicam as peer_features
from backend.devices.peers.gige_camera import GigECamera, Wire
from backend.devices.peers.gvcp import PORT, Bootstrap, Command, ask, request
from backend.devices.protocols import LinkState, TriggerSource
from backend.devices.sim import create_rig
from backend.devices.sim.rig import SimulatedRig
from tests.loopback import loopback_address

try:
    aravis()
except AravisMissingError as error:
    pytest.skip(str(error), allow_module_level=True)

SCENE = {"scene": "plane", "size": "160x120", "projector_size": "160x100", "realtime": True}


@contextmanager
def network(
    addresses: tuple[str, str], wire: Wire | None = None, **options: object
) -> Iterator[tuple[SimulatedRig, list[GigECamera]]]:
    """Serve the cameras of a simulated rig."""
    simulated = create_rig({**SCENE, **options})
    with simulated, ExitStack() as stack:
        peers = [
            stack.enter_context(GigECamera(camera, address, wire))
            for camera, address in zip(simulated.cameras.values(), addresses, strict=True)
        ]
        yield simulated, peers


class TestAravisOnGigEVision(RigConformance):
    has_light = True

    @pytest.fixture
    def rig(self, addresses):
        with network(addresses) as (simulated, _):
            cameras = {
                name: AravisCamera(name, AravisOptions(address=address))
                for name, address in zip(("left", "right"), addresses, strict=True)
            }
            sensors = dict.fromkeys(cameras, SensorFacts(8, 4.0, 15_300.0, 12.0))
            with AssembledRig("bench", cameras, simulated.projector, sensors=sensors) as rig:
                yield rig


def opened(addresses: tuple[str, str], **options: object) -> AravisCamera:
    camera = AravisCamera("left", AravisOptions(address=addresses[0], **options))
    camera.open()
    camera.configure(replace(camera.settings, exposure_us=10_000.0))
    return camera


def test_known_addresses_are_asked_one_by_one(addresses):
    with network(addresses):
        found = ask([*addresses, loopback_address()])
    assert {f.address: f.serial for f in found} == dict(
        zip(addresses, ("SIM-L", "SIM-R"), strict=True)
    )


VIEWER_LEFT_ON = {
    "TestPattern": (peer_features.TEST_PATTERN, (1).to_bytes(4), "its pictures are test images"),
    "ReverseX": (peer_features.REVERSE_X, (1).to_bytes(4), "mirrored"),
    "GammaEnable": (peer_features.GAMMA_ENABLE, (1).to_bytes(4), "aren't proportional"),
    "AcquisitionFrameRateEnable": (peer_features.RATE_ENABLE, (1).to_bytes(4), "passed over"),
}


def test_what_a_viewer_left_on_is_switched_off_and_told(addresses):
    """All of it at once: pictures are those of a camera that nobody has touched."""
    with network(addresses) as (simulated, peers):
        simulated.projector.blank(255)
        with opened(addresses) as camera:
            assert camera.notes == ()
            camera.arm()
            camera.trigger()
            untouched = camera.get_frame().data.astype(float)
        for register, value, _ in VIEWER_LEFT_ON.values():
            peers[0]._registers.write(register.address, value)
        peers[0]._registers.write(peer_features.GAMMA.address, struct.pack(">d", 0.45))
        peers[0]._registers.write(peer_features.RATE.address, struct.pack(">d", 0.5))
        ramp = peers[0]._processing.of(np.zeros((120, 160), np.uint8), 8)
        assert ramp[0, 0] == 255, "it would do what it is set to"
        with opened(addresses) as camera:
            notes = camera.notes
            camera.arm()
            pictures = []
            for _ in range(2):  # with a frame in two seconds the second one would be passed over
                camera.trigger()
                pictures.append(camera.get_frame(timeout_s=1.0).data.astype(float))
            assert camera.remarks == ()
    assert len(notes) == len(VIEWER_LEFT_ON)
    for feature, (_, _, words) in VIEWER_LEFT_ON.items():
        assert any(f"left: {feature} was" in n and words in n for n in notes), (feature, notes)
    for picture in pictures:
        assert abs(picture - untouched).mean() < 0.5 * abs(picture - untouched[:, ::-1]).mean()


def test_nobody_at_the_address_is_one_sentence(addresses):
    camera = AravisCamera("left", AravisOptions(address=addresses[0]))
    with pytest.raises(DeviceNotFound, match=f"left: no camera answers at {addresses[0]}"):
        camera.open()
    assert camera.state is LinkState.CLOSED


def test_a_frame_of_another_size_is_no_frame(addresses):
    with network(addresses), opened(addresses) as camera:
        width_px, height_px = camera.capabilities.sensor_size
        camera._capabilities = replace(camera.capabilities, sensor_size=(width_px, height_px - 1))
        camera.arm()
        camera.trigger()
        with pytest.raises(IncompleteFrame, match=f"is {width_px}x{height_px}, not {width_px}x{height_px - 1}"):  # fmt: skip
            camera.get_frame()


def test_a_second_controller_is_refused(addresses):
    with network(addresses), opened(addresses) as camera:
        other = AravisCamera("other", AravisOptions(address=addresses[0]))
        with pytest.raises(DeviceBusy, match="another program controls"):
            other.open()
        camera.arm()
        camera.trigger()
        assert camera.get_frame().data.shape == (120, 160)


def test_lost_packets_are_asked_for_again(addresses):
    with network(addresses, Wire(loss=0.05, seed=3), size="640x480") as (_, peers):
        with opened(addresses, packet_bytes=1500) as camera:
            camera.arm()
            whole = 0
            for _ in range(20):  # on a busy machine a packet may come again too late
                camera.trigger()
                with suppress(IncompleteFrame):
                    camera.get_frame()
                    whole += 1
        # Without resending, one frame in 50,000 would be whole.
        assert whole >= 10
        assert peers[0].resent_packets > 20


def test_what_resending_cannot_save_is_an_incomplete_frame_and_the_next_one_is_whole(addresses):
    wire = Wire(loss=1.0)
    with network(addresses, wire) as (_, peers), opened(addresses, packet_bytes=1500) as camera:
        camera.arm()
        camera.trigger()
        with pytest.raises((IncompleteFrame, DeviceTimeout), match="left"):
            camera.get_frame()
        peers[0]._wire = Wire()
        camera.trigger()
        camera.get_frame()


@pytest.mark.parametrize(
    ("largest_bytes", "trigger", "sentence"),
    [
        (0, TriggerSource.SOFTWARE, "it answers commands, but no packet of its pictures arrives: let UDP .* through"),
        (0, TriggerSource.FREE_RUN, "no packet of its pictures arrives"),
        (0, TriggerSource.LINE1, "it waits for pulses on Line1: check its trigger cable"),
    ],
)  # fmt: skip
def test_why_no_picture_arrives_is_said(addresses, largest_bytes, trigger, sentence):
    wire = Wire(largest_bytes=largest_bytes)
    with network(addresses, wire), opened(addresses, packet_bytes=8000) as camera:
        camera.configure(replace(camera.settings, trigger=trigger))
        camera.arm()
        if trigger is TriggerSource.SOFTWARE:
            camera.trigger()
        with pytest.raises((DeviceTimeout, IncompleteFrame), match=sentence) as refused:
            camera.get_frame(timeout_s=1.0)
        assert "\n" not in str(refused.value)


def test_pictures_that_stop_coming_are_no_matter_of_a_trigger_line(addresses):
    with network(addresses) as (_, peers), opened(addresses) as camera:
        camera.arm()
        with pytest.raises(DeviceTimeout, match="trigger it first"):
            camera.get_frame(timeout_s=0.1)
        camera.trigger()
        camera.get_frame()
        peers[0]._wire = Wire(largest_bytes=0)
        camera.trigger()
        with pytest.raises(DeviceTimeout, match="it was triggered: check its cable"):
            camera.get_frame(timeout_s=0.5)


def test_a_camera_that_goes_away_before_its_picture_comes_is_no_defect(addresses):
    with network(addresses, Wire(largest_bytes=0)) as (_, peers), opened(addresses) as camera:
        camera.arm()
        camera.trigger()
        peers[0].stop()
        with pytest.raises(DeviceDisconnected, match="left: doesn't answer"):
            camera.get_frame(timeout_s=0.3)
        assert camera.state is LinkState.LOST
        peers[0].start()  # giving it back is quicker if somebody answers


def test_a_region_that_a_camera_refuses_is_named_with_the_way_out(addresses):
    with network(addresses):
        with opened(addresses, region=[0, 0, 160, 120]) as camera:  # as it is: nothing to write
            assert camera.capabilities.sensor_size == (160, 120)
        sentence = r"left: Width stays at 160, 128 of region \[0, 0, 128, 96\] is refused \(.*\); leave the region out"
        with pytest.raises(FeatureError, match=sentence):
            opened(addresses, region=[0, 0, 128, 96])


@pytest.mark.parametrize("asked", [{}, {"packet_bytes": 8000}], ids=["found", "too large"])
def test_packets_that_do_not_get_through_are_made_smaller(addresses, asked):
    with network(addresses, Wire(largest_bytes=3000)) as (_, peers), opened(addresses, **asked) as camera:  # fmt: skip
        camera.arm()
        camera.trigger()
        assert camera.get_frame().data.shape == (120, 160)
        assert peers[0]._registers.read_number(Bootstrap.PACKET_SIZE) <= 3000


def test_receive_buffers_that_are_too_small_are_told_with_the_command(
    addresses, tmp_path, monkeypatch
):
    limit = tmp_path / "rmem_max"
    monkeypatch.setattr(gige_link, "LARGEST_BUFFER", limit)
    with network(addresses):
        for text, remarks in (("8000\n", 1), ("212992\n", 0), ("", 0)):
            limit.write_text(text)
            with opened(addresses) as camera:
                assert len(camera.remarks) == remarks, text
                assert all("sudo sysctl -w net.core.rmem_max=" in r for r in camera.remarks)


def test_a_trigger_during_an_exposure_is_lost(addresses):
    """The driver waits for the exposure's end; whoever doesn't gets no frame."""
    with network(addresses) as (_, peers), opened(addresses) as camera:
        camera.configure(replace(camera.settings, exposure_us=200_000.0))
        camera.arm()
        camera.trigger()
        camera._free_at_s = 0.0
        camera.trigger()
        camera.get_frame()
        with pytest.raises(DeviceTimeout):
            camera.get_frame(timeout_s=0.3)
        assert peers[0].dropped_triggers == 1


def test_a_camera_that_goes_away_and_comes_back(addresses):
    with network(addresses) as (_, peers), opened(addresses) as camera:
        wanted = camera.settings
        camera.arm()
        peers[0].stop()
        with pytest.raises(DeviceDisconnected, match="left"):
            camera.trigger()
        assert camera.state is LinkState.LOST
        threading.Timer(0.5, peers[0].start).start()
        camera.reconnect(timeout_s=20.0)
        assert camera.settings == wanted
        camera.arm()
        camera.trigger()
        camera.get_frame()


def test_whoever_aborts_waiting_is_told_that_and_not_that_time_is_up(addresses):
    with network(addresses) as (_, peers), opened(addresses) as camera:
        peers[0].stop()
        threading.Timer(0.2, camera.abort).start()
        with pytest.raises(
            DeviceDisconnected, match=r"is no longer waited for .*no camera answers"
        ):
            camera.reconnect(timeout_s=60.0)
        assert camera.state is LinkState.LOST


def test_control_ends_with_the_heartbeat_of_a_client_that_died(addresses):
    with network(addresses) as (_, peers), opened(addresses) as camera:
        peers[0]._client = ("127.0.0.1", 9)  # somebody who never says anything again
        peers[0]._heard_s = time.monotonic()
        with pytest.raises((DeviceBusy, DeviceDisconnected, FeatureError)):
            camera.configure(replace(camera.settings, exposure_us=20_000.0))
        camera.reconnect(timeout_s=20.0)
        assert camera.state is LinkState.READY


@pytest.mark.parametrize("command", list(Command))
@pytest.mark.parametrize("payload", [b"", b"\0", b"\0" * 5, b"\xff" * 4, b"\xff" * 12])
def test_malformed_commands_do_not_end_the_camera(addresses, command, payload):
    with network(addresses), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(request(command, payload), (addresses[0], PORT))
        assert len(ask([addresses[0]], timeout_s=2.0)) == 1


def test_a_camera_that_is_lost_behind_the_network_refuses_and_goes_on_answering(addresses):
    with (
        network(addresses, fail_after_frames=0, fail_for_good=True),
        opened(addresses) as camera,
    ):
        camera.arm()
        camera.trigger()
        with pytest.raises((IncompleteFrame, DeviceTimeout), match="left"):
            camera.get_frame(timeout_s=0.3)
        camera.disarm()
        with pytest.raises(FeatureError, match="refused arming"):
            camera.arm()
        assert len(ask([addresses[0]])) == 1


def test_frames_are_not_waited_for_busily_before_the_first_arming(addresses):
    with network(addresses), opened(addresses) as camera:
        spent_s = time.thread_time()
        with pytest.raises(DeviceTimeout):
            camera.get_frame(timeout_s=0.5)
        assert time.thread_time() - spent_s < 0.1


def test_opening_again_after_a_loss_gives_the_old_connection_back(addresses):
    with network(addresses), opened(addresses) as camera:
        camera._note_loss()
        camera.open()
        camera.arm()
        camera.trigger()
        assert camera.get_frame().data.shape == (120, 160)


def test_a_camera_that_runs_freely_shows_the_new_pattern_after_the_frames_that_waited(addresses):
    with network(addresses) as (simulated, peers), opened(addresses) as camera:
        simulated.projector.blank(0)
        camera.configure(replace(camera.settings, trigger=TriggerSource.FREE_RUN))
        camera.arm()
        dark = float(camera.get_frame().data.mean())
        # As nobody fetches, every buffer holds a dark frame when five more were sent.
        sent = peers[0]._block_id
        while peers[0]._block_id < sent + 5:
            threading.Event().wait(0.01)
        simulated.projector.blank(255)
        means = [float(camera.get_frame().data.mean()) for _ in range(8)]
    waiting = camera.capabilities.buffered_frames + 1
    assert means[0] == pytest.approx(dark, abs=1.0)
    assert min(means[waiting:]) > dark + 5


def test_a_line_triggered_sequence_brings_every_frame(addresses):
    """24 patterns at 16.7 ms: 24 frames of each camera, equally spaced by its own clock."""
    steady = network(addresses, frame_period_ms=None)  # light that isn't modulated within 16.7 ms
    with steady as (simulated, _), ExitStack() as stack:
        projector = simulated.projector
        patterns = [np.full((100, 160), 10 * k, np.uint8) for k in range(24)]
        projector.load(patterns)
        cameras = []
        for name, address in zip(("left", "right"), addresses, strict=True):
            camera = stack.enter_context(AravisCamera(name, AravisOptions(address=address)))
            camera.configure(
                replace(camera.settings, exposure_us=12_000.0, trigger=TriggerSource.LINE1)
            )
            camera.arm(24)
            cameras.append(camera)
        projector.arm_sequence(range(24), 16_000.0, 16_667.0)
        projector.start_sequence()
        for camera in cameras:
            frames = [camera.get_frame(timeout_s=5.0) for _ in range(24)]
            spacing_s = np.diff([f.timestamp_s for f in frames])
            np.testing.assert_allclose(spacing_s, 0.016667, atol=1e-6)
            assert np.unique(np.diff([f.frame_id for f in frames])).tolist() == [1]
            means = [float(f.data.mean()) for f in frames]
            assert means == sorted(means)
