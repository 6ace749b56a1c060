"""Light a few epipolar lines at a time, where pixels may look that get light from other places, too."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32

from backend.numerics.camera_model import project, rays
from backend.numerics.code_certainty import PairGeometry

_MOST_PIXELS = 8000
_STEP_PX = 1.5
_PULL_PX = 1.2
"""How far light from elsewhere pulls an edge per share of the light: the largest value of the filter that finds the
edge, z exp(-z^2 / 2) = 0.61 with z in units of 2 px."""


def possible_places(
    pixels: Bool[np.ndarray, "h w"],
    geometry: PairGeometry,
    *,
    near_mm: float,
    far_mm: float,
) -> Bool[np.ndarray, "hp wp"]:
    """Mark the projector pixels that some camera pixels may look at: their epipolar lines between two depths.

    Parameters
    ----------
    pixels
        The camera pixels asked about. Of very many, evenly spread ones stand for the others.
    geometry
        Camera and projector.
    near_mm, far_mm
        Depths between which surfaces are expected, along the camera's axis, in [mm].
    """
    projector = geometry.projector
    places = np.zeros((projector.height_px, projector.width_px), np.uint8)
    y, x = np.nonzero(pixels)
    if not y.size:
        return places > 0
    step = max(1, y.size // _MOST_PIXELS)
    slopes = rays(np.column_stack([x, y])[::step].astype(np.float64), geometry.camera)
    along = np.column_stack([slopes, np.ones(len(slopes))])
    pose = geometry.projector_from_camera
    ends = [project(along * depth, projector, pose) for depth in (near_mm, far_mm)]
    length_px = float(np.nanmax(np.hypot(*(ends[1] - ends[0]).T)))
    # Even steps in 1/z are even steps along the line.
    for inverse_depth in np.linspace(1 / near_mm, 1 / far_mm, 2 + int(length_px / _STEP_PX)):
        at = project(along / inverse_depth, projector, pose)
        at = np.round(at[np.isfinite(at).all(axis=1)]).astype(np.int64)
        inside = (at >= 0).all(axis=1) & (at[:, 0] < projector.width_px)
        at = at[inside & (at[:, 1] < projector.height_px)]
        places[at[:, 1], at[:, 0]] = 1
    return np.asarray(cv2.dilate(places, np.ones((5, 5), np.uint8)) > 0)


class Looks(NamedTuple):
    """Epipolar lines in narrow bands, every so many of which are lit in one look."""

    width_px: float
    """Of a band."""
    number: int
    """Looks: each lights one band of that many."""

    def own(self, lines_px: Float32[np.ndarray, "*shape"]) -> Int32[np.ndarray, "*shape"]:
        """Return the look in which each line is in the middle of what is lit.

        Examples
        --------
        >>> Looks(10.0, 3).own(np.float32([0, 9, 10, 35])).tolist()
        [0, 0, 1, 0]
        """
        band = np.floor(np.nan_to_num(lines_px) / np.float32(self.width_px))
        return np.asarray(band.astype(np.int32) % self.number, np.int32)

    def lit(
        self, lines_px: Float32[np.ndarray, "*shape"], look: int, margin_px: float
    ) -> Bool[np.ndarray, "*shape"]:
        """Tell which lines a look lights: its bands and a margin on either side, where blur would dim them."""
        places = (lines_px, lines_px - np.float32(margin_px), lines_px + np.float32(margin_px))
        return np.asarray(np.logical_or.reduce([self.own(p) == look for p in places]))


def second_light(
    white: Float32[np.ndarray, "h w"],
    alone: Float32[np.ndarray, "h w"],
    black: Float32[np.ndarray, "h w"],
    *,
    noise_gray: float,
) -> Float32[np.ndarray, "h w"]:
    """Return the share of a pixel's light that comes from other epipolar lines than its own.

    Parameters
    ----------
    white, alone, black
        Gray levels under the white field, under its own lines alone, and under the black field, in [gray].
    noise_gray
        Differences up to this are none, in [gray].

    Examples
    --------
    >>> gray = [np.float32([[value]]) for value in (104, 54, 4)]
    >>> second_light(*gray, noise_gray=3).item()
    0.5
    """
    light = white - black
    other = np.where(white - alone > np.float32(noise_gray), white - alone, np.float32(0))
    return np.asarray(other / np.maximum(light, np.float32(noise_gray)), np.float32)


def pulled_sigma(
    sigma_px: Float32[np.ndarray, "h w"],
    share: Float32[np.ndarray, "h w"],
    marked: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    r"""Return how well a column is known where part of the light comes from elsewhere.

    Parameters
    ----------
    sigma_px
        Standard deviation by noise, in projector [px].
    share
        Of the light that comes from elsewhere, see `second_light`; NaN: not known, taken for none.
    marked
        Pixels whose share is more than the glare of lenses and the blur of the bands make up: those pull no edges.

    Notes
    -----
    Light at a distance d pulls the edge by up to :math:`share \cdot d \, e^{-d^2 / (2 \tau^2)}`,
    :math:`\tau` = 2 px being the width of the filter that finds it (`line_shift`): 1.2 px per share at most.

    Examples
    --------
    >>> share = np.float32([[0.02, 0.5]])
    >>> pulled_sigma(np.full_like(share, 0.03), share, share > 0.06).round(2)
    array([[0.03, 0.6 ]], dtype=float32)
    """
    pull_px = np.float32(_PULL_PX) * np.where(marked, np.nan_to_num(share), np.float32(0))
    return np.asarray(np.hypot(sigma_px, pull_px), np.float32)
