"""How much light each projector pixel may give: what every camera pixel can take, gathered where it looks."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from backend.numerics.response_fit import FULL_LIGHT

_LOG_EDGE = 0.35
"""Factors that differ by more than this (in their logarithm) are an edge of the scene, kept while smoothing."""


class Need(NamedTuple):
    """What a camera's pixels can take and what they need, as shares of full light."""

    most: Float32[np.ndarray, "h w"]
    """The largest factor at which the pixel stays below its target; 1 where even full light does. NaN: unknown."""
    least: Float32[np.ndarray, "h w"]
    """The smallest factor that still gives the pixel contrast."""


def light_need(
    gain: Float32[np.ndarray, "h w"],
    offset_gray: Float32[np.ndarray, "h w"],
    *,
    target_gray: float,
    contrast_gray: float,
    least_factor: float,
) -> Need:
    r"""Turn each pixel's response around: which light brings it to its target.

    Parameters
    ----------
    gain, offset_gray
        The pixel's line I = k P + b, P in 0..255; see `response_fit.fit_response`. NaN: the pixel is unknown.
    target_gray
        Brightest gray level wanted under white, in [gray].
    contrast_gray
        Contrast of white against black that is to be kept where possible, in [gray].
    least_factor
        No pixel asks for less than this share of full light.

    Notes
    -----
    :math:`P^* = (I_{target} - b) / k`, clipped [1]_; here divided by 255.

    References
    ----------
    .. [1] C. Zhang et al., "A Robust Surface Coding Method for Optically Challenging Objects Using Structured
       Light", IEEE T-ASE 11(3), 775 (2014), doi:10.1109/TASE.2013.2293576: equations 6 and 7.

    Examples
    --------
    >>> gain, offset = np.float32([[2.0, 0.5]]), np.float32([[4.0, 4.0]])
    >>> light_need(gain, offset, target_gray=234, contrast_gray=12, least_factor=0.01).most.round(3)
    array([[0.451, 1.   ]], dtype=float32)
    """
    full = gain * np.float32(FULL_LIGHT)
    with np.errstate(divide="ignore", invalid="ignore"):
        most = (np.float32(target_gray) - offset_gray) / full
        least = np.float32(contrast_gray) / full
    most = np.where(full > 0, most, np.where(np.isnan(full), np.float32(np.nan), np.float32(1)))
    least = np.where(full > 0, least, np.float32(1))
    low = np.float32(least_factor)
    return Need(
        np.asarray(np.clip(most, low, 1), np.float32),
        np.asarray(np.clip(least, low, 1), np.float32),
    )


def scatter(
    values: Float32[np.ndarray, "h w"],
    projector_px: Float32[np.ndarray, "h w"],
    projector_row_px: Float32[np.ndarray, "h w"],
    *,
    into: Float32[np.ndarray, "hp wp"],
    largest: bool = False,
) -> None:
    """Write each camera pixel's value to the projector pixel that it sees; of several the smallest stays.

    Parameters
    ----------
    values
        One value per camera pixel; NaN is left out.
    projector_px, projector_row_px
        Where the pixel looks in the projector, in [px], pixel centres at integers. NaN or outside: left out.
    into
        Projector map that is changed: its own values take part, so cameras can be gathered one after the other.
    largest
        Keep the largest instead.
    """
    height, width = into.shape
    with np.errstate(invalid="ignore"):
        u, v = (
            np.floor(projector_px + np.float32(0.5)),
            np.floor(projector_row_px + np.float32(0.5)),
        )
        use = (u >= 0) & (u < width) & (v >= 0) & (v < height) & ~np.isnan(values)
    place = v[use].astype(np.intp) * width + u[use].astype(np.intp)
    gather = np.maximum if largest else np.minimum
    gather.at(into.reshape(-1), place, values[use])


def light_at(
    factor: Float32[np.ndarray, "hp wp"],
    projector_px: Float32[np.ndarray, "h w"],
    projector_row_px: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Return the factor where each camera pixel looks, interpolated; NaN where that isn't known."""
    seen = cv2.remap(
        factor,
        np.ascontiguousarray(projector_px),
        np.ascontiguousarray(projector_row_px),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    known = ~(np.isnan(projector_px) | np.isnan(projector_row_px))
    return np.asarray(np.where(known, seen, np.float32(np.nan)), np.float32)


def widen_dark(factor: Float32[np.ndarray, "h w"], radius_px: float) -> Float32[np.ndarray, "h w"]:
    """Grow the dark regions by a radius: the smallest factor within a disc (grey erosion).

    Examples
    --------
    >>> widen_dark(np.float32([[1, 1, 0.2, 1, 1]]), 1.0)
    array([[1. , 0.2, 0.2, 0.2, 1. ]], dtype=float32)
    """
    reach = int(np.floor(radius_px))
    if reach < 1:
        return factor
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (x * x + y * y <= (radius_px + 0.25) ** 2).astype(np.uint8)
    return np.asarray(cv2.erode(factor, disc, borderType=cv2.BORDER_REPLICATE), np.float32)


def smooth(factor: Float32[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    r"""Smooth a mask, but not across edges of the scene.

    Notes
    -----
    A factor that changes by the share g per pixel moves an edge that is blurred with standard deviation
    :math:`\sigma` by about :math:`g \sigma^2`: roughness of the mask becomes noise of the surface. A bilateral
    filter of the logarithm smooths roughness; steps between parts stay where they are.
    """
    if sigma_px <= 0:
        return factor
    logarithm = np.log(np.maximum(factor, np.float32(1e-4)))
    smoothed = cv2.bilateralFilter(
        logarithm, 2 * int(np.ceil(2 * sigma_px)) + 1, _LOG_EDGE, sigma_px
    )
    return np.asarray(np.exp(smoothed), np.float32)


def evened(factor: Float32[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    """Smooth a mask's logarithm with a Gaussian of a standard deviation, steps as well."""
    logarithm = np.log(np.maximum(factor, np.float32(1e-4)))
    blurred = cv2.GaussianBlur(logarithm, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.exp(blurred), np.float32)
