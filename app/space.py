"""The 3D scene of one browser: how the rig's world lies in it, and from where it is looked at.

The rig's world is in mm, +Z away from the reference camera. In the scene +Z is up, away from the table, the point
that the cameras look at is the origin, and one unit is 100 mm: viser's clipping planes and speeds fit that.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

Array = NDArray[Any]

UNIT = 0.01
"""Scene units per mm."""
_FOV_RAD = np.deg2rad(42.0)
_ELEVATION_RAD = np.deg2rad(30.0)


@dataclass(frozen=True)
class Placement:
    """scene = R (rig_mm - origin_mm) UNIT."""

    R: Array
    origin_mm: Array

    @classmethod
    def of(cls, up: Array, right: Array, origin_mm: Array) -> "Placement":
        """Turn so that `up` becomes +Z and `right`, as far as it is level, +X."""
        z = up / np.linalg.norm(up)
        x = right - (right @ z) * z
        x /= np.linalg.norm(x)
        return cls(np.stack([x, np.cross(z, x), z]), np.asarray(origin_mm, dtype=np.float64))

    def to_rig_mm(self, scene: Array) -> Array:
        """Return where a point of the scene lies in the rig's world."""
        return np.asarray(self.R.T @ (np.asarray(scene) / UNIT) + self.origin_mm)

    def direction_to_rig(self, direction: Array) -> Array:
        """Return a direction of the scene in the rig's world."""
        return np.asarray(self.R.T @ np.asarray(direction))

    def to_scene(self, point_mm: Array) -> Array:
        """Return where a point of the rig's world lies in the scene."""
        return np.asarray(self.R @ (np.asarray(point_mm) - self.origin_mm) * UNIT)


LYING = Placement.of(
    np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 700.0])
)
"""Where nothing is known: a camera that looks down on a table."""


class Space:
    """Root of the scene of one browser: everything of the rig's world hangs under `root`."""

    root = "/rig world"

    def __init__(self, client: viser.ClientHandle) -> None:
        self.client = client
        self.scene = client.scene
        self.placement = LYING
        self._reach = 7.0
        self._frame = client.scene.add_frame(self.root, show_axes=False)
        self._grid = client.scene.add_grid(
            "/grid", 30.0, 30.0, cell_size=0.5, section_size=2.5, cell_thickness=0.6, section_thickness=0.9,
            cell_color=(52, 58, 68), section_color=(72, 80, 93), infinite_grid=True, fade_distance=34.0, fade_strength=1.4,
        )  # fmt: skip
        client.camera.fov = float(_FOV_RAD)
        client.camera.near = 0.02
        self.place(LYING, reach=7.0)
        self.view_rig()

    def place(
        self, placement: Placement, *, reach: float | None = None, floor_mm: float = 0.0
    ) -> None:
        """Turn the rig's world; `reach` is how far (in scene units) the rig is from its target."""
        self.placement = placement
        self._reach = reach or self._reach
        self._frame.wxyz = viser.transforms.SO3.from_matrix(placement.R).wxyz
        self._frame.position = tuple(placement.to_scene(np.zeros(3)))
        self._grid.position = (0.0, 0.0, floor_mm * UNIT)

    def set_visible(self, visible: bool) -> None:
        """Show or hide the rig's world and the grid."""
        self._frame.visible = visible
        self._grid.visible = visible

    def view_rig(self) -> None:
        """Look from the front at rig and part together."""
        middle = np.array([0.0, 0.0, 0.42 * self._reach])
        self._look(middle, 0.67 * self._reach, _ELEVATION_RAD)

    def view_part(self, middle: Array, radius: float) -> None:
        """Look at the part alone, from above and in front."""
        elevation = np.deg2rad(58.0)
        # Up in the picture: the small panel lies below, and takes more room of a narrow one.
        is_narrow = (self.client.camera.aspect or 1.0) < 1.0
        down = np.array([0.0, -np.sin(elevation), -np.cos(elevation)])
        self._look(middle + (0.28 if is_narrow else 0.12) * radius * down, 1.02 * radius, elevation)

    def view_top(self, middle: Array, radius: float) -> None:
        """Look down on the part, as the cameras do."""
        self._look(middle, 1.02 * radius, np.deg2rad(89.0))

    def pose(self) -> tuple[Array, Array]:
        """Return where the viewer is and what is looked at."""
        return np.array(self.client.camera.position), np.array(self.client.camera.look_at)

    def set_pose(self, position: Array, look_at: Array) -> None:
        """Put the viewer somewhere."""
        camera = self.client.camera
        with self.client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = tuple(position)
            camera.look_at = tuple(look_at)

    def _look(self, at: Array, half_height: float, elevation_rad: float) -> None:
        aspect = min(self.client.camera.aspect or 1.0, 1.0)
        distance = half_height / np.tan(_FOV_RAD / 2) / max(aspect, 0.6)
        away = np.array([0.0, -np.cos(elevation_rad), np.sin(elevation_rad)])
        self.set_pose(at + distance * away, at)
