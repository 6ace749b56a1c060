"""The newest picture of a camera for the screen: whole or a part of it pixel by pixel, with or without marks."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from backend.contract.rigs import PartView
from backend.domain.errors import NotFoundError
from backend.numerics.live_numbers import live_numbers, mark_extremes
from backend.services.context import Context
from backend.services.previews import draw, encoded
from backend.services.rigs import refuse_unknown

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

LIVE_PX = 960
"""Longest side of a live picture unless another one is asked for."""


@dataclass(frozen=True)
class Crop:
    """A square part of a picture."""

    x: int
    y: int
    """Its middle in [px]; near an edge the square is moved inside."""
    size_px: int

    def of(self, gray: Array) -> Array:
        """Cut it out.

        Raises
        ------
        NotFoundError
            If the picture has no such pixel.
        """
        height, width = gray.shape
        if not (0 <= self.x < width and 0 <= self.y < height):
            raise NotFoundError(
                f"A picture of {width} x {height} px has no pixel at x {self.x}, y {self.y}."
            )
        left, top = _start(self.x, self.size_px, width), _start(self.y, self.size_px, height)
        return np.ascontiguousarray(gray[top : top + self.size_px, left : left + self.size_px])


def live_frame(
    context: Context,
    rig: str,
    camera: str,
    *,
    max_px: int = LIVE_PX,
    marks: bool = False,
    crop: Crop | None = None,
) -> bytes | None:
    """Return the newest picture of a camera as JPEG, None if there is none; never waits for a device.

    Parameters
    ----------
    max_px
        Longest side; a larger picture is made smaller.
    marks
        Draw saturated pixels red and those at 0 blue.
    crop
        Only this part, pixel by pixel.
    """
    picture = context.rigs.live(rig, camera)
    if picture is None:
        refuse_unknown(context, rig)
        return None
    key = ("live", rig, camera, picture.number, max_px, marks, crop)
    return context.previews.get(
        key, lambda: live_jpeg(picture.gray, picture.bit_depth, max_px, marks=marks, crop=crop)
    )


def live_part(context: Context, rig: str, camera: str, crop: Crop) -> PartView | None:
    """Tell what a part of the newest picture of a camera says, None if there is none; never waits for a device."""
    picture = context.rigs.live(rig, camera)
    if picture is None:
        refuse_unknown(context, rig)
        return None
    facts = context.rigs.status(rig).facts
    known = facts.cameras.get(camera) if facts else None
    found = live_numbers(
        crop.of(picture.gray),
        picture.bit_depth,
        black_level_gray=known.black_level_gray if known else 0.0,
    )
    return PartView(
        number=picture.number,
        mean_gray=found.mean_gray,
        saturated_share=found.saturated_share,
        sharpness=found.sharpness,
    )


def live_jpeg(
    gray: Array,
    bit_depth: int,
    max_px: int = LIVE_PX,
    *,
    marks: bool = False,
    crop: Crop | None = None,
) -> bytes:
    """Encode a camera's picture for the live view: full scale is white."""
    part = crop.of(gray) if crop else gray
    if marks:
        return encoded(mark_extremes(part, bit_depth, max_px=max_px), None, "jpeg")
    return draw(part, max_px=max_px, low=0.0, high=float(2**bit_depth - 1), format="jpeg")


def _start(middle: int, size: int, whole: int) -> int:
    return min(max(middle - size // 2, 0), max(whole - size, 0))
