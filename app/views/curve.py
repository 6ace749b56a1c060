"""Curves over an axis, as uPlot draws them: it needs neither `eval` nor 5 MB of script."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app import markup
from app.palette import label_colour

Array = NDArray[Any]

AXIS = {"stroke": "#9aa4b2", "grid": {"stroke": "rgba(148,163,184,.13)", "width": 1}, "ticks": {"stroke": "rgba(148,163,184,.3)", "size": 4}}  # fmt: skip
FONT = "11px system-ui, sans-serif"
_MOST_SAMPLES = 2000


@dataclass(frozen=True)
class Axis:
    """What stands at an axis."""

    title: str = ""
    unit: str = ""

    @property
    def text(self) -> str:
        """Title and unit."""
        return (
            f"{self.title} [{self.unit}]" if self.unit and self.title else self.title or self.unit
        )


def add_curves(
    gui: viser.GuiApi,
    values: Array,
    *,
    x: Array | None = None,
    x_axis: Axis,
    y_axis: Axis,
    names: Sequence[str] = (),
    log_y: bool = False,
    height_px: int = 150,
) -> viser.GuiUplotHandle:
    """Draw curves, (n,) or (curves, n); over what isn't finite (or not positive on a log axis) the line is straight.

    uPlot goes blank over NaN.
    """
    lines = np.atleast_2d(np.asarray(values, dtype=np.float64))
    across = (
        np.arange(lines.shape[1], dtype=np.float64)
        if x is None
        else np.asarray(x, dtype=np.float64)
    )
    step = max(1, lines.shape[1] // _MOST_SAMPLES)
    drawn = [_drawable(line[::step], log=log_y) for line in lines]
    title = y_axis.text
    titles = list(names) or [str(i + 1) for i in range(len(lines))]
    series: list[Any] = [{"label": x_axis.text or "x"}]
    series += [
        {"label": name, "stroke": label_colour(i + 1), "width": 1.6, "points": {"show": False}}
        for i, name in enumerate(titles)
    ]
    chart = gui.add_uplot(
        (across[::step], *drawn),
        tuple(series),
        scales={"x": {"time": False}, "y": {"distr": 3 if log_y else 1}},
        axes=axes(x_axis.text, title),
        legend={"show": False},
        cursor={"drag": {"x": False, "y": False}},
        height=height_px,
        padding=(8, 14, 0, 0),
    )
    if len(lines) > 1:
        gui.add_html(markup.div("ug-curves", "".join(_key(i, t) for i, t in enumerate(titles))))
    return chart


def _key(index: int, title: str) -> str:
    return f'<span><i style="background:{label_colour(index + 1)}"></i>{markup.esc(title)}</span>'


def axes(x_title: str, y_title: str) -> tuple[Any, ...]:
    """Return both axes in the colours of the page."""
    bottom: dict[str, Any] = {**AXIS, "size": 26, "space": 50, "font": FONT}
    if x_title:
        bottom |= {"label": x_title, "labelSize": 16, "labelFont": FONT, "labelGap": 0}
    left: dict[str, Any] = {**AXIS, "size": 38, "space": 26, "font": FONT}
    if y_title:
        left |= {"label": y_title, "labelSize": 16, "labelFont": FONT, "labelGap": 0}
    return bottom, left


def _drawable(line: Array, *, log: bool) -> Array:
    """Put a straight line over what can't be drawn: a gap, or what isn't positive on a logarithmic axis."""
    usable = np.isfinite(line) & ((line > 0) | (not log))
    if not usable.any():
        return np.ones_like(line) if log else np.zeros_like(line)
    samples = np.arange(len(line))
    return np.interp(samples, samples[usable], line[usable])
