"""Which pixels a mask serves badly: over-exposed, under-exposed, or at an unknown place."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Integer, UInt8

OVER_EXPOSED, UNDER_EXPOSED, UNKNOWN_PLACE = 1, 2, 3

LABELS: Mapping[int, str] = MappingProxyType(
    {
        OVER_EXPOSED: "over-exposed: saturated under the white field",
        UNDER_EXPOSED: "under-exposed: too little contrast of bright and dark stripes",
        UNKNOWN_PLACE: "bright enough, but its place in the projector isn't known",
    }
)
_STRONG = 0.1
"""Pixels that can take less than this share of full light are bright ones."""


class Shares(NamedTuple):
    """Shares of the lit pixels; the last three are of the pixels of each brightness."""

    over_exposed: float
    under_exposed: float
    dark: float
    middle: float
    bright: float


def judge_pixels(
    white: Integer[np.ndarray, "h w"],
    contrast_gray: Float32[np.ndarray, "h w"],
    lit: Bool[np.ndarray, "h w"],
    placed: Bool[np.ndarray, "h w"] | None = None,
    *,
    saturation_gray: float,
    min_contrast_gray: float,
) -> UInt8[np.ndarray, "h w"]:
    """Label every lit pixel under a mask; 0: it will do.

    Parameters
    ----------
    white
        Picture of the white field under the mask: nothing that is shown can be brighter.
    contrast_gray
        Difference between bright and dark stripes under the mask, in [gray].
    lit
        Pixels that count.
    placed
        Pixels whose place in the projector is known; None: that isn't judged.
    saturation_gray
        A pixel is over-exposed from here on, in [gray].
    min_contrast_gray
        A pixel is under-exposed up to here, in [gray].

    Examples
    --------
    >>> white, contrast = np.uint8([[255, 200, 9]]), np.float32([[99, 99, 1]])
    >>> judge_pixels(white, contrast, contrast > 0, saturation_gray=254, min_contrast_gray=4)
    array([[1, 0, 2]], dtype=uint8)
    """
    labels = np.zeros(white.shape, np.uint8)
    if placed is not None:
        labels[~placed] = UNKNOWN_PLACE
    labels[contrast_gray <= min_contrast_gray] = UNDER_EXPOSED
    labels[white >= saturation_gray] = OVER_EXPOSED
    labels[~lit] = 0
    return labels


def count_shares(
    labels: Mapping[str, UInt8[np.ndarray, "_h _w"]],
    lit: Mapping[str, Bool[np.ndarray, "_h _w"]],
    most: Mapping[str, Float32[np.ndarray, "_h _w"]],
) -> Shares:
    """Count the unqualified pixels of all cameras.

    Parameters
    ----------
    labels
        Of `judge_pixels`, per camera.
    lit
        Pixels that count.
    most
        Share of full light that each pixel can take: 1 is dark, less than 0.1 bright, between them middle.
    """
    label, share = (np.concatenate([m[n][lit[n]] for n in labels]) for m in (labels, most))
    bad = (label == OVER_EXPOSED) | (label == UNDER_EXPOSED)
    return Shares(
        _mean(label == OVER_EXPOSED),
        _mean(label == UNDER_EXPOSED),
        _mean(bad[share >= 1]),
        _mean(bad[(share < 1) & (share >= _STRONG)]),
        _mean(bad[~(share >= _STRONG)]),
    )


def _mean(values: Bool[np.ndarray, "n"]) -> float:
    return float(values.mean()) if values.size else 0.0
