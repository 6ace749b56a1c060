"""The scenes that come with the simulated rig, by name.

Frame of a scene: x right, y up, z towards the rig, origin where all devices look, in mm.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from backend.devices.errors import RigConfigError
from backend.devices.sim.bust import bust
from backend.devices.sim.materials import (
    BLACK_PLASTIC,
    DARK_CAST,
    DARK_COVER,
    PLASTER,
    TABLE,
    WOOD,
    Material,
)
from backend.devices.sim.meshfile import scene_from_file
from backend.devices.sim.scene import Part, Scene
from backend.devices.sim.shapes import (
    Mesh,
    box,
    cylinder,
    join,
    plate,
    sphere,
    turned_smooth,
)

BRUSHED_STEEL = Material(albedo=0.16, specular=0.25, roughness=0.3, mirror=0.26)
"""Rolled sheet: broad highlight, and a clear picture of its neighbourhood."""
MACHINED = Material(albedo=0.16, specular=0.2, roughness=0.2, mirror=0.12)


def scene(name: str) -> Scene:
    """Build a scene by its name.

    Parameters
    ----------
    name
        One of `SCENES`, `mesh:FILE[?TABLE]`, or `sprayed:` before either.

    Raises
    ------
    RigConfigError
        If there is no such scene, or the file or table can't be read.
    """
    check_name(name)
    if name.startswith("sprayed:"):
        return scene(name.removeprefix("sprayed:")).sprayed()
    if name.startswith("mesh:"):
        path, _, table = name.removeprefix("mesh:").partition("?")
        return scene_from_file(Path(path), Path(table) if table else None)
    return SCENES[name]()


def check_name(name: str) -> None:
    """Refuse a name that no scene has, without building anything.

    Raises
    ------
    RigConfigError
        If there is no such scene; whether a mesh file can be read shows when it is.
    """
    plain = name.removeprefix("sprayed:")
    if not plain.startswith("mesh:") and plain not in SCENES:
        raise RigConfigError(
            f"simulated rig: there is no scene {name!r}; choose {', '.join(SCENES)},"
            " mesh:FILE[?TABLE], or put sprayed: before one of them"
        )


def _high_contrast() -> Scene:
    plaster = bust().moved(-54, -112, 14, turn_deg=(0, 12, 0))
    return Scene(
        "high-contrast",
        (
            Part("plaster", plaster, PLASTER),
            Part("blocks", _blocks().moved(84, -112, 12, turn_deg=(0, -7, 0)), WOOD),
            Part("cover", _cover(190, 236).moved(28, -6, -40, turn_deg=(-5, 0, 0)), DARK_COVER),
        ),
    )


def _blocks() -> Mesh:
    """Make toy blocks standing on y = 0: two cubes, a lintel, a third cube."""
    cube = box(42, 42, 42, chamfer=1.2)
    return join(
        [
            cube.moved(-26, 21, 0, turn_deg=(0, 3, 0)),
            cube.moved(27, 21, 3, turn_deg=(0, -6, 0)),
            box(98, 24, 40, chamfer=1.2).moved(0, 54.2, 0),
            box(38, 38, 38, chamfer=1.2).moved(6, 85.4, 0, turn_deg=(0, -11, 0)),
        ]
    )


def _cover(width: float, height: float) -> Mesh:
    """Make the cover of a thick book, face to z, with an embossed frame and title, in [mm]."""
    boards = box(width, height, 16, chamfer=1.0)
    inset, rim, relief = 12.0, 3.0, 0.8
    z = 8 + relief / 2
    bars = [
        box(width - 2 * inset, rim, relief).moved(0, side * (height / 2 - inset), z)
        for side in (-1, 1)
    ] + [
        box(rim, height - 2 * inset, relief).moved(side * (width / 2 - inset), 0, z)
        for side in (-1, 1)
    ]
    title = [
        box(length, 7, relief).moved(0, height / 2 - 34 - 15 * row, z)
        for row, length in enumerate((84, 56))
    ]
    return join([boards, *bars, *title])


def _metal() -> Scene:
    bracket = _bracket().moved(-52, -46, 14, turn_deg=(22, 16, 0))
    return Scene(
        "metal",
        (
            Part("bracket", bracket, BRUSHED_STEEL),
            Part("cover", _cover(150, 214).moved(84, 0, -24, turn_deg=(-4, -8, 0)), DARK_COVER),
        ),
    )


def _bracket() -> Mesh:
    """Make an angle bracket of sheet: a wall with two holes and a pressed boss, a foot with two holes, rolled edges."""
    width, height, reach, thick = 128.0, 112.0, 54.0, 5.0
    wall = plate(width, height, thick, [(-36, 22, 9), (36, 22, 9)]).moved(0, height / 2, 0)
    foot = plate(width, reach, thick, [(-36, -4, 8), (36, -4, 8)]).moved(
        0, thick / 2, (thick + reach) / 2, turn_deg=(-90, 0, 0)
    )
    boss = _dome(21, 6).moved(0, 72, thick / 2)
    edge = cylinder(4.5, width, chamfer=1.0)
    rolled = [
        edge.moved(0, height, 0, turn_deg=(0, 90, 0)),
        edge.moved(0, thick / 2, thick / 2 + reach, turn_deg=(0, 90, 0)),
    ]
    return join([wall, foot, boss, *rolled])


def _dome(radius: float, height: float) -> Mesh:
    """Make a pressed boss on z = 0: a cap of a sphere that is `height` high."""
    r = (radius**2 + height**2) / (2 * height)
    polar = np.linspace(np.arcsin(radius / r), 1e-4, 60)
    return turned_smooth(np.column_stack([r * np.sin(polar), r * np.cos(polar) - r + height]))


def _workpieces() -> Scene:
    lean = (-16.0, 0.0, 0.0)
    table = box(440, 340, 10).moved(0, 0, -5)
    parts = {
        "table": (table, TABLE),
        "black": (_housing().moved(-104, 8, 0, turn_deg=(0, 0, 12)), BLACK_PLASTIC),
        "dark": (_bearing_block().moved(2, 26, 0), DARK_CAST),
        "shiny": (_step_block().moved(100, -14, 0, turn_deg=(0, 0, -14)), MACHINED),
    }
    return Scene(
        "workpieces",
        tuple(
            Part(name, mesh.moved(0, 0, -14, turn_deg=lean), material)
            for name, (mesh, material) in parts.items()
        ),
    )


def _housing() -> Mesh:
    """Make a moulded plug housing lying on z = 0: body, collar, two sockets, ribs."""
    body = box(84, 92, 30, chamfer=4).moved(0, 0, 15)
    collar = box(60, 66, 12, chamfer=3).moved(0, 4, 33)
    sockets = [cylinder(11, 14, chamfer=1.5).moved(side * 15, 14, 42) for side in (-1, 1)]
    ribs = [box(50, 4, 8, chamfer=1).moved(0, -12 - 9 * row, 40) for row in range(2)]
    flange = box(104, 26, 10, chamfer=2).moved(0, -40, 5)
    return join([body, collar, *sockets, *ribs, flange])


def _bearing_block() -> Mesh:
    """Make a cast bearing block lying on z = 0: round recess, hub, four bosses."""
    web = cylinder(44, 12, chamfer=1.5).moved(0, 0, 6)
    rim = plate(92, 92, 20, [(0, 0, 36)]).moved(0, 0, 10)
    hub = cylinder(15, 34, chamfer=2).moved(0, 0, 17)
    bosses = [
        cylinder(5, 18, chamfer=1).moved(24 * np.cos(a), 24 * np.sin(a), 9)
        for a in np.pi / 4 + np.arange(4) * np.pi / 2
    ]
    return join([web, rim, hub, *bosses])


def _step_block() -> Mesh:
    """Make a machined block lying on z = 0: two steps, an upright cheek, a polished pin."""
    low = box(84, 96, 14, chamfer=1).moved(0, 0, 7)
    high = box(84, 40, 16, chamfer=1).moved(0, 28, 22)
    cheek = box(10, 56, 30, chamfer=1).moved(-37, -20, 29)
    pin = cylinder(9, 26, chamfer=1.5).moved(16, -18, 27)
    return join([low, high, cheek, pin])


def _plane() -> Scene:
    return Scene("plane", (Part("plane", box(330, 250, 8).moved(0, 0, -4), PLASTER),))


def _sphere() -> Scene:
    return Scene("sphere", (Part("sphere", sphere(60).moved(0, 0, -20), PLASTER),))


def _step() -> Scene:
    """Make four treads side by side, 1, 5 and 20 mm apart."""
    depths = (0.0, -1.0, -6.0, -26.0)
    treads = [
        Part(f"tread-{index + 1}", box(60, 190, 40).moved(-90 + 60 * index, 0, z - 20), PLASTER)
        for index, z in enumerate(depths)
    ]
    return Scene("step", tuple(treads))


SCENES: Mapping[str, Callable[[], Scene]] = MappingProxyType(
    {
        "high-contrast": _high_contrast,
        "metal": _metal,
        "workpieces": _workpieces,
        "plane": _plane,
        "sphere": _sphere,
        "step": _step,
    }
)
"""Scenes by name; each is built anew by its function."""
