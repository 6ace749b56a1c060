"""Colours: of labels, of states, and the maps that quantities are drawn with."""

from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from backend.contract.colours import BACKGROUND_RGB, LABEL_COLOURS

Array = NDArray[Any]

MISSING = "#b3353f"
CAMERAS = ("#5b9bf5", "#f0705c", "#55c59a", "#c58bea")
PROJECTOR = "#d7dde6"

STATES = {
    "unavailable": ("#5d6673", "unavailable"),
    "pending": ("#7d8796", "not run"),
    "running": ("#4c9bff", "running"),
    "done": ("#3fae6a", "done"),
    "awaiting_review": ("#e8a33d", "your decision"),
    "accepted": ("#3fae6a", "accepted"),
    "rejected": ("#e25555", "rejected"),
    "failed": ("#e25555", "failed"),
    "given": ("#6fa3b8", "given"),
    "idle": ("#7d8796", "idle"),
}
"""Colour and words of every state that a stage or scan can be in."""
LEVELS = {"ok": ("#3fae6a", "✓"), "warning": ("#e8a33d", "!"), "failure": ("#e25555", "✕")}

_COLORMAPS = {
    "turbo": cv2.COLORMAP_TURBO,
    "viridis": cv2.COLORMAP_VIRIDIS,
    "twilight": cv2.COLORMAP_TWILIGHT,
    "inferno": cv2.COLORMAP_INFERNO,
}


def label_colour(label: int) -> str:
    """Return the colour of a label, 1 is the first."""
    return LABEL_COLOURS[(label - 1) % len(LABEL_COLOURS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the channels of #rrggbb."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@cache
def colours(colormap: str) -> Array:
    """Return the 256 x 3 colours (RGB, uint8) of a map; an unknown name is gray."""
    levels = np.arange(256, dtype=np.uint8)
    if colormap not in _COLORMAPS:
        return np.repeat(levels[:, None], 3, axis=1)
    bgr = cv2.applyColorMap(levels[:, None], _COLORMAPS[colormap])
    return np.ascontiguousarray(bgr[:, 0, ::-1])


def stops(colormap: str, count: int = 17) -> list[str]:
    """Return colours from low to high for a gradient."""
    table = colours(colormap)[np.linspace(0, 255, count).astype(int)]
    return ["#{:02x}{:02x}{:02x}".format(*colour) for colour in table]


def paint(values: Array, low: float, high: float, colormap: str) -> Array:
    """Return RGB for values; not finite ones get the background's colour."""
    scale = max(high - low, 1e-30)
    finite = np.isfinite(values)
    index = np.clip((np.where(finite, values, low) - low) * (255.0 / scale), 0, 255)
    painted: Array = colours(colormap)[index.astype(np.uint8)]
    painted[~finite] = BACKGROUND_RGB
    return painted
