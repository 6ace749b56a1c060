"""A GigE Vision camera with frames made beforehand, in a process of its own: what is measured is the way, not the picture.

`python -m tests.bench.prerendered ADDRESS SIZE` answers with `ready`. `edges START COUNT PERIOD` on its input fires its
trigger line from that monotonic time on, in [s]; the end of its input ends it.
"""

import sys
import threading
import time

import numpy as np

from backend.devices.peers.gige_camera import GigECamera
from backend.devices.sim.camera import SimulatedCamera
from backend.devices.sim.clock import MachineClock
from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.renderer import Shown

FRAMES = 8
_NEVER = threading.Event()


def camera(size: str) -> SimulatedCamera:
    config = SimulatedRigConfig.model_validate({"size": size})
    width, height = config.size
    frames = np.random.default_rng(1).integers(0, 256, (FRAMES, height, width), np.uint8)
    dark = Shown(np.zeros((1, 1), np.uint8), 0)
    return SimulatedCamera(
        "left",
        config,
        MachineClock(),
        look=lambda: dark,
        develop=lambda exposure: frames[exposure.frame_id % FRAMES],
        trigger_phase=lambda _: 0.0,
    )


def main(address: str, size: str) -> None:
    served = camera(size)
    with GigECamera(served, address):
        print("ready", flush=True)
        for line in sys.stdin:
            _, start_s, count, period_s = line.split()
            fire(served, float(start_s), int(count), float(period_s))


def fire(served: SimulatedCamera, start_s: float, count: int, period_s: float) -> None:
    dark = Shown(np.zeros((1, 1), np.uint8), 0)
    for number in range(count):
        at_s = start_s + number * period_s
        _NEVER.wait(max(0.0, at_s - time.monotonic()))
        served.line_edge(dark, at_s, period_s * 1e6)


if __name__ == "__main__":
    main(*sys.argv[1:])
