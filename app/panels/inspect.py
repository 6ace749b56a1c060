"""One picture large in the middle, with pan and zoom; a click asks what is known of that pixel, or picks a point.

Where the picture's hint says so, dragging chooses the point that a setting takes, or paints on the picture.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from app import markup
from app.desk import Desk
from app.look import Look
from app.numbers import heading
from app.panels.paint import PaintPanel
from app.panels.pictures import Choice
from app.space import Space
from app.views.axes import Axes
from app.views.picture import Figure
from app.views.pixel import pixel_facts, pixel_html
from app.views.plane import WIDTH, Phase, PicturePlane
from app.views.response import ResponseChart

_PANEL_PX = (286, 316)
_WITH_CHART_PX = 410


@dataclass(frozen=True)
class _Shown:
    """What is large just now."""

    figure: Figure
    choice: Choice
    axes: Axes | None
    """Of a picture over two settings."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.figure.width_px, self.figure.height_px

    def holds(self, x: float, y: float) -> bool:
        """Tell whether there is such a pixel."""
        return 0 <= x < self.figure.width_px and 0 <= y < self.figure.height_px


class Inspector:
    """Shows one figure as a plane in the scene and the answers in a small panel."""

    def __init__(self, client: viser.ClientHandle, space: Space, desk: Desk) -> None:
        self._client, self._space, self._desk = client, space, desk
        self._shown: _Shown | None = None
        self._plane = PicturePlane(space)
        self._pose: tuple[Any, Any] | None = None
        self._asked: tuple[int, int] | None = None
        self._make_panel(client.gui)
        self._paint = PaintPanel(client.gui, desk, self._plane)

    @property
    def is_open(self) -> bool:
        """True while a picture is shown large."""
        return self._shown is not None

    @property
    def figure(self) -> Figure | None:
        """The picture that is shown large."""
        return self._shown.figure if self._shown else None

    def show(self, choice: Choice, figure: Figure, picture_rgb: Any, look: Look) -> None:
        """Show a picture large in place of the scene."""
        old = self._shown
        if old is None:
            self._pose = self._space.pose()
        is_other = (
            old is None or old.figure.camera != figure.camera or old.size_px != (figure.width_px, figure.height_px)
        )  # fmt: skip
        shown = _Shown(figure, choice, Axes.of(self._desk.api, choice.stage, choice.field))
        self._shown = shown
        self._space.set_visible(False)
        paints = self._paint.open(look, choice, figure, picture_rgb)
        picks = shown.axes is not None and shown.axes.setting is not None and look.may_operate
        on_drag = self._paint.dragged if paints else self._drag_point if picks else None
        self._plane.show(picture_rgb, *shown.size_px, on_drag)
        if paints:
            self._paint.redraw()
        if shown.axes is not None and shown.axes.point is not None:
            self._plane.mark_point(*shown.axes.pixel_of(*shown.axes.point))
        if is_other:
            self._face()
        self._open_panel(f"{_title(choice)}, {figure.camera}".removesuffix(", "), figure)
        self._answer.content = markup.div("ug-empty", _invitation(paints=paints, picks=picks))
        self._show_chart(None)
        if self._asked is not None and not is_other:
            self.ask(look, *self._asked)

    def close(self) -> None:
        """Show the scene again."""
        self._plane.remove()
        self._paint.close()
        self._panel.visible = False
        self._asked = None
        if self._shown is None:
            return
        self._shown = None
        self._space.set_visible(True)
        if self._pose is not None:
            self._space.set_pose(*self._pose)

    def click(self, look: Look, origin: Any, direction: Any) -> None:
        """Ask the pixel that a ray of the scene hits; where a point can be chosen, choose it."""
        shown, hit = self._shown, self._plane.pixel(origin, direction)
        if shown is None or hit is None:
            return
        x, y = round(hit[0]), round(hit[1])
        if not shown.holds(x, y):
            return
        self.ask(look, x, y)
        self._choose(look, x, y)

    def ask(self, look: Look, x: int, y: int) -> None:
        """Say what is known of a pixel, and mark it."""
        shown = self._shown
        if shown is None or not shown.holds(x, y):
            return
        figure = shown.figure
        self._asked = (x, y)
        self._x.value, self._y.value = x, y
        self._plane.mark_pixel(x, y)
        size = (figure.height_px, figure.width_px)
        facts = pixel_facts(self._desk.api, look, figure.camera, size, x, y)
        axes = markup.facts(shown.axes.rows(x, y)) if shown.axes is not None else ""
        self._answer.content = axes + pixel_html(facts)
        self._show_chart((look, x, y))

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

    # ---- a point that a setting takes

    def _choose(self, look: Look, x: float, y: float) -> None:
        shown = self._shown
        axes = shown.axes if shown else None
        if shown is None or axes is None or axes.setting is None or not look.may_operate:
            return
        artifact = shown.figure.artifact
        if artifact and self._desk.api.value_at(artifact, round(x), round(y)) is None:
            self._desk.notify(
                "Not there", "The stage refuses this point: choose another one.", colour="orange"
            )
            if axes.point is not None:
                self._plane.mark_point(*axes.pixel_of(*axes.point))
            return
        self._plane.mark_point(x, y)
        self._desk.set_draft(axes.setting, axes.value_at(x, y))

    def _drag_point(self, phase: Phase, x: float, y: float) -> None:
        shown, look = self._shown, self._desk.look
        if shown is None or shown.axes is None or look is None:
            return
        at = min(max(x, 0), shown.figure.width_px - 1), min(max(y, 0), shown.figure.height_px - 1)
        if phase == "end":
            self._desk.load(lambda: self.ask(look, round(at[0]), round(at[1])), key="pixel")
            self._desk.load(lambda: self._choose(look, *at))
        else:
            self._desk.load(lambda: self._plane.mark_point(*at), key="drag")

    # ---- the small panel

    def _make_panel(self, gui: viser.GuiApi) -> None:
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Pixel", viser.Icon.FOCUS_2):
            self._head = gui.add_html("")
            gui.add_html(markup.marker("ug-row2"))
            self._x: Any = gui.add_number("x [px]", 0, min=0, step=1)
            self._y: Any = gui.add_number("y [px]", 0, min=0, step=1)
            self._chart = ResponseChart(gui)
            self._answer = gui.add_html("")
        self._panel.float(x=-14, y=-14, width=_PANEL_PX[0], height=_PANEL_PX[1])
        for control in (self._x, self._y):
            self._listen(control)

    def _show_chart(self, asked: tuple[Look, int, int] | None) -> None:
        """Show the gray levels of the asked pixel over their axis, where the frames have one."""
        shown = self._shown
        field = shown.choice.field if shown else None
        has_axis = field is not None and field.hint.get("kind") == "frames" and field.hint.get("x")
        if asked is None or shown is None or field is None or not has_axis:
            was_visible, self._chart.visible = self._chart.visible, False
            if was_visible:
                self._panel.set_height(_PANEL_PX[1])
            return
        look, x, y = asked
        levels = self._desk.api.levels_at(
            look.scan.id, shown.choice.stage.name, field.name, camera=shown.figure.camera, x=x, y=y
        )
        if not self._chart.visible:
            self._panel.set_height(_WITH_CHART_PX)
        self._chart.show(levels, *_axis_title(shown.choice))

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

    def _face(self) -> None:
        """Look straight at the picture; where there is room below it, the small panel finds its place there."""
        camera, height = self._client.camera, self._plane.height
        aspect = max(camera.aspect or 1.0, 0.1)
        half = max(height / 2, WIDTH / 2 / aspect) * 1.04
        lower = np.array([0.0, 0.0, min(0.0, 0.5 * height - 0.97 * half)])
        self._space.set_pose(lower - [0.0, half / np.tan(camera.fov / 2), 0.0], lower)


def _title(choice: Choice) -> str:
    return str(choice.field.hint.get("title") or choice.field.name)


def _axis_title(choice: Choice) -> tuple[str, str]:
    """Return title and unit of what the frames' gray levels are shown over."""
    name = str(choice.field.hint.get("x"))
    field = next((f for f in choice.stage.fields if f.name == name), None)
    words, unit = heading(name)
    if field is not None and field.hint.get("title"):
        return str(field.hint["title"]), str(field.hint.get("unit") or "")
    return words[:1].upper() + words[1:], unit


def _invitation(*, paints: bool, picks: bool) -> str:
    if paints:
        return "Drag to paint. Click a pixel to ask it. Wheel and right button zoom and pan."
    if picks:
        return (
            "Click or drag to choose a point, then apply it. Wheel and right button zoom and pan."
        )
    return "Click a pixel, or type where it is. Wheel and right button zoom and pan."
