"""Simulated cameras in processes of their own, lit from outside, seen through the real driver."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from backend.devices.drivers.aravis_camera import AravisCamera, AravisOptions
from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.peers.monitor_display import MonitorDisplay, MonitorHistory
from backend.devices.peers.simulated_cameras import Peer, PeerProcess
from backend.devices.protocols import TriggerSource
from backend.domain.errors import CancelledError, StartupError
from tests.loopback import loopback_address

try:
    aravis()
except AravisMissingError as error:
    pytest.skip(str(error), allow_module_level=True)

SIZE = (160, 100)
OPTIONS = {
    "scene": "plane",
    "size": "160x120",
    "projector_size": "160x100",
    "frame_period_ms": None,
}


@pytest.fixture(scope="module")
def address() -> str:
    return loopback_address()


@pytest.fixture(scope="module")
def history() -> Iterator[MonitorHistory]:
    """Show a level that tests choose; somebody looks at it all the time."""
    made, ending = MonitorHistory(*SIZE), threading.Event()
    made.note(flat(0), time.monotonic())

    def look() -> None:
        while not ending.wait(0.005):
            made.unchanged(time.monotonic())

    looking = threading.Thread(target=look)
    looking.start()
    yield made
    ending.set()
    looking.join()
    made.destroy()


def flat(level: int) -> np.ndarray:
    return np.full(SIZE[::-1], level, np.uint8)


@pytest.fixture(scope="module")
def process(address: str, history: MonitorHistory) -> Iterator[PeerProcess]:
    with ExitStack() as stack:
        served = PeerProcess(Peer("simulated", OPTIONS, "right", address), MonitorDisplay(history))
        stack.callback(served.stop)
        served.wait_until_ready()
        yield served
    assert not served.is_alive


@pytest.fixture
def camera(process: PeerProcess, address: str) -> Iterator[AravisCamera]:
    with AravisCamera("right", AravisOptions(address=address)) as opened:
        opened.configure(replace(opened.settings, exposure_us=20_000.0))
        yield opened


def test_it_sees_what_is_shown_while_it_exposes(
    camera: AravisCamera, history: MonitorHistory
) -> None:
    assert camera.info.serial == "SIM-R"
    camera.arm()
    means = []
    for level in (0, 128, 255):
        history.note(flat(level), time.monotonic(), since_s=time.monotonic())
        camera.trigger()
        means.append(float(camera.get_frame(5.0).data.mean()) - 4.0)
    assert means[0] < 2.0
    assert means[1] == pytest.approx(means[2] / 2, rel=0.05)


def test_the_trigger_line_exposes_what_it_was_fired_for(
    camera: AravisCamera, history: MonitorHistory, process: PeerProcess
) -> None:
    """However late the camera's process is told, it exposes the pattern of that edge."""
    camera.configure(replace(camera.settings, exposure_us=10_000.0, trigger=TriggerSource.LINE1))
    camera.arm(4)
    start_s = time.monotonic()
    for index, level in enumerate((60, 120, 180, 240)):
        number = history.note(flat(level), time.monotonic(), since_s=time.monotonic())
        process.fire(number, start_s + 0.02 * index, 15_000.0)
    frames = [camera.get_frame(5.0) for _ in range(4)]
    light = [float(frame.data.mean()) - 4.0 for frame in frames]
    np.testing.assert_allclose(np.array(light) / light[0], [1, 2, 3, 4], rtol=0.1)
    spacing_s = np.diff([frame.timestamp_s for frame in frames if frame.timestamp_s is not None])
    np.testing.assert_allclose(spacing_s, 0.02, atol=1e-6)


def test_an_address_that_is_taken_is_one_sentence(
    process: PeerProcess, address: str, history: MonitorHistory
) -> None:
    second = PeerProcess(Peer("simulated", OPTIONS, "left", address), MonitorDisplay(history))
    try:
        with pytest.raises(StartupError, match=f"{address} can't start: another camera has this"):
            second.wait_until_ready()
    finally:
        second.stop()


def test_an_address_of_another_machine_is_one_sentence(history: MonitorHistory) -> None:
    stranger = PeerProcess(Peer("simulated", OPTIONS, "left", "192.0.2.1"), MonitorDisplay(history))
    try:
        with pytest.raises(CancelledError):  # nobody has to wait for that
            stranger.wait_until_ready(lambda: True)
        with pytest.raises(StartupError, match=r"choose one of 127\.0\.0\.0/8"):
            stranger.wait_until_ready()
    finally:
        stranger.stop()
