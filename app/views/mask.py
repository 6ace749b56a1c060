"""Maps of labels or of reason bits: flat colours over the picture, and a legend with shares."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from app.palette import label_colour, rgb

Array = NDArray[Any]

_OVER_PICTURE = {False: 0.62, True: 0.95}
"""Share of the label's colour where a picture lies below it; reasons are rare and have to be seen."""
_DIMMED = 0.55
"""Brightness of the picture where no label is."""
_FLAT = 46
"""Gray behind the labels where there is no picture."""


@dataclass(frozen=True)
class Labels:
    """Which labels (or bits) a map has, with their texts."""

    texts: Mapping[int, str]
    bits: bool = False

    @classmethod
    def of(cls, hint: Mapping[str, Any]) -> "Labels":
        """Read them from a hint, whose keys JSON made into texts."""
        return cls(
            {int(k): str(v) for k, v in (hint.get("labels") or {}).items()}, bool(hint.get("bits"))
        )

    def present(self, *maps: Array) -> list[int]:
        """Return the labels in these maps and those that have a text, without 0."""
        found = set(self.texts)
        for each in maps:
            found |= set(_bits_in(each) if self.bits else np.unique(each).astype(int).tolist())
        return sorted(label for label in found if label > 0)

    def text(self, label: int) -> str:
        """Return what a label is called."""
        return self.texts.get(label, f"bit {label}" if self.bits else str(label))

    def colour(self, label: int) -> str:
        """Return a label's colour; bits 1, 2, 4 ... are the labels 1, 2, 3 ..."""
        return label_colour(label.bit_length() if self.bits else label)

    def reasons(self, value: int) -> list[str]:
        """Return the texts of all that one pixel's value says."""
        if not self.bits:
            return [self.text(value)] if value in self.texts or value > 0 else []
        return [self.text(1 << i) for i in range(value.bit_length()) if value >> i & 1]


def share(labels: Labels, label: int, *maps: Array) -> float:
    """Return the share of the pixels that carry a label (or a bit)."""
    pixels = sum(m.size for m in maps)
    hits = sum(int(np.count_nonzero(_carries(labels, label, m))) for m in maps)
    return hits / pixels if pixels else 0.0


def draw(labels: Labels, values: Array, picture: Array | None = None) -> Array:
    """Return RGB: labels in their colours over a dimmed gray picture of any size; with several bits the lowest counts."""
    height, width = values.shape
    if picture is None:
        ground = np.full((height, width), _FLAT, np.float32)
    else:
        ground = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(
            np.float32
        )
    canvas = np.repeat((ground * _DIMMED)[..., None], 3, axis=2)
    mix = 1.0 if picture is None else _OVER_PICTURE[labels.bits]
    for label in reversed(labels.present(values)):
        here = _carries(labels, label, values)
        colour = np.array(rgb(labels.colour(label)), np.float32)
        canvas[here] = mix * colour + (1.0 - mix) * ground[here, None]
    return np.clip(canvas, 0, 255).astype(np.uint8)


def shrunk(labels: Labels, values: Array, max_px: int) -> Array:
    """Return a map with no side longer than `max_px`: labels stay labels, and no rare bit gets lost."""
    step = max(1, -(-max(values.shape) // max_px))
    if step == 1 or not labels.bits:
        return values[::step, ::step]
    height, width = (side - side % step for side in values.shape)
    blocks = values[:height, :width].reshape(height // step, step, width // step, step)
    return np.asarray(np.bitwise_or.reduce(np.bitwise_or.reduce(blocks, axis=3), axis=1))


def crisp(picture_rgb: Array, width_px: int) -> Array:
    """Repeat the pixels of a small picture, so that each stays a square when it is drawn large."""
    times = max(1, width_px // picture_rgb.shape[1])
    return picture_rgb.repeat(times, axis=0).repeat(times, axis=1)


def as_data_url(picture_rgb: Array) -> str:
    """Return a picture as an address that contains it."""
    encoded = cv2.imencode(".png", cv2.cvtColor(picture_rgb, cv2.COLOR_RGB2BGR))[1]
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def _carries(labels: Labels, label: int, values: Array) -> Array:
    if labels.bits:
        return np.asarray((values.astype(np.int64) & label) != 0)
    return np.asarray(values == label)


def _bits_in(values: Array) -> list[int]:
    together = int(np.bitwise_or.reduce(values.astype(np.int64), axis=None)) if values.size else 0
    return [1 << i for i in range(together.bit_length()) if together >> i & 1]
