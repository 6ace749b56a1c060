"""The gray levels of one pixel over what was projected, with the line that was fitted to them."""

from typing import Any

import numpy as np
import viser

from app import markup
from app.numbers import number
from app.palette import label_colour
from app.views.curve import axes
from backend.contract.scans import PixelLevels

_HEIGHT_PX = 132


class ResponseChart:
    """A chart in the container that is open when it is made; nobody sees it before it has something to show."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._place = gui.add_folder(None, visible=False)
        self._chart: Any = None
        self._made_for: tuple[Any, ...] = ()
        with self._place:
            self._chart_place = gui.add_folder(None)
            self._note = gui.add_html("")

    @property
    def visible(self) -> bool:
        """True while it shows a pixel."""
        return bool(self._place.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._place.visible = visible

    def show(self, levels: PixelLevels, title: str, unit: str) -> None:
        """Show a pixel; the chart is made anew only for other frames."""
        x, gray, line = lines(levels)
        made_for = (title, unit, levels.full_scale_gray, len(x), float(x[0]), float(x[-1]))
        if made_for != self._made_for:
            self._made_for = made_for
            self._make(x, levels.full_scale_gray, f"{title} [{unit}]" if unit else title)
        self._chart.data = (x, gray, line)
        self._note.content = markup.div("ug-curves", note(levels))
        self.visible = True

    def _make(self, x: Any, full_scale_gray: float, x_title: str) -> None:
        if self._chart is not None:
            self._chart.remove()
        reach = float(max(x[-1], 1e-9)) * 1.03
        zeros = np.zeros_like(x)
        with self._chart_place:
            self._chart = self._gui.add_uplot(
                (x, zeros, zeros),
                (
                    {"label": x_title},
                    {"label": "gray", "stroke": label_colour(1), "width": 0, "points": {"show": True, "size": 6, "fill": label_colour(1)}},
                    {"label": "line", "stroke": "#ffffff", "width": 1.3, "dash": (4, 3), "points": {"show": False}},
                ),
                scales={"x": {"time": False, "range": (min(0.0, float(x[0])), reach)}, "y": {"range": (0.0, 1.06 * full_scale_gray)}},
                axes=axes(x_title, "gray"), legend={"show": False}, cursor={"drag": {"x": False, "y": False}},
                height=_HEIGHT_PX, padding=(8, 14, 0, 0),
            )  # fmt: skip


def lines(levels: PixelLevels) -> tuple[Any, Any, Any]:
    """Return the axis in order, the gray levels over it, and the fitted line (or, without one, the gray levels)."""
    axis = levels.axis if levels.axis is not None else range(len(levels.gray))
    x = np.asarray(axis, dtype=np.float64)
    order = np.argsort(x, kind="stable")
    x, gray = x[order], np.asarray(levels.gray, dtype=np.float64)[order]
    if levels.slope is None or levels.offset is None:
        return x, gray, gray
    return x, gray, np.clip(levels.slope * x + levels.offset, 0.0, 2.0 * levels.full_scale_gray)


def note(levels: PixelLevels) -> str:
    """Say the line in numbers."""
    if levels.slope is None or levels.offset is None:
        return markup.span("", "no line fits this pixel")
    full = sum(g >= levels.full_scale_gray for g in levels.gray)
    text = f"slope {number(levels.slope)}, offset {number(levels.offset)} gray"
    return markup.span("", markup.esc(text + (f", {full} saturated" if full else "")))
