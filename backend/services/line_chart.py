"""A plain chart of a few lines for reports, drawn with OpenCV on white."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from backend.services.contact_sheet import Picture

_SIZE_PX = (640, 420)
_LEFT, _TOP, _RIGHT, _BOTTOM = 64, 40, 20, 52
_INK = (36, 31, 27)
_GRID = (225, 219, 214)
_COLOURS = ((224, 131, 79), (59, 103, 224), (106, 160, 40), (220, 121, 162))
"""Blue, green, red of the lines, in turn."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MOST_TICKS = 8


class Line(NamedTuple):
    """One line of a chart; points that aren't finite interrupt it."""

    title: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]


def line_chart(title: str, lines: Sequence[Line], *, x_title: str, y_title: str) -> Picture:
    """Draw lines over common axes that begin and end at round numbers."""
    frame = _Frame.around(lines)
    width, height = _SIZE_PX
    picture = np.full((height, width, 3), 255, np.uint8)
    for value in ticks(frame.low_x, frame.high_x):
        at, _ = frame.place(value, frame.low_y)
        cv2.line(picture, (at, _TOP), (at, height - _BOTTOM), _GRID, 1)
        _text(picture, f"{value:g}", (at - 4 * len(f"{value:g}"), height - _BOTTOM + 16))
    for value in ticks(frame.low_y, frame.high_y):
        _, at = frame.place(frame.low_x, value)
        cv2.line(picture, (_LEFT, at), (width - _RIGHT, at), _GRID, 1)
        _text(picture, f"{value:g}", (_LEFT - 6 - 8 * len(f"{value:g}"), at + 4))
    _text(picture, title, (_LEFT, 16), 0.48)
    _text(picture, x_title, (width - _RIGHT - 8 * len(x_title), height - 12))
    _text(picture, y_title, (6, 34))
    for number, line in enumerate(lines):
        colour = _COLOURS[number % len(_COLOURS)]
        _draw(picture, frame, line, colour)
        _text(picture, line.title, (_LEFT + 10, _TOP + 18 + 17 * number), colour=colour)
    return picture


def ticks(low: float, high: float) -> list[float]:
    """Return round numbers from `low` to `high`, at most eight of them.

    Examples
    --------
    >>> ticks(0, 25)
    [0.0, 5.0, 10.0, 15.0, 20.0, 25.0]
    """
    step = _step(high - low)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 12) for number in range(first, last + 1)]


def _step(span: float) -> float:
    """Return 1, 2 or 5 times a power of ten that divides a span into few parts."""
    rough = max(span, 1e-9) / (_MOST_TICKS - 1)
    power = 10.0 ** math.floor(math.log10(rough))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough - 1e-12)


class _Frame(NamedTuple):
    """Values at the edges of the chart."""

    low_x: float
    high_x: float
    low_y: float
    high_y: float

    @classmethod
    def around(cls, lines: Sequence[Line]) -> "_Frame":
        """Enclose all lines, 0 included, in round numbers."""
        edges = []
        for values in ([line.x for line in lines], [line.y for line in lines]):
            all_values = np.concatenate([np.zeros(1), *values])
            known = all_values[np.isfinite(all_values)]
            low, high = float(known.min()), float(known.max())
            high = high if high > low else low + 1.0
            step = _step(high - low)
            edges += [math.floor(low / step + 1e-9) * step, math.ceil(high / step - 1e-9) * step]
        return cls(*edges)

    def place(self, x: float, y: float) -> tuple[int, int]:
        """Return the pixel of a value."""
        width, height = _SIZE_PX
        across = (x - self.low_x) / (self.high_x - self.low_x)
        up = (y - self.low_y) / (self.high_y - self.low_y)
        return (
            round(_LEFT + across * (width - _LEFT - _RIGHT)),
            round(height - _BOTTOM - up * (height - _TOP - _BOTTOM)),
        )


def _draw(picture: Picture, frame: _Frame, line: Line, colour: tuple[int, int, int]) -> None:
    known = np.isfinite(line.x) & np.isfinite(line.y)
    places = [
        frame.place(x, y) if k else None for x, y, k in zip(line.x, line.y, known, strict=True)
    ]
    for start, end in itertools.pairwise(places):
        if start is not None and end is not None:
            cv2.line(picture, start, end, colour, 2, cv2.LINE_AA)
    for place in places:
        if place is not None and len(places) <= 60:
            cv2.circle(picture, place, 3, colour, -1, cv2.LINE_AA)


def _text(
    picture: Picture,
    text: str,
    place: tuple[int, int],
    size: float = 0.42,
    colour: tuple[int, int, int] = _INK,
) -> None:
    cv2.putText(picture, text, place, _FONT, size, colour, 1, cv2.LINE_AA)
