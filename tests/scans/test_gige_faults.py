"""What may happen to GigE Vision cameras in the middle of a capture, and what the capture makes of it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.drivers.aravis_camera import AravisCamera, AravisOptions
from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.errors import DeviceBusy
from backend.devices.peers.gige_camera import GigECamera, Wire
from backend.domain.patterns import WHITE
from backend.jobs.control import JobControl
from backend.jobs.rendering import render
from backend.jobs.shooting import Shooter
from tests.contract.test_gige_vision import network

try:
    aravis()
except AravisMissingError as error:
    pytest.skip(str(error), allow_module_level=True)

CAMERAS = ("left", "right")


@contextmanager
def shooting(
    addresses: tuple[str, str], wire: Wire | None = None, **options: Any
) -> Iterator[tuple[Shooter, list[GigECamera]]]:
    """Capture with the real driver, shooter and protocol; the projector is the simulated one."""
    with network(addresses, wire, **options) as (simulated, peers):
        cameras = {
            name: AravisCamera(name, AravisOptions(address=address, packet_bytes=1500))
            for name, address in zip(CAMERAS, addresses, strict=True)
        }
        sensors = dict.fromkeys(cameras, SensorFacts(8, 4.0, 15_300.0, 12.0))
        bench = AssembledRig("bench", cameras, simulated.projector, sensors=sensors)
        with bench, Shooter(bench, JobControl()) as shooter:
            width_px, height_px = shooter.projector_size
            shooter.load([render(WHITE, width_px=width_px, height_px=height_px)])
            yield shooter, peers


def take(shooter: Shooter) -> None:
    frames = shooter.take(0, exposure_ms=20.0, gain_db=0.0, cameras=CAMERAS)
    assert set(frames) == set(CAMERAS)
    assert all(frame.data.mean() > 20 for frame in frames.values())


def test_half_a_percent_of_the_packets_is_lost_and_no_frame(addresses: tuple[str, str]) -> None:
    """24 pairs of 211 packets: some 50 packets get lost, they are asked for again, or the shot is taken again."""
    with shooting(addresses, Wire(loss=0.005, seed=4), size="640x480") as (shooter, peers):
        for _ in range(24):
            take(shooter)
        assert sum(peer.resent_packets for peer in peers) > 10


def test_a_camera_that_goes_away_in_mid_capture_is_fetched_back(addresses: tuple[str, str]) -> None:
    with shooting(addresses) as (shooter, peers):
        take(shooter)
        peers[1].stop()
        threading.Timer(1.0, peers[1].start).start()
        take(shooter)


def test_a_second_controller_disturbs_nobody(addresses: tuple[str, str]) -> None:
    with shooting(addresses) as (shooter, _):
        take(shooter)
        stranger = AravisCamera("stranger", AravisOptions(address=addresses[0]))
        with pytest.raises(DeviceBusy, match="another program controls"):
            stranger.open()
        take(shooter)


def test_frames_of_an_acquisition_that_was_ended_never_come_in_the_next(
    addresses: tuple[str, str],
) -> None:
    """A picture that took too long must not be taken for the next one."""
    with shooting(addresses) as (shooter, peers):
        camera, late, busy = peers[0]._camera, threading.Event(), threading.Event()
        real = camera.get_frame

        def slow(timeout_s: float = 2.0) -> Any:
            frame = real(timeout_s)
            if late.is_set():
                late.clear()
                busy.set()
                threading.Event().wait(1.5)
                return frame.__class__(**{**vars(frame), "data": np.zeros_like(frame.data)})
            return frame

        camera.get_frame = slow  # type: ignore[method-assign]  # a renderer that is late once
        take(shooter)  # also what was being waited for before is over now
        late.set()
        driver = shooter._rig.cameras["left"]
        driver.trigger()
        assert busy.wait(60.0)
        driver.disarm()
        driver.arm()
        driver.trigger()
        assert driver.get_frame(5.0).data.mean() > 20
