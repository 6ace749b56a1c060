"""The simulated rig: a product in physical units, not a mock.

Light in electrons per ms, lengths in mm: two cameras and a projector before a ray-cast scene, with shadows,
highlights, one mirror bounce, blur, glare, noise, saturation and blooming. `create_rig(options)` builds one.
"""

from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.rig import SimulatedRig, create_rig
from backend.devices.sim.scenes import SCENES

__all__ = ["SCENES", "SimulatedRig", "SimulatedRigConfig", "create_rig"]
