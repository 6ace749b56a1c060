"""A picture that an operator paints on: strokes of a factor, undo, and what it looks like with them."""

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32

Tool = Literal["brush", "rectangle", "ellipse"]
Point = tuple[float, float]

_MOST_STROKES = 40
"""Strokes that can be taken back: each keeps a copy."""
_FINE = 16
"""OpenCV draws at sixteenths of a pixel when told so."""
_SHIFT = 4


class Canvas:
    """Factors over a picture.

    Parameters
    ----------
    base
        What the stage found, factors in [0, 1]: what is seen where nothing is painted.
    painted
        What was painted before, NaN where nothing; None: nothing anywhere.
    """

    def __init__(
        self, base: Float32[np.ndarray, "h w"], painted: Float32[np.ndarray, "h w"] | None = None
    ) -> None:
        self.base = base
        self.painted = np.full(base.shape, np.nan, np.float32) if painted is None else painted
        self._past: list[Float32[np.ndarray, "h w"]] = []

    @property
    def strokes(self) -> int:
        """How many can be taken back."""
        return len(self._past)

    @property
    def whole(self) -> Float32[np.ndarray, "h w"]:
        """The factors as they would be used: painted ones, else those of the stage."""
        return np.where(np.isnan(self.painted), self.base, self.painted)

    def stroke(
        self, tool: Tool, path: list[Point], *, radius_px: float, factor: float | None
    ) -> None:
        """Paint; a factor of None takes away what was painted there."""
        self._remember()
        self.painted = self.painted.copy()
        self.painted[shape(self.base.shape, tool, path, radius_px)] = (
            np.nan if factor is None else factor
        )

    def scale(self, times: float) -> None:
        """Multiply the whole picture; what would be above 1 is 1."""
        self._remember()
        self.painted = np.clip(self.whole * np.float32(times), 0.0, 1.0).astype(np.float32)

    def undo(self) -> None:
        """Take the last stroke back; nothing happens if there is none."""
        if self._past:
            self.painted = self._past.pop()

    def _remember(self) -> None:
        self._past = [*self._past[-_MOST_STROKES + 1 :], self.painted]


def shape(
    size: tuple[int, ...], tool: Tool, path: list[Point], radius_px: float
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that a stroke covers.

    Parameters
    ----------
    size
        Height and width.
    tool
        Brush: everything within the radius of the path. Rectangle and ellipse: between its first and last point.
    path
        Points x, y in pixels, centres at integers.
    """
    drawn = np.zeros(size[:2], np.uint8)
    corners = np.array([path[0], path[-1]])
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    if tool == "rectangle":
        rows = slice(max(round(top), 0), max(round(bottom) + 1, 0))
        drawn[rows, max(round(left), 0) : max(round(right) + 1, 0)] = 1
    elif tool == "ellipse":
        middle = _fine((left + right) / 2), _fine((top + bottom) / 2)
        axes = _fine((right - left) / 2), _fine((bottom - top) / 2)
        cv2.ellipse(drawn, middle, axes, 0.0, 0.0, 360.0, 1, -1, cv2.LINE_8, _SHIFT)
    else:
        points = (np.array(path) * _FINE).round().astype(np.int32)[:, None]
        cv2.polylines(drawn, [points], False, 1, max(1, round(2 * radius_px)), cv2.LINE_8, _SHIFT)
        for x, y in (path[0], path[-1]):
            cv2.circle(
                drawn, (_fine(x), _fine(y)), max(_fine(radius_px), 1), 1, -1, cv2.LINE_8, _SHIFT
            )
    return drawn.astype(np.bool_)


def _fine(value: float) -> int:
    return round(float(value) * _FINE)
