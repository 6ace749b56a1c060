"""Painting on the enlarged picture: tools, undo, and a button that makes a setting of it."""

from typing import Any, get_args

import cv2
import numpy as np
import viser

from app import markup
from app.client import ApiError
from app.desk import Desk
from app.look import Look
from app.panels.pictures import Choice
from app.views.painting import Canvas, Point, Tool
from app.views.picture import Figure
from app.views.plane import Phase, PicturePlane

_PANEL_PX = (250, 350)
_PAINT = np.array([232, 163, 61], np.float32)
"""Amber, as everything that was changed but not applied."""
_TINT = 0.35
_TURN = 25
"""Corners of an ellipse's outline."""


class PaintPanel:
    """The tools in a small panel, and what they do to the picture on the plane."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, plane: PicturePlane) -> None:
        self._gui, self._desk, self._plane = gui, desk, plane
        self._canvas: Canvas | None = None
        self._subject: tuple[Any, ...] = ()
        self._picture: Any = None
        self._is_mask = False
        self._setting = ""
        self._path: list[Point] = []
        self._make_panel(gui)

    def open(self, look: Look, choice: Choice, figure: Figure, picture_rgb: Any) -> bool:
        """Offer the tools if a setting of the stage takes what is painted on this picture; tell whether it does."""
        setting = paintable(look, choice)
        if setting is None or figure.artifact is None:
            self.close()
            return False
        subject = (look.scan.id, choice.stage.name, setting, figure.width_px, figure.height_px)
        strokes = self._canvas if self._subject == subject else None
        self._is_mask = choice.field.hint.get("kind") == "mask"
        self._canvas = self._fresh(look, setting, figure.artifact)
        if strokes is not None and strokes.strokes:
            self._canvas.painted = (
                strokes.painted
            )  # not applied yet: another result doesn't take it away
        self._subject, self._setting, self._picture = subject, setting, picture_rgb
        title = markup.span(
            "ug-name", markup.esc(str(choice.field.hint.get("title") or choice.field.name))
        )
        self._head.content = markup.div("ug-caption ug-pixel", title)
        self._panel.visible = True
        self._tell()
        return True

    def close(self) -> None:
        """Put the tools away; strokes that aren't applied stay until another picture is painted on."""
        self._panel.visible = False

    def dragged(self, phase: Phase, x: float, y: float) -> None:
        """Follow the pointer: an outline at first, paint at the end."""
        self._path = [(x, y)] if phase == "start" else [*self._path, (x, y)]
        path = list(self._path)
        if phase == "end":
            self._desk.load(lambda: self._stroke(path))
        else:
            self._desk.load(
                lambda: self._plane.outline(_outline(self._tool.value, path)), key="drag"
            )

    def redraw(self) -> None:
        """Show the picture with what is painted."""
        if self._canvas is not None:
            self._plane.change(tinted(self._picture, self._canvas.painted))
            self._tell()

    def _fresh(self, look: Look, setting: str, artifact: str) -> Canvas:
        base = factors(self._desk.api.array(artifact))
        present = look.stage.settings[setting].value
        if not isinstance(present, str):
            return Canvas(base)
        try:
            painted = factors(self._desk.api.array(present))
        except ApiError:
            return Canvas(base)
        return Canvas(base, painted if painted.shape == base.shape else None)

    def _stroke(self, path: list[Point]) -> None:
        canvas = self._canvas
        if canvas is not None and path:
            factor = None if self._clear.value else float(self._factor.value)
            canvas.stroke(self._tool.value, path, radius_px=self._size.value / 2, factor=factor)
        self._plane.outline([])
        self.redraw()

    def _undo(self) -> None:
        if self._canvas is not None:
            self._canvas.undo()
            self.redraw()

    def _scale(self) -> None:
        if self._canvas is not None:
            self._canvas.scale(float(self._times.value))
            self.redraw()

    def _apply(self) -> None:
        canvas, setting = self._canvas, self._setting
        if canvas is None:
            return
        picture = canvas.whole if self._is_mask else canvas.painted
        reference = self._desk.api.upload_mask(picture)
        self._canvas = Canvas(canvas.base, canvas.painted)
        self._tell()
        self._desk.set_draft(setting, reference.hash)
        self._desk.apply()

    def _reset(self) -> None:
        if self._canvas is None:
            return
        self._canvas = Canvas(self._canvas.base)
        self.redraw()
        look = self._desk.look
        view = look.stage.settings.get(self._setting) if look is not None else None
        if view is not None and view.source == "edited":
            self._desk.reset(self._setting)

    def _tell(self) -> None:
        canvas = self._canvas
        if canvas is None:
            return
        share = float(np.mean(~np.isnan(canvas.painted)))
        count = f"{canvas.strokes} not applied" if canvas.strokes else "nothing to apply"
        self._note.content = markup.div("ug-note ug-pixel", f"{100 * share:.1f} % painted, {count}")
        self._back.disabled = self._go.disabled = not canvas.strokes

    def _make_panel(self, gui: viser.GuiApi) -> None:
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Paint", viser.Icon.BRUSH):
            self._head = gui.add_html("")
            self._tool: Any = gui.add_dropdown("Tool", get_args(Tool))
            self._size: Any = gui.add_slider("Width [px]", min=1, max=400, step=1, initial_value=60)
            self._factor: Any = gui.add_slider(
                "Factor", min=0.0, max=1.0, step=0.05, initial_value=0.3
            )
            self._clear: Any = gui.add_checkbox(
                "Erase", False, hint="Strokes bring back what the stage found"
            )
            gui.add_html(markup.marker("ug-row2"))
            self._times: Any = gui.add_number("Times", 0.8, min=0.0, max=10.0, step=0.05)
            scale = gui.add_button("Scale all", color="gray", hint="Multiply the whole picture")
            gui.add_html(markup.marker("ug-row3"))
            self._go = gui.add_button(
                "Apply", color=(232, 163, 61), hint="Use what is painted, and run the stage again"
            )
            self._back = gui.add_button("Undo", color="gray", hint="Take the last stroke back")
            reset = gui.add_button(
                "Reset", color="gray", hint="Back to what the stage finds by itself"
            )
            self._note = gui.add_html("")
        self._panel.float(x=12, y=-14, width=_PANEL_PX[0], height=_PANEL_PX[1])
        for button, work in (
            (scale, self._scale), (self._go, self._apply), (self._back, self._undo), (reset, self._reset),
        ):  # fmt: skip
            self._listen(button, work)

    def _listen(self, button: viser.GuiButtonHandle, work: Any) -> None:
        @button.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            self._desk.load(work)


