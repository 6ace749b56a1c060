"""Gray-level histograms of the lit foreground, pooled over cameras."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer, Shaped
from scipy.ndimage import gaussian_filter1d

from backend.numerics.errors import HistogramError


class DarkLevel(NamedTuple):
    """What a camera shows of a black field."""

    level_gray: float
    """Median gray level."""
    sigma_gray: float
    """Spread between pixels, at least that of rounding."""

    @property
    def limit_gray(self) -> float:
        """Gray level up to which a pixel is background."""
        return self.level_gray + 3.0 * self.sigma_gray


_ROUNDING_GRAY = 1.0 / np.sqrt(12.0)
"""Standard deviation of rounding to whole gray levels."""


def dark_level(black_gray: Shaped[np.ndarray, "h w"]) -> DarkLevel:
    """Measure the dark level of a picture of the black field.

    Parameters
    ----------
    black_gray
        Picture with the projector showing black, in [gray]; integer or float.

    Returns
    -------
    level_gray
        Median over the pixels in [gray].
    sigma_gray
        1.4826 times the median absolute deviation in [gray], never below the
        0.289 gray of rounding: hot pixels and a lit corner don't decide.

    Raises
    ------
    HistogramError
        If the picture has no pixel.

    Examples
    --------
    >>> dark_level(np.full((4, 4), 5, np.uint8)).level_gray
    5.0
    """
    if black_gray.size == 0:
        raise HistogramError("the black picture has no pixel; capture the black field again")
    level = float(np.median(black_gray))
    spread = 1.4826 * float(np.median(np.abs(black_gray.astype(np.float32) - level)))
    return DarkLevel(level, max(spread, _ROUNDING_GRAY))


def pooled_histogram(
    pictures_gray: Sequence[Integer[np.ndarray, "_h _w"]],
    background_gray: Sequence[float],
    *,
    full_scale_gray: int,
) -> Float[np.ndarray, "gray"]:
    """Count the foreground pixels of every gray level over all cameras.

    Parameters
    ----------
    pictures_gray
        One picture per camera of the white field, in [gray]; sizes may differ.
    background_gray
        Per camera the gray level up to which a pixel is background, in [gray];
        see `DarkLevel.limit_gray`. A negative level keeps every pixel.
    full_scale_gray
        Largest gray level of the cameras: 255 for 8 bit, 4095 for 12 bit.

    Returns
    -------
    Number of pixels per gray level 0..full scale, float64.

    Raises
    ------
    HistogramError
        If the numbers of pictures and levels differ, a picture exceeds full scale,
        or no pixel is foreground.

    Examples
    --------
    >>> counts = pooled_histogram([np.array([[3, 90, 90]])], [5.0], full_scale_gray=255)
    >>> counts[3], counts[90]
    (np.float64(0.0), np.float64(2.0))
    """
    if len(pictures_gray) != len(background_gray):
        raise HistogramError(
            f"{len(pictures_gray)} pictures came with {len(background_gray)} background levels;"
            " give one level per picture"
        )
    counts = np.zeros(full_scale_gray + 1)
    for picture, limit in zip(pictures_gray, background_gray, strict=True):
        counts += _counts(picture, limit, full_scale_gray)
    if not counts.any():
        raise HistogramError(
            f"no pixel is brighter than the background ({max(background_gray, default=0):.1f}"
            " gray); expose longer or point the projector at the part"
        )
    return counts


def _counts(
    picture_gray: Integer[np.ndarray, "_h _w"], limit_gray: float, full_scale_gray: int
) -> Float[np.ndarray, "gray"]:
    counts = np.bincount(picture_gray.ravel(), minlength=full_scale_gray + 1).astype(np.float64)
    if counts.size > full_scale_gray + 1:
        raise HistogramError(
            f"a picture holds gray {counts.size - 1}, above full scale {full_scale_gray};"
            " set the camera's bit depth"
        )
    first = int(np.floor(limit_gray)) + 1
    counts[: max(first, 0)] = 0.0
    return counts


def smoothed(
    counts: Float[np.ndarray, "gray"], *, sigma_gray: float = 3.5
) -> Float[np.ndarray, "gray"]:
    """Smooth a histogram with a Gaussian; mass is kept at both ends.

    Parameters
    ----------
    counts
        Pixels per gray level.
    sigma_gray
        Width of the Gaussian in [gray of an 8-bit camera], scaled with the length
        of the histogram, so that one setting suits every bit depth. 0 means none.

    Returns
    -------
    Smoothed counts per gray level, float64.
    """
    if sigma_gray <= 0:
        return counts.astype(np.float64)
    sigma_bins = sigma_gray * (counts.size - 1) / 255.0
    return np.asarray(gaussian_filter1d(counts.astype(np.float64), sigma_bins, mode="reflect"))


def foreground_range(counts: Float[np.ndarray, "gray"]) -> tuple[int, int]:
    """Return the first and the last gray level that any pixel has.

    Raises
    ------
    HistogramError
        If the histogram is empty or holds one gray level only.
    """
    levels = np.flatnonzero(counts)
    if levels.size == 0:
        raise HistogramError(
            "the histogram is empty; expose longer or point the projector at the part"
        )
    if levels.size == 1:
        raise HistogramError(
            f"every foreground pixel has the same gray level {levels[0]}; check that the picture"
            " isn't saturated or black and that the lens cap is off"
        )
    return int(levels[0]), int(levels[-1])
