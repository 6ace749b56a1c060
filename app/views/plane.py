"""A picture as a plane in the scene: where a ray hits it, marks on it, and dragging on it."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from app.space import Space

Array = NDArray[Any]
Phase = Literal["start", "update", "end"]
OnDrag = Callable[[Phase, float, float], None]
"""Told the phase and the pixel, on viser's event loop."""

WIDTH = 10.0
"""Width of the picture in scene units."""
_NODE = "/inspection"
CROSS = (255, 64, 220)
"""In none of the colour maps."""
POINT = (255, 255, 255)


class PicturePlane:
    """Shows one picture upright; pixel centres are at integers."""

    def __init__(self, space: Space) -> None:
        self._space = space
        self._size = (1, 1)
        self._picture: viser.ImageHandle | None = None
        self._marks: dict[str, Any] = {}
        self._is_dragged = False

    @property
    def height(self) -> float:
        """Height of the picture in scene units."""
        return WIDTH * self._size[1] / self._size[0]

    def show(
        self, picture_rgb: Array, width_px: int, height_px: int, on_drag: OnDrag | None
    ) -> None:
        """Show a picture of so many pixels (it may be drawn with more or fewer)."""
        self.remove()
        self._size = (width_px, height_px)
        facing = viser.transforms.SO3.from_matrix(
            np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        ).wxyz
        self._picture = self._space.scene.add_image(
            f"{_NODE}/picture", picture_rgb, WIDTH, self.height, format="jpeg", jpeg_quality=92,
            wxyz=facing, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        if on_drag is not None:
            self._listen(self._picture, on_drag)

    def change(self, picture_rgb: Array) -> None:
        """Show another picture in its place."""
        if self._picture is not None:
            self._picture.image = picture_rgb

    def remove(self) -> None:
        """Take everything away."""
        for node in (self._picture, *self._marks.values()):
            if node is not None:
                node.remove()
        self._picture, self._marks = None, {}

    def pixel(self, origin: Any, direction: Any) -> tuple[float, float] | None:
        """Return where a ray of the scene hits the plane, in pixels; None if it never does."""
        if abs(direction[1]) < 1e-9:
            return None
        hit = np.asarray(origin) - np.asarray(direction) * (origin[1] / direction[1])
        width, height = self._size
        x = (hit[0] / WIDTH + 0.5) * width - 0.5
        y = (0.5 - hit[2] / self.height) * height - 0.5
        return float(x), float(y)

    def mark_pixel(self, x: float, y: float) -> None:
        """Draw a cross around a pixel."""
        arm, gap = 0.25, max(0.06, 0.6 * WIDTH / self._size[0])
        lines = [
            [self._place(x, y, s * gap * u, s * gap * v), self._place(x, y, s * arm * u, s * arm * v)]
            for s in (-1, 1)
            for u, v in ((1, 0), (0, 1))
        ]  # fmt: skip
        self._draw("cross", lines, CROSS)

    def mark_point(self, x: float, y: float) -> None:
        """Draw a ring around the point that is chosen."""
        turn = np.linspace(0.0, 2 * np.pi, 25)
        ring = [self._place(x, y, 0.13 * np.cos(a), 0.13 * np.sin(a)) for a in turn]
        self._draw("point", list(itertools.pairwise(ring)), POINT)

    def outline(self, path: Sequence[tuple[float, float]]) -> None:
        """Draw a line along pixels while something is dragged; an empty path takes it away."""
        corners = [self._place(x, y, 0.0, 0.0) for x, y in path]
        if len(corners) > 1:
            self._draw("outline", list(itertools.pairwise(corners)), POINT)
        elif node := self._marks.pop("outline", None):
            node.remove()

    def _place(self, x: float, y: float, right: float, up: float) -> list[float]:
        width, height = self._size
        u = ((x + 0.5) / width - 0.5) * WIDTH + right
        v = (0.5 - (y + 0.5) / height) * self.height + up
        return [u, -0.01, v]

    def _draw(self, name: str, lines: Any, colour: tuple[int, int, int]) -> None:
        self._marks[name] = self._space.scene.add_line_segments(
            f"{_NODE}/{name}", np.array(lines), colour, thickness=2.0, thickness_units="screen"
        )

    def _listen(self, picture: viser.ImageHandle, on_drag: OnDrag) -> None:
        camera = self._space.client.camera

        @picture.on_drag("left")
        async def _(event: Any) -> None:
            # Along the way from the viewer: the plane that the event is in turns with the camera.
            eye = np.array(camera.position)
            at = event.start_position if event.phase == "start" else event.end_position
            hit = self.pixel(eye, np.array(at) - eye)
            if hit is not None:
                on_drag(event.phase, *hit)