def paintable(look: Look, choice: Choice) -> str | None:
    """Return the setting that takes what is painted on a picture of the stage on the screen; None if none does."""
    hint, setting = choice.field.hint, choice.field.hint.get("edits")
    is_own = choice.stage.name == look.stage.name and setting in look.stage.settings
    is_painted = hint.get("kind") in ("picture", "mask") and not hint.get("point")
    return str(setting) if look.may_operate and is_own and is_painted else None


def factors(values: Any) -> Any:
    """Return a map as factors in [0, 1], float32; labels are 1 wherever there is one."""
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    return (values != 0).astype(np.float32)


def tinted(picture_rgb: Any, painted: Any) -> Any:
    """Return the picture with painted factors in gray and amber over it."""
    height, width = picture_rgb.shape[:2]
    seen = cv2.resize(painted, (width, height), interpolation=cv2.INTER_NEAREST)
    here = ~np.isnan(seen)
    drawn = picture_rgb.copy()
    gray = 255.0 * seen[here, None]
    drawn[here] = ((1.0 - _TINT) * gray + _TINT * _PAINT).astype(np.uint8)
    return drawn


def _outline(tool: str, path: list[Point]) -> list[Point]:
    (x, y), (u, v) = path[0], path[-1]
    if tool == "rectangle":
        return [(x, y), (u, y), (u, v), (x, v), (x, y)]
    if tool == "ellipse":
        turn = np.linspace(0.0, 2 * np.pi, _TURN)
        middle, half = ((x + u) / 2, (y + v) / 2), ((u - x) / 2, (v - y) / 2)
        return [(middle[0] + half[0] * np.cos(a), middle[1] + half[1] * np.sin(a)) for a in turn]
    return path
