"""One camera's picture large in the middle, with pan and zoom; a click asks what is known of that pixel."""

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import viser

from app import markup
from app.client import ApiClient
from app.desk import Desk
from app.look import Look, fields_of_kind
from app.numbers import quantity
from app.palette import BACKGROUND
from app.space import Space
from app.views.mask import Labels
from app.views.picture import Figure
from backend.contract.rigs import CameraView, RigView

_WIDTH = 10.0
"""Width of the picture in scene units."""
_NODE = "/inspection"
_PANEL_PX = (286, 316)
_CROSS = (255, 64, 220)
"""In none of the colour maps."""


@dataclass(frozen=True)
class PixelFacts:
    """What is known of one pixel."""

    reasons: tuple[str, ...]
    """Why it is missing; empty if it isn't."""
    rows: tuple[tuple[str, str], ...]


class Inspector:
    """Shows one figure as a plane in the scene and the answers in a small panel."""

    def __init__(self, client: viser.ClientHandle, space: Space, desk: Desk) -> None:
        self._client, self._space, self._desk = client, space, desk
        self._figure: Figure | None = None
        self._nodes: list[Any] = []
        self._pose: tuple[Any, Any] | None = None
        self._asked: tuple[int, int] | None = None
        self._make_panel(client.gui)

    @property
    def is_open(self) -> bool:
        """True while a picture is shown large."""
        return self._figure is not None

    @property
    def figure(self) -> Figure | None:
        """The picture that is shown large."""
        return self._figure

    def show(self, title: str, figure: Figure, picture_rgb: Any, look: Look) -> None:
        """Show a picture large in place of the scene."""
        if self._figure is None:
            self._pose = self._space.pose()
        is_other = self._figure is None or self._figure.camera != figure.camera
        self._remove_nodes()
        self._figure = figure
        self._space.set_visible(False)
        height = _WIDTH * figure.height_px / figure.width_px
        facing = viser.transforms.SO3.from_matrix(
            np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        ).wxyz
        self._nodes.append(
            self._space.scene.add_image(
                f"{_NODE}/picture",
                picture_rgb,
                _WIDTH,
                height,
                format="jpeg",
                jpeg_quality=92,
                wxyz=facing,
                cast_shadow=False,
                receive_shadow=False,
            )
        )
        if is_other:
            self._face(height)
        self._open_panel(f"{title}, {figure.camera}", figure)
        self._answer.content = markup.div(
            "ug-empty", "Click a pixel, or type where it is. Wheel and right button zoom and pan."
        )
        if self._asked is not None and not is_other:
            self.ask(look, *self._asked)

    def close(self) -> None:
        """Show the scene again."""
        self._remove_nodes()
        self._panel.visible = False
        self._asked = None
        if self._figure is None:
            return
        self._figure = None
        self._space.set_visible(True)
        if self._pose is not None:
            self._space.set_pose(*self._pose)

    def click(self, look: Look, origin: Any, direction: Any) -> None:
        """Ask the pixel that a ray of the scene hits."""
        figure = self._figure
        if figure is None or abs(direction[1]) < 1e-9:
            return
        hit = np.asarray(origin) - np.asarray(direction) * (origin[1] / direction[1])
        height = _WIDTH * figure.height_px / figure.width_px
        x = round((hit[0] / _WIDTH + 0.5) * figure.width_px - 0.5)
        y = round((0.5 - hit[2] / height) * figure.height_px - 0.5)
        if 0 <= x < figure.width_px and 0 <= y < figure.height_px:
            self.ask(look, x, y)

    def ask(self, look: Look, x: int, y: int) -> None:
        """Say what is known of a pixel, and mark it."""
        figure = self._figure
        if figure is None or not (0 <= x < figure.width_px and 0 <= y < figure.height_px):
            return
        self._asked = (x, y)
        self._x.value, self._y.value = x, y
        self._mark(figure, x, y)
        self._answer.content = pixel_html(
            pixel_facts(
                self._desk.api, look, figure.camera, (figure.height_px, figure.width_px), x, y
            )
        )

    def show_point(
        self, look: Look, rows: list[tuple[str, str]], pixel: tuple[str, int, int] | None
    ) -> None:
        """Say what is known of a point of the cloud, and of the pixel that saw it."""
        self._panel.visible = True
        self._x.visible = self._y.visible = False
        self._head.content = self._title("Point of the cloud")
        answer = markup.facts(rows)
        if pixel is not None:
            camera, x, y = pixel
            facts = pixel_facts(self._desk.api, look, camera, None, x, y)
            answer += markup.div(
                "ug-heading", markup.esc(f"Pixel {x}, {y} of {camera}")
            ) + pixel_html(facts)
        self._answer.content = answer

    def _make_panel(self, gui: viser.GuiApi) -> None:
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Pixel", viser.Icon.FOCUS_2):
            self._head = gui.add_html("")
            gui.add_html(markup.marker("ug-row2"))
            self._x: Any = gui.add_number("x [px]", 0, min=0, step=1)
            self._y: Any = gui.add_number("y [px]", 0, min=0, step=1)
            self._answer = gui.add_html("")
        self._panel.float(x=-14, y=-14, width=_PANEL_PX[0], height=_PANEL_PX[1])
        for control in (self._x, self._y):
            self._listen(control)

    def _listen(self, control: Any) -> None:
        async def changed(event: viser.GuiEvent[Any]) -> None:
            look = self._desk.look
            if event.client is not None and look is not None:
                self._desk.load(
                    lambda: self.ask(look, int(self._x.value), int(self._y.value)), key="pixel"
                )

        control.on_update(changed)

    def _open_panel(self, title: str, figure: Figure) -> None:
        self._panel.visible = True
        self._x.visible = self._y.visible = True
        self._x.max, self._y.max = figure.width_px - 1, figure.height_px - 1
        self._head.content = self._title(title)

    def _title(self, title: str) -> str:
        close = self._desk.clicks.label(
            "leave inspection",
            self._desk.leave_inspection,
            "✕ close",
            "ug-link",
            "Back to the scene (key X)",
        )
        return markup.div("ug-caption ug-pixel", markup.span("ug-name", markup.esc(title)) + close)

    def _face(self, height: float) -> None:
        """Look straight at the picture; where there is room below it, the small panel finds its place there."""
        camera = self._client.camera
        aspect = max(camera.aspect or 1.0, 0.1)
        half = max(height / 2, _WIDTH / 2 / aspect) * 1.04
        lower = np.array([0.0, 0.0, min(0.0, 0.5 * height - 0.97 * half)])
        self._space.set_pose(lower - [0.0, half / np.tan(camera.fov / 2), 0.0], lower)

    def _mark(self, figure: Figure, x: int, y: int) -> None:
        size = _WIDTH / figure.width_px
        u, v = (
            ((x + 0.5) / figure.width_px - 0.5) * _WIDTH,
            (0.5 * figure.height_px - y - 0.5) * size,
        )
        arm, gap = 0.25, max(0.06, 0.6 * size)
        lines = [
            [
                [u + s * gap * dx, -0.01, v + s * gap * dy],
                [u + s * arm * dx, -0.01, v + s * arm * dy],
            ]
            for s in (-1, 1)
            for dx, dy in ((1, 0), (0, 1))
        ]
        cross = self._space.scene.add_line_segments(
            f"{_NODE}/cross",
            np.array(lines),
            _CROSS,
            thickness=2.0,
            thickness_units="screen",
        )
        self._nodes = [n for n in self._nodes if n.name != cross.name] + [cross]

    def _remove_nodes(self) -> None:
        for node in self._nodes:
            node.remove()
        self._nodes = []


