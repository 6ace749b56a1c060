"""Gray levels of live pictures: one line per camera over the whole range."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from app.palette import CAMERAS
from app.views.curve import axes

_HEIGHT_PX = 138
_BINS = 256
_TOP = 6.6
"""log10 of four million pixels."""


def camera_colour(order: int) -> str:
    """Return the colour of a rig's first, second ... camera."""
    return CAMERAS[order % len(CAMERAS)]


class LevelsChart:
    """The chart in the container that is open when it is made; another set of cameras makes it anew."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._place = gui.add_folder(None)
        self._chart: Any = None
        self._cameras: tuple[str, ...] | None = None
        self._is_odd = False

    def show(self, cameras: Sequence[str], histograms: Mapping[str, Sequence[int]]) -> None:
        """Draw the counts of each camera; without any, nothing changes."""
        if not histograms:
            return
        none = np.zeros(_BINS)
        lines = [np.log10(1.0 + np.asarray(histograms.get(c, none), np.float64)) for c in cameras]
        data = (np.arange(_BINS, dtype=np.float64), *lines)
        if tuple(cameras) != self._cameras:
            self._make(tuple(cameras), data)
            return
        # A chart that gets other data while it is being made writes no x axis until the axis changes: let it, always.
        self._is_odd = not self._is_odd
        data[0][-1] += 1e-3 * self._is_odd
        self._chart.data = data

    def clear(self) -> None:
        """Take the chart away: another rig comes, or the page was closed."""
        if self._chart is not None:
            self._chart.remove()
        self._chart, self._cameras = None, None

    def _make(self, cameras: tuple[str, ...], data: tuple[Any, ...]) -> None:
        if self._chart is not None:
            self._chart.remove()
        self._cameras = cameras
        series: list[Any] = [
            {"label": name, "stroke": camera_colour(i), "fill": f"{camera_colour(i)}30", "width": 1.2, "points": {"show": False}}
            for i, name in enumerate(cameras)
        ]  # fmt: skip
        with self._place:
            self._chart = self._gui.add_uplot(
                data,
                ({"label": "gray"}, *series),
                scales={"x": {"time": False}, "y": {"range": (0.0, _TOP)}},
                axes=axes("gray level, 0 to 255 of full scale", "log₁₀ pixels"),
                legend={"show": False}, cursor={"drag": {"x": False, "y": False}},
                height=_HEIGHT_PX, padding=(8, 14, 0, 0),
            )  # fmt: skip
