"""Pictures side by side with a line of text above each: figures of reports, drawn with OpenCV."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from backend.services.previews import Kind, draw

PANEL_PX = 360
_CAPTION_PX = 22
_INK = (230, 230, 230)
_PAPER = (30, 25, 22)

Picture = UInt8[np.ndarray, "_h _w 3"]
"""Blue, green, red, as OpenCV has them."""


class Panel(NamedTuple):
    """One picture of a contact sheet."""

    caption: str
    picture: Picture


class Row(NamedTuple):
    """Panels side by side under one headline."""

    headline: str
    panels: Sequence[Panel]


def drawn(
    values: np.ndarray[Any, np.dtype[Any]],
    colormap: str = "gray",
    limits: tuple[float | None, float | None] = (None, None),
    *,
    kind: Kind = "picture",
    size_px: int = PANEL_PX,
) -> Picture:
    """Draw a map in the station's colours, its longer side `size_px`."""
    low, high = limits
    encoded = draw(
        np.asarray(values),
        max_px=size_px,
        colormap=colormap,
        low=low,
        high=high,
        kind=kind,
        format="jpeg",
    )
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def contact_sheet(rows: Sequence[Row], *, otherwise: str = "no pictures") -> Picture:
    """Put rows of panels below each other; one line of text if there are none."""
    made = [_row(row) for row in rows if row.panels]
    if not made:
        return line_of_text(otherwise, PANEL_PX)
    width_px = max(picture.shape[1] for picture in made)
    return np.vstack([_widened(picture, width_px) for picture in made])


def line_of_text(text: str, width_px: int) -> Picture:
    """Write a text as one line of a picture; what is too long for it is cut off."""
    line = np.full((_CAPTION_PX, width_px, 3), _PAPER, np.uint8)
    cv2.putText(
        line, text, (4, _CAPTION_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA
    )
    return line


def png(picture: Picture) -> bytes:
    """Encode a picture."""
    done, data = cv2.imencode(".png", picture)
    assert done, "an uint8 picture of three channels can always be written"
    return data.tobytes()


def _row(row: Row) -> Picture:
    height_px = max(panel.picture.shape[0] for panel in row.panels)
    pictures = np.hstack([_captioned(panel, height_px) for panel in row.panels])
    return np.vstack([line_of_text(row.headline, pictures.shape[1]), pictures])


def _captioned(panel: Panel, height_px: int) -> Picture:
    width_px = panel.picture.shape[1]
    below = np.full((height_px - panel.picture.shape[0], width_px, 3), _PAPER, np.uint8)
    return np.vstack([line_of_text(panel.caption, width_px), panel.picture, below])


def _widened(picture: Picture, width_px: int) -> Picture:
    beside = np.full((picture.shape[0], width_px - picture.shape[1], 3), _PAPER, np.uint8)
    return np.hstack([picture, beside])