def pixel_facts(
    api: ApiClient, look: Look, camera: str, shape: tuple[int, int] | None, x: int, y: int
) -> PixelFacts:
    """Ask every map of this camera up to the stage on the screen for one pixel; reasons first."""
    reasons: list[str] = []
    rows: list[tuple[str, str]] = []
    for stage in look.upto_stage():
        for field in fields_of_kind(stage, "picture", "mask"):
            reference = field.arrays.get(camera)
            if reference is None or not _contains(reference.shape, shape, x, y):
                continue
            value = api.value_at(reference.hash, x, y)
            title = str(field.hint.get("title") or field.name)
            if field.hint.get("kind") == "picture":
                rows.append((title, quantity(value, str(field.hint.get("unit") or ""))))
                continue
            labels = Labels.of(field.hint)
            found = labels.reasons(int(value or 0))
            if labels.bits:
                reasons += found
            rows.append((title, ", ".join(found) or "–"))
    return PixelFacts(tuple(dict.fromkeys(reasons)), tuple(rows))


def _contains(shape: tuple[int, ...], wanted: tuple[int, int] | None, x: int, y: int) -> bool:
    inside = len(shape) >= 2 and 0 <= y < shape[0] and 0 <= x < shape[1]
    return inside and (wanted is None or tuple(shape[:2]) == wanted)


def pixel_html(facts: PixelFacts) -> str:
    """Return why a pixel is missing, and all its values."""
    why = ""
    if facts.reasons:
        why = markup.div("ug-why", "Missing: " + markup.esc(", ".join(facts.reasons)))
    return why + markup.facts(_first_of_each(facts.rows))


def _first_of_each(rows: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Keep the newest of several maps with the same title."""
    kept: dict[str, str] = {}
    for title, text in rows:
        kept.setdefault(title, text)
    return list(kept.items())


def pixel_of(rig: RigView, point_mm: Any) -> tuple[str, int, int] | None:
    """Return the reference camera's pixel that sees a point of the rig's world, None if it has no model."""
    camera = next((c for c in rig.cameras if c.name == rig.reference), None)
    if camera is None or camera.model is None:
        return None
    x, y = _project(camera, np.asarray(point_mm, dtype=np.float64))
    inside = 0 <= x < camera.model.width_px and 0 <= y < camera.model.height_px
    return (camera.name, x, y) if inside else None


def _project(camera: CameraView, point_mm: Any) -> tuple[int, int]:
    assert camera.model is not None, "asked only of a camera with a model"
    pose = camera.camera_from_world
    R = np.array(pose.R) if pose else np.eye(3)
    t = np.array(pose.t_mm) if pose else np.zeros(3)
    pixels, _ = cv2.projectPoints(
        point_mm[None],
        cv2.Rodrigues(R)[0],
        t,
        np.array(camera.model.K),
        np.array(camera.model.distortion),
    )
    u, v = pixels[0, 0]
    return round(float(u)), round(float(v))


def decoded(body: bytes) -> Any:
    """Return RGB from the bytes of a picture; what is transparent gets the background's colour."""
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None, "the API sends PNG and JPEG"
    if picture.ndim == 2:
        return cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
    rgb = cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2RGB)
    if picture.shape[2] == 4:
        rgb[picture[..., 3] == 0] = BACKGROUND
    return rgb


def decoded_url(address: str) -> Any:
    """Return RGB from a picture that is contained in its address."""
    return decoded(base64.b64decode(address.partition(",")[2]))
