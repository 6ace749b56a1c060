"""A table of numbers as a picture: each cell coloured by its value, drawn with OpenCV."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from backend.services.contact_sheet import Picture

_CELL_PX = (112, 34)
_LEFT_PX, _TOP_PX = 300, 74
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_INK, _PAPER = (36, 31, 27), (255, 255, 255)
_GOOD, _MIDDLE, _BAD = (181, 226, 188), (163, 226, 250), (160, 165, 244)
"""Green, yellow, red: blue, green, red as OpenCV has them."""


def number_grid(
    title: str,
    rows: Sequence[str],
    columns: Sequence[str],
    values: Float[np.ndarray, "row column"],
    *,
    good: float,
    bad: float,
) -> Picture:
    """Draw numbers in a grid, green up to `good`, red from `bad` on, yellow between; NaN stays empty.

    A column's title is broken at its spaces into at most three lines.
    """
    width = _LEFT_PX + _CELL_PX[0] * len(columns) + 12
    picture = np.full((_TOP_PX + _CELL_PX[1] * len(rows) + 12, width, 3), 255, np.uint8)
    _text(picture, title, (10, 20), 0.52)
    for column, name in enumerate(columns):
        for line, text in enumerate(_broken(name)):
            _text(picture, text, (_LEFT_PX + _CELL_PX[0] * column + 6, 40 + 14 * line), 0.38)
    for row, name in enumerate(rows):
        _text(picture, name, (10, _TOP_PX + _CELL_PX[1] * row + 22), 0.42)
        for column in range(len(columns)):
            _cell(picture, row, column, float(values[row, column]), good, bad)
    return picture


def _cell(picture: Picture, row: int, column: int, value: float, good: float, bad: float) -> None:
    left, top = _LEFT_PX + _CELL_PX[0] * column, _TOP_PX + _CELL_PX[1] * row
    corner = (left + _CELL_PX[0] - 3, top + _CELL_PX[1] - 3)
    colour = (
        _PAPER if np.isnan(value) else _GOOD if value <= good else _BAD if value >= bad else _MIDDLE
    )
    cv2.rectangle(picture, (left, top), corner, colour, -1)
    if not np.isnan(value):
        _text(picture, f"{value:.1f}", (left + 34, top + 22), 0.46)


def _broken(text: str) -> list[str]:
    """Break a title into lines of some 14 letters."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) > 14 and len(lines) < 3:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def _text(picture: Picture, text: str, place: tuple[int, int], size: float) -> None:
    cv2.putText(picture, text, place, _FONT, size, _INK, 1, cv2.LINE_AA)
