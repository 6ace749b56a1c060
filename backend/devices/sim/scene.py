"""What stands before the simulated rig: parts with a shape and a material."""

from dataclasses import dataclass, replace

from backend.devices.sim.materials import MATTE_WHITE, Material
from backend.devices.sim.shapes import Mesh


@dataclass(frozen=True)
class Part:
    """One thing in a scene."""

    name: str
    mesh: Mesh
    material: Material


@dataclass(frozen=True)
class Scene:
    """Everything that stands before the rig."""

    name: str
    parts: tuple[Part, ...]

    def sprayed(self) -> "Scene":
        """Cover everything with matte white, as with developer spray: the reference for completeness."""
        parts = tuple(replace(part, material=MATTE_WHITE) for part in self.parts)
        return Scene(f"sprayed:{self.name}", parts)
