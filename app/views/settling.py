"""How a projector's light follows its acknowledgement: share of the change over the delay, both ways."""

from typing import Any

import numpy as np
import viser

from app import markup
from app.numbers import number
from app.palette import label_colour
from app.views.curve import axes
from backend.contract.rigs import LatencyView

_HEIGHT_PX = 132
_THIN = 1e-3
_UP, _DOWN = label_colour(3), label_colour(1)


class SettlingChart:
    """The chart in the container that is open when it is made; nobody sees it before there is something to show."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._place = gui.add_folder(None, visible=False)
        self._chart: Any = None
        with self._place:
            self._chart_place = gui.add_folder(None)
            self._words = gui.add_html("")
        self._shown: LatencyView | None = None

    def show(self, found: LatencyView | None) -> None:
        """Draw a measurement; None: nothing was measured."""
        if found == self._shown:
            return
        self._shown = found
        self._place.visible = found is not None
        if found is not None:
            self._draw(found)
            self._words.content = words_html(found)

    def _draw(self, found: LatencyView) -> None:
        if self._chart is not None:
            self._chart.remove()
        delays = np.array(found.delays_ms)
        around = found.settle_ms + np.array([-_THIN, 0.0, _THIN])
        reach = 1.08 * max(found.settle_ms, float(delays[-1]))
        x = np.unique(np.concatenate([delays, around, [reach]]))
        up, down = (np.interp(x, delays, np.array(values)) for values in (found.up, found.down))
        mark = np.where(x == found.settle_ms, 2.0, -1.0)
        with self._chart_place:
            self._chart = self._gui.add_uplot(
                (x, up, down, mark),
                (
                    {"label": "delay"},
                    _line("black to white", _UP, 4.0),  # below the other one, which often covers it
                    _line("white to black", _DOWN, 1.4),
                    {"label": "settle time", "stroke": "rgba(255,255,255,.8)", "width": 1.2, "dash": (4, 3), "points": {"show": False}},
                ),
                scales={"x": {"time": False, "range": (0.0, reach)}, "y": {"range": (-0.05, 1.1)}},
                axes=axes("after the acknowledgement [ms]", "share of change"),
                legend={"show": False}, cursor={"drag": {"x": False, "y": False}},
                height=_HEIGHT_PX, padding=(8, 14, 0, 0),
            )  # fmt: skip


def words_html(found: LatencyView) -> str:
    """Return what the lines mean, and the result in words."""
    keys = "".join(
        f'<span><i style="background:{colour}"></i>{markup.esc(text)}</span>'
        for colour, text in ((_UP, "black to white"), (_DOWN, "white to black"))
    )
    when = found.measured.astimezone()
    fate = " ".join(filter(None, ("Kept for this rig." if found.kept else "", found.note)))
    rows = [
        ("Settle time", f"{number(found.settle_ms, 3)} ms"),
        ("Measured", f"{when.day} {when:%b %Y, %H:%M} at {number(found.refresh_hz, 4)} Hz"),
    ]
    note = markup.div("ug-text ug-doc", markup.esc(fate))
    return markup.div("ug-curves", keys) + markup.facts(rows) + note


def _line(label: str, colour: str, width: float) -> Any:
    return {
        "label": label,
        "stroke": colour,
        "width": width,
        "points": {"show": True, "size": 4, "fill": colour},
    }
