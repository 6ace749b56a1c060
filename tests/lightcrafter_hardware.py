"""Simulated hardware of a rig with a LightCrafter: its controller, and GigE Vision cameras on its trigger line."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from backend.devices import dlpc350_protocol as protocol
from backend.devices.pattern_set import PatternSet
from backend.devices.peers.dlpc350 import SimulatedDlpc350
from backend.devices.peers.gige_camera import GigECamera
from backend.devices.sim import create_rig
from backend.devices.sim.rig import SimulatedRig

SCENE = {
    "scene": "plane",
    "size": "160x120",
    "projector_size": "x".join(map(str, protocol.SIZE_PX)),
    "realtime": True,
    "frame_period_ms": None,  # light that isn't modulated within a pattern
}


@contextmanager
def lightcrafter_hardware(
    addresses: Sequence[str], folder: Path
) -> Iterator[tuple[SimulatedDlpc350, SimulatedRig]]:
    """Light a scene by a controller whose flash holds a set, and let cameras on the network look at it."""
    simulated = create_rig(SCENE)
    flash = PatternSet.read(folder).image_pictures(folder)
    with simulated, ExitStack() as stack:
        device = stack.enter_context(SimulatedDlpc350(simulated.projector, flash))
        for camera, address in zip(simulated.cameras.values(), addresses, strict=True):
            stack.enter_context(GigECamera(camera, address))
        yield device, simulated
