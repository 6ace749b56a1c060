"""Live pictures side by side (or one above the other) as planes in the scene: a wheel zooms, a click asks for a place."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app.palette import rgb
from app.space import Space
from app.views.levels import camera_colour

Array = NDArray[Any]

_NODE = "/live"
_WIDTH = 10.0
_GAP = 0.5
_ALIKE = 0.05
"""Windows whose aspect differs by less show the same arrangement."""
_UPRIGHT = viser.transforms.SO3.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])).wxyz


@dataclass(frozen=True)
class _Seat:
    """Where a picture stands: its middle in the scene and its height, for a width of 10."""

    x: float
    z: float
    height: float
    size_px: tuple[int, int]


class LivePlanes:
    """The pictures of one rig's cameras."""

    def __init__(self, space: Space) -> None:
        self._space = space
        self._seats: dict[str, _Seat] = {}
        self._pictures: dict[str, viser.ImageHandle] = {}
        self._others: dict[str, Any] = {}
        self._pose: tuple[Any, Any] | None = None
        self._aspect = 1.0
        """Of the window that the pictures were arranged for."""

    @property
    def is_open(self) -> bool:
        """True while the scene is put away for pictures."""
        return self._pose is not None

    def open(self) -> None:
        """Put the scene away."""
        if self._pose is None:
            self._pose = self._space.pose()
            self._space.set_visible(False)

    def close(self) -> None:
        """Show the scene again."""
        self.clear()
        if self._pose is not None:
            self._space.set_visible(True)
            self._space.set_pose(*self._pose)
            self._pose = None

    def clear(self) -> None:
        """Take all pictures away."""
        for node in (*self._pictures.values(), *self._others.values()):
            node.remove()
        self._pictures, self._others, self._seats = {}, {}, {}

    def arrange(self, cameras: Sequence[tuple[str, int, int]]) -> bool:
        """Make room for pictures: name, width and height in [px] of each camera.

        Returns whether there was another arrangement before, or none: it is empty now.
        """
        wanted = {name: (width, height) for name, width, height in cameras}
        camera = self._space.client.camera
        aspect = max(camera.aspect or 1.0, 0.2)
        is_same_window = abs(aspect / self._aspect - 1.0) < _ALIKE
        if is_same_window and wanted == {n: seat.size_px for n, seat in self._seats.items()}:
            return False
        self.clear()
        self._aspect = aspect
        self._seats, extent = _seated(cameras, aspect)
        for order, (name, seat) in enumerate(self._seats.items()):
            self._frame(name, seat, order)
        half = max(extent[1] / 2, extent[0] / 2 / aspect) * 1.03
        self._space.set_pose(
            np.array([0.0, -half / np.tan(camera.fov / 2), 0.0]), np.array([0.0, 0.0, 0.0])
        )
        return True

    def show(self, name: str, picture_rgb: Array) -> None:
        """Show the newest picture of a camera."""
        seat = self._seats.get(name)
        if seat is None:
            return
        if name in self._pictures:
            self._pictures[name].image = picture_rgb
            return
        self._pictures[name] = self._space.scene.add_image(
            f"{_NODE}/{name}", picture_rgb, _WIDTH, seat.height, format="jpeg", jpeg_quality=85,
            wxyz=_UPRIGHT, position=(seat.x, 0.0, seat.z), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def place_of(self, origin: Any, direction: Any) -> tuple[str, int, int] | None:
        """Return the camera and the pixel that a ray of the scene hits; None if it hits no picture."""
        if abs(direction[1]) < 1e-9:
            return None
        hit = np.asarray(origin) - np.asarray(direction) * (origin[1] / direction[1])
        for name, seat in self._seats.items():
            width, height = seat.size_px
            x = ((hit[0] - seat.x) / _WIDTH + 0.5) * width - 0.5
            y = (0.5 - (hit[2] - seat.z) / seat.height) * height - 0.5
            if 0 <= round(x) < width and 0 <= round(y) < height:
                return name, round(x), round(y)
        return None

    def mark(self, name: str, x: int, y: int, size_px: int) -> None:
        """Draw a square around a part of a picture."""
        self.unmark()
        seat = self._seats.get(name)
        if seat is None:
            return
        scale = _WIDTH / seat.size_px[0]
        u = seat.x + ((x + 0.5) / seat.size_px[0] - 0.5) * _WIDTH
        v = seat.z + (0.5 - (y + 0.5) / seat.size_px[1]) * seat.height
        half = size_px * scale / 2
        self._others["mark"] = self._lines("mark", u, v, half, half, (255, 64, 220), 2.0)

    def unmark(self) -> None:
        """Take the square away."""
        if node := self._others.pop("mark", None):
            node.remove()

    def _frame(self, name: str, seat: _Seat, order: int) -> None:
        colour = rgb(camera_colour(order))
        self._others[name] = self._lines(
            f"frame {name}", seat.x, seat.z, _WIDTH / 2, seat.height / 2, colour, 1.6
        )
        self._others[f"{name} label"] = self._space.scene.add_label(
            f"{_NODE}/label {name}", name, anchor="bottom-left", font_screen_scale=1.0,
            position=(seat.x - _WIDTH / 2, 0.0, seat.z + seat.height / 2),
        )  # fmt: skip

    def _lines(
        self, node: str, x: float, z: float, half_x: float, half_z: float, colour: Any, width: float
    ) -> Any:
        corners = [
            (x + sx * half_x, -0.01, z + sz * half_z)
            for sx, sz in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
        ]
        return self._space.scene.add_line_segments(
            f"{_NODE}/{node}", np.array(list(itertools.pairwise(corners))), colour, thickness=width, thickness_units="screen"
        )  # fmt: skip


def _seated(
    cameras: Sequence[tuple[str, int, int]], aspect: float
) -> tuple[dict[str, _Seat], tuple[float, float]]:
    """Put pictures into as many columns as show them largest; also return width and height of all."""
    count = max(len(cameras), 1)
    tallest = max((_WIDTH * height / width for _, width, height in cameras), default=_WIDTH)
    cell = _WIDTH + _GAP, tallest + _GAP

    def spread(columns: int) -> tuple[float, float]:
        return columns * cell[0], -(-count // columns) * cell[1]

    columns = min(range(1, count + 1), key=lambda n: max(spread(n)[1], spread(n)[0] / aspect))
    extent = spread(columns)
    seats = {}
    for i, (name, width, height) in enumerate(cameras):
        row, column = divmod(i, columns)
        x = (column + 0.5) * cell[0] - extent[0] / 2
        z = extent[1] / 2 - (row + 0.5) * cell[1] - 0.1
        seats[name] = _Seat(x, z, _WIDTH * height / width, (width, height))
    return seats, extent
