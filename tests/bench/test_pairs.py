"""How fast two GigE Vision cameras deliver 1280x1024 over loopback: by software trigger, and by a trigger line."""

import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace

import numpy as np
import pytest

from backend.devices.drivers.aravis_camera import AravisCamera, AravisOptions
from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.errors import DeviceError, IncompleteFrame
from backend.devices.protocols import TriggerSource

try:
    aravis()
except AravisMissingError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.bench

ADDRESSES = ("127.79.0.2", "127.79.0.3")
PAIRS = 200


@pytest.fixture(scope="module")
def peers() -> Iterator[list["subprocess.Popen[str]"]]:
    command = [sys.executable, "-m", "tests.bench.prerendered"]
    with ExitStack() as stack:
        running = [
            stack.enter_context(
                subprocess.Popen(
                    [*command, address, "1280x1024"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
            for address in ADDRESSES
        ]
        for process in running:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "ready"
        yield running
        for process in running:
            assert process.stdin is not None
            process.stdin.close()


@pytest.fixture
def cameras(peers: list["subprocess.Popen[str]"]) -> Iterator[list[AravisCamera]]:
    with ExitStack() as stack:
        yield [
            stack.enter_context(AravisCamera(f"camera {address}", AravisOptions(address=address)))
            for address in ADDRESSES
        ]


def shoot(camera: AravisCamera) -> bool:
    camera.trigger()
    with suppress(IncompleteFrame):
        camera.get_frame(2.0)
        return True
    return False


def test_software_triggered_pairs(cameras: list[AravisCamera]) -> None:
    """At least 40 pairs a second, none lost; on a machine that isn't doing anything else."""
    for camera in cameras:
        camera.configure(replace(camera.settings, exposure_us=1000.0, pixel_format="Mono8"))
        camera.arm()
    with ThreadPoolExecutor(len(cameras)) as threads:
        list(threads.map(shoot, cameras))
        took_s, whole = [], 0
        for _ in range(PAIRS):
            began_s = time.perf_counter()
            whole += sum(threads.map(shoot, cameras))
            took_s.append(time.perf_counter() - began_s)
    ms = 1e3 * np.array(took_s)
    print(
        f"{1e3 / ms.mean():.1f} pairs/s; {np.median(ms):.1f} ms median, {np.percentile(ms, 95):.1f} ms at 95 %;"
        f" {2 * PAIRS - whole} of {2 * PAIRS} frames lost"
    )
    assert whole == 2 * PAIRS
    assert 1e3 / np.median(ms) >= 40.0


def test_hardware_timed_frames(
    peers: list["subprocess.Popen[str]"], cameras: list[AravisCamera]
) -> None:
    """24 patterns at 16.7 ms: every frame of both cameras, on the nominal time line."""
    for camera in cameras:
        camera.configure(
            replace(camera.settings, exposure_us=12_000.0, trigger=TriggerSource.LINE1)
        )
        camera.arm(24)
    start_s = time.monotonic() + 0.3
    for process in peers:
        assert process.stdin is not None
        process.stdin.write(f"edges {start_s!r} 24 0.016667\n")
        process.stdin.flush()
    for camera in cameras:
        frames = [camera.get_frame(5.0) for _ in range(24)]
        spacing_s = np.diff([frame.timestamp_s for frame in frames])
        np.testing.assert_allclose(spacing_s, 0.016667, atol=1e-6)
        with pytest.raises(DeviceError):
            camera.get_frame(0.1)
    print(f"24 of 24 frames of each camera, the last {time.monotonic() - start_s - 0.1:.2f} s after the first edge")  # fmt: skip
