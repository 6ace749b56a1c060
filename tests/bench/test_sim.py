"""What a frame of the simulated rig costs, as times and as ratio to copying a large array."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from backend.devices.sim import create_rig

pytestmark = pytest.mark.bench


@pytest.fixture(scope="module", params=["1280x960", "2592x1944"])
def rig(request):
    with create_rig({"scene": "metal", "size": request.param}) as rig:
        width, height = rig.projector.capabilities.size
        x = (np.arange(width) + 0.5) / width
        fringes = [np.rint(130 + 90 * np.cos(2 * np.pi * 64 * x + k)) for k in range(8)]
        rig.projector.load([np.broadcast_to(f, (height, width)).astype(np.uint8) for f in fringes])
        yield rig


@pytest.mark.parametrize("exposure_ms", [25.0, 600.0], ids=["dark", "saturated"])
def test_a_frame(benchmark, rig, exposure_ms):
    """One camera, a new pattern each time: the budget is 150 ms at 1280x960."""
    camera = rig.cameras["left"]
    camera.configure(replace(camera.settings, exposure_us=1000 * exposure_ms))
    camera.arm()
    shown = iter(range(10**9))

    def shot() -> Any:
        rig.projector.show(next(shown) % 8)
        camera.trigger()
        return camera.get_frame()

    shot()
    benchmark.pedantic(shot, rounds=15)
    camera.disarm()
    if rig.config.size == (1280, 960):
        assert benchmark.stats.stats.median < 0.15


def test_copying_256_mib(benchmark):
    """What the times above are to be compared with."""
    source, target = np.ones(1 << 25), np.empty(1 << 25)
    benchmark.pedantic(np.copyto, (target, source), rounds=9, warmup_rounds=1)
