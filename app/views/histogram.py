"""Counts per gray level, the fitted curve, and zones whose borders can be dragged.

The chart only shows; a slider with one thumb per border lies below it, aligned with the plot. While a thumb moves,
zones and their shares are redrawn at once from the counts that are here already.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app import markup
from app.numbers import number, percent
from app.palette import label_colour, rgb
from app.views.curve import axes

Array = NDArray[Any]

_HEIGHT_PX = 158
_FILL = 0.55
_THIN = 1e-3
_ABOVE_ALL = 99.0
_GAP_GRAY = 2.0
"""Two borders keep at least so far from each other."""


@dataclass(frozen=True)
class Counts:
    """What is drawn.

    Parameters
    ----------
    counts
        Pixels per gray level 0, 1, 2 ...
    fit
        Fitted curve, same length; None if there is none.
    borders
        Borders between zones in [gray], increasing; with or without the two ends.
    peaks
        One per zone, if they are known: they tell whether the ends are among the borders.
    """

    counts: Array
    fit: Array | None = None
    borders: tuple[float, ...] = ()
    peaks: tuple[float, ...] | None = None

    @property
    def ends_included(self) -> bool:
        """True if the first and last border are the outer ends of the first and last zone."""
        return self.peaks is None or len(self.borders) > len(self.peaks)

    def zones(self) -> list[tuple[float, float]]:
        """Return each zone's lower and upper border."""
        if not self.borders:
            return []
        edges = list(self.borders)
        if not self.ends_included:
            edges = [0.0, *edges, float(len(self.counts) - 1)]
        return list(itertools.pairwise(edges))

    def shares(self) -> list[float]:
        """Return each zone's share of all pixels; a zone is open below and closed above."""
        total = float(np.nansum(self.counts)) or 1.0
        gray = np.arange(len(self.counts))
        zones = self.zones()
        return [
            float(np.nansum(self.counts[((gray > low) | ((i == 0) & (gray >= low))) & (gray <= high)])) / total
            for i, (low, high) in enumerate(zones)
        ]  # fmt: skip


class HistogramView:
    """A histogram in the container that is open when it is made.

    Parameters
    ----------
    on_drag
        Told the borders while they are dragged, on viser's event loop; None: nothing can be dragged.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        shown: Counts,
        *,
        x_title: str = "gray",
        on_drag: Callable[[tuple[float, ...]], None] | None = None,
    ) -> None:
        self._gui, self._shown, self._on_drag = gui, shown, on_drag
        top = float(np.log10(1.0 + np.nanmax(shown.counts, initial=1.0))) * 1.06
        last = float(len(shown.counts) - 1)
        data = _series_data(shown)
        self._chart = gui.add_uplot(
            data,
            _series(shown, len(data)),
            scales={"x": {"time": False, "range": (0.0, last)}, "y": {"range": (0.0, top)}},
            axes=axes(x_title, "log₁₀ pixels"),
            legend={"show": False},
            cursor={"drag": {"x": False, "y": False}},
            height=_HEIGHT_PX,
            padding=(8, 14, 0, 0),
        )
        self._slider = self._add_slider(last) if on_drag and shown.borders else None
        self._chips = gui.add_html(chips_html(shown))

    @property
    def slider(self) -> Any:
        """The slider with the borders, None if they can't be dragged."""
        return self._slider

    def show(self, borders: Sequence[float]) -> None:
        """Draw other borders: the present setting, or a draft of it."""
        if len(borders) != len(self._shown.borders):
            return  # another number of zones: the next result brings another chart
        self._redraw(tuple(float(b) for b in borders))
        if self._slider is not None:
            self._slider.value = tuple(float(b) for b in borders)

    def _add_slider(self, last: float) -> Any:
        self._gui.add_html(markup.marker("ug-borders"))
        borders = tuple(float(np.clip(b, 0.0, last)) for b in self._shown.borders)
        slider = self._gui.add_multi_slider(
            "", min=0.0, max=last, step=0.5, initial_value=borders, min_range=_GAP_GRAY,
            marks=((0.0, ""), (last, "")),
        )  # fmt: skip

        @slider.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None and self._on_drag is not None:
                self._redraw(tuple(slider.value))
                self._on_drag(tuple(slider.value))

        return slider

    def _redraw(self, borders: tuple[float, ...]) -> None:
        if borders == self._shown.borders:
            return
        old = self._shown
        self._shown = Counts(old.counts, old.fit, borders, old.peaks)
        self._chart.data = _series_data(self._shown)
        self._chips.content = chips_html(self._shown)


def chips_html(shown: Counts) -> str:
    """Return one chip per zone: its range and its share of the pixels."""
    cells = []
    for i, ((low, high), share) in enumerate(zip(shown.zones(), shown.shares(), strict=True)):
        head = f"<b>{i + 1}</b> {markup.esc(number(round(low)))}–{markup.esc(number(round(high)))}"
        body = markup.div("ug-zone-range", head) + markup.div(
            "ug-zone-share", markup.esc(percent(share))
        )
        cells.append(
            f'<div class="ug-zone" style="border-color:{label_colour(i + 1)}">{body}</div>'
        )
    return markup.div("ug-zones", "".join(cells)) if cells else ""


def _series_data(shown: Counts) -> tuple[Array, ...]:
    """Return x, counts, one filled part per zone, fit, borders. Zones are 0 outside: NaN blanks the chart.

    Three samples more at each border make its line upright and the zones end exactly there.
    """
    gray = np.arange(len(shown.counts), dtype=np.float64)
    borders = np.clip(np.array(shown.borders, dtype=np.float64), 0.0, gray[-1])
    x = np.unique(np.concatenate([gray, borders - _THIN, borders, borders + _THIN]))
    x = x[(x >= 0.0) & (x <= gray[-1])]
    heights = np.interp(x, gray, _log(shown.counts))
    parts = [np.where((x >= low) & (x <= high), heights, 0.0) for low, high in shown.zones()]
    fit = [] if shown.fit is None else [np.interp(x, gray, _log(shown.fit))]
    spikes = np.where(np.isin(x, borders), _ABOVE_ALL, 0.0)
    return (x, heights, *parts, *fit, spikes)


def _series(shown: Counts, count: int) -> tuple[Any, ...]:
    outline = {
        "label": "pixels",
        "stroke": "rgba(203,213,225,.9)",
        "width": 1,
        "points": {"show": False},
    }
    if not shown.borders:
        outline["fill"] = "rgba(79,131,224,.45)"
    zones = [
        {"label": f"zone {i + 1}", "fill": f"rgba{(*rgb(label_colour(i + 1)), _FILL)}", "width": 0, "points": {"show": False}}
        for i in range(len(shown.zones()))
    ]  # fmt: skip
    fit = (
        []
        if shown.fit is None
        else [
            {
                "label": "fit",
                "stroke": "#ffffff",
                "width": 1.4,
                "dash": (4, 3),
                "points": {"show": False},
            }
        ]
    )
    spikes = {
        "label": "border",
        "stroke": "rgba(255,255,255,.85)",
        "width": 1,
        "points": {"show": False},
    }
    series = ({"label": "gray"}, outline, *zones, *fit, spikes)
    assert len(series) == count, "one description per line"
    return series


def _log(counts: Array) -> Array:
    return np.asarray(np.log10(1.0 + np.nan_to_num(np.maximum(counts, 0.0))), dtype=np.float64)
