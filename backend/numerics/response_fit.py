"""What each pixel makes of projected light: a straight line through its unsaturated samples."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Integer, UInt8

from backend.numerics.errors import FrameError

FULL_LIGHT = 255.0
"""Light of the white field, in the unit of projected light used here: code 255 of a linear projector."""


class ResponseFit(NamedTuple):
    """The line I = k P + b of every pixel, with P the projected light in 0..255."""

    gain: Float32[np.ndarray, "h w"]
    """k, in [gray] per unit of light; NaN where fewer than two samples are known."""
    offset_gray: Float32[np.ndarray, "h w"]
    """b, in [gray]; NaN where `gain` is."""
    residual_gray: Float32[np.ndarray, "h w"]
    """Root mean square of the samples used about the line, in [gray]; 0 with two samples."""
    samples: UInt8[np.ndarray, "h w"]
    """Unsaturated samples of the pixel."""


def light_of_code(
    code_gray: Float[np.ndarray, "n"] | Sequence[float], gamma: float
) -> Float64[np.ndarray, "n"]:
    """Return the light of projected codes, in 0..255: 255 (code / 255)**gamma.

    Examples
    --------
    >>> light_of_code([0, 51, 255], 2.0)
    array([  0. ,  10.2, 255. ])
    """
    return FULL_LIGHT * (np.asarray(code_gray, np.float64) / FULL_LIGHT) ** gamma


def fit_response(
    frames: Sequence[Integer[np.ndarray, "h w"]],
    light: Float64[np.ndarray, "n"],
    *,
    saturation_gray: float,
) -> ResponseFit:
    r"""Fit a line to every pixel's gray levels under uniform fields, saturated samples left out.

    Parameters
    ----------
    frames
        Pictures of uniform fields, in the order of `light`.
    light
        Light of each field, in 0..255.
    saturation_gray
        A sample is saturated from this gray level on, in [gray].

    Raises
    ------
    FrameError
        If there are fewer than two fields of different light, or numbers or sizes differ.

    Notes
    -----
    Least squares of :math:`I = k P + b` over the samples below saturation [1]_. Sums are kept in float32 about
    the light's mean: exact enough for gray levels of 16 bit. Cost: a few passes over each frame.

    References
    ----------
    .. [1] C. Zhang et al., "A Robust Surface Coding Method for Optically Challenging Objects Using Structured
       Light", IEEE T-ASE 11(3), 775 (2014), doi:10.1109/TASE.2013.2293576: equations 8 and 9.

    Examples
    --------
    >>> frames = [np.full((1, 1), gray, np.uint8) for gray in (10, 110, 255)]
    >>> fit = fit_response(frames, np.array([0.0, 50.0, 150.0]), saturation_gray=255)
    >>> fit.gain.item(), fit.offset_gray.item(), fit.samples.item()
    (2.0, 10.0, 2)
    """
    if len(frames) != light.size or np.unique(light).size < 2:
        raise FrameError(
            f"{len(frames)} fields of {np.unique(light).size} different brightnesses don't determine a "
            "response: give at least two, each with its light"
        )
    shape = frames[0].shape
    if any(frame.shape != shape for frame in frames):
        raise FrameError(
            f"fields of sizes {sorted({f.shape for f in frames})} don't belong to one camera: give one size"
        )
    sums = _Sums.zeros(shape)
    for frame, value in zip(frames, light, strict=True):
        sums.add(frame, float(value), frame < saturation_gray)
    return sums.line()


class _Sums(NamedTuple):
    """Sums over the samples of each pixel."""

    n: Float32[np.ndarray, "h w"]
    x: Float32[np.ndarray, "h w"]
    y: Float32[np.ndarray, "h w"]
    xx: Float32[np.ndarray, "h w"]
    xy: Float32[np.ndarray, "h w"]
    yy: Float32[np.ndarray, "h w"]

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> "_Sums":
        return cls(*(np.zeros(shape, np.float32) for _ in range(6)))

    def add(
        self, frame: Integer[np.ndarray, "h w"], light: float, usable: Bool[np.ndarray, "h w"]
    ) -> None:
        weight = usable.astype(np.float32)
        gray = frame * weight
        x = np.float32(light)
        self.n[...] += weight
        self.x[...] += x * weight
        self.y[...] += gray
        self.xx[...] += x * x * weight
        self.xy[...] += x * gray
        self.yy[...] += gray * gray

    def line(self) -> ResponseFit:
        with np.errstate(divide="ignore", invalid="ignore"):
            mean_x, mean_y = self.x / self.n, self.y / self.n
            var_x = self.xx / self.n - mean_x * mean_x
            cov = self.xy / self.n - mean_x * mean_y
            gain = np.where(var_x > np.float32(1e-6), cov / var_x, np.float32(np.nan))
            offset = mean_y - gain * mean_x
            left = self.yy / self.n - mean_y * mean_y - gain * cov
        known = np.isfinite(gain)
        residual = np.where(known, np.sqrt(np.maximum(left, 0)), np.float32(np.nan))
        return ResponseFit(
            np.asarray(gain, np.float32),
            np.asarray(np.where(known, offset, np.float32(np.nan)), np.float32),
            np.asarray(np.where(self.n > 2, residual, 0 * residual), np.float32),
            self.n.astype(np.uint8),
        )
