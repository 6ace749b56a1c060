"""The simulated rig: a product in physical units, not a mock.

Light in electrons per ms, lengths in mm: two cameras and a projector before a ray-cast scene, with shadows,
highlights, one mirror bounce, blur, glare, noise, saturation and blooming. `create_rig(options)` builds one.
`create_lcd_rig(options)` builds another: a camera that sees a screen in a mirror.
"""

from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.devices.sim.lcd_rig import SimulatedLcdRig, create_lcd_rig
from backend.devices.sim.rig import SimulatedRig, create_rig
from backend.devices.sim.scenes import SCENES

__all__ = [
    "SCENES",
    "SimulatedLcdConfig",
    "SimulatedLcdRig",
    "SimulatedRig",
    "SimulatedRigConfig",
    "create_lcd_rig",
    "create_rig",
]
