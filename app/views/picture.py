"""Maps and captured frames as pictures. The browser fetches them from the API itself."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app import markup
from app.client import picture_address
from app.numbers import number
from app.palette import stops

Array = NDArray[Any]

_SAMPLES = 200_000
_PERCENT = (1.0, 99.0)
_FULL_PX = 4096


@dataclass(frozen=True)
class Range:
    """What the ends of the colours mean."""

    low: float
    high: float


@dataclass(frozen=True)
class Figure:
    """One picture on the screen: where it comes from and what it is called."""

    camera: str
    source: str
    """Address for an `<img>`."""
    full: str | None
    """Address of the picture in full size, if there is one."""
    width_px: int
    height_px: int
    artifact: str | None = None
    """The map behind it, for questions about pixels."""


def range_of(maps: Iterable[Array], low: float | None, high: float | None) -> Range:
    """Return the ends of the colours: as the hint says, else percentiles over all cameras together."""
    if low is not None and high is not None:
        return Range(low, high)
    samples = [_sample(m) for m in maps]
    pooled = np.concatenate(samples) if samples else np.zeros(1)
    if not pooled.size:
        pooled = np.zeros(1)
    lower, upper = np.percentile(pooled, _PERCENT)
    lower, upper = (
        low if low is not None else float(lower),
        high if high is not None else float(upper),
    )
    return Range(lower, upper if upper > lower else lower + 1.0)


def _sample(values: Array) -> Array:
    step = max(1, math.isqrt(max(1, values.size // _SAMPLES)))
    some = values[::step, ::step].astype(np.float64).ravel()
    return some[np.isfinite(some)]


def map_figure(
    camera: str, artifact: str, shape: tuple[int, ...], *, colormap: str, ends: Range, max_px: int
) -> Figure:
    """Describe a map drawn in colours."""
    lossless = colormap != "gray"

    def address(px: int) -> str:
        encoding = "png" if lossless else "jpeg"
        return picture_address(
            artifact, max_px=px, colormap=colormap, low=ends.low, high=ends.high, encoding=encoding
        )

    return Figure(camera, address(max_px), address(_FULL_PX), shape[1], shape[0], artifact)


def colour_bar(colormap: str, ends: Range, unit: str) -> str:
    """Return the colour bar of a map."""
    return markup.gradient_bar(stops(colormap), number(ends.low, 3), unit, number(ends.high, 3))


def figure_html(figure: Figure, links: str, *, wrap: Any = None) -> str:
    """Draw a picture with its camera's name; `links` is harmless HTML at the right of it.

    `wrap` makes the picture clickable: called with harmless HTML, it returns harmless HTML.
    """
    image = markup.tag(
        "img", "ug-picture", src=figure.source, alt=figure.camera,
        width=str(figure.width_px), height=str(figure.height_px), loading="eager", decoding="sync",
    )  # fmt: skip
    head = markup.div("ug-caption", markup.span("ug-name", markup.esc(figure.camera)) + links)
    return markup.div("ug-figure", head + (wrap(image) if wrap else image))
