"""Blur, defocus and glare: what lenses do to the projected and to the captured picture."""

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

_PIXEL_VARIANCE = 1.0 / 12.0
"""Of a square projector pixel, in [px^2]; its light isn't a point's."""
_SAMPLING_VARIANCE = 1.0 / 6.0
"""What linear interpolation between pixels adds on average."""
_GLARE_STEP = 8
"""Glare is so wide that it is computed at an eighth of the resolution."""


def defocus_variance_px2(
    depth_mm: Float32[np.ndarray, "..."],
    *,
    focus_mm: float,
    aperture_mm: float,
    focal_px: float,
) -> Float32[np.ndarray, "..."]:
    """Return the variance that defocus adds to a projector pixel's image, in [projector px^2].

    Notes
    -----
    The blur disc has the diameter :math:`a f |1/z - 1/z_0|` in pixels, a uniform disc a sixteenth of its
    diameter squared as variance per axis.
    """
    diameter = aperture_mm * focal_px * np.abs(1.0 / depth_mm - 1.0 / focus_mm)
    return np.asarray(diameter**2 / 16.0, np.float32)


def projected(
    pattern: UInt8[np.ndarray, "h w"], light: Float32[np.ndarray, "256"], variance_px2: float
) -> Float32[np.ndarray, "h w"]:
    """Return the light of a pattern, blurred; sampled by linear interpolation its blur is as asked.

    Parameters
    ----------
    pattern
        Codes.
    light
        Light of each code.
    variance_px2
        Variance of the lens's point image, in [px^2]. The square pixel comes on top.
    """
    picture: Float32[np.ndarray, "h w"] = light[pattern]
    left = variance_px2 + _PIXEL_VARIANCE - _SAMPLING_VARIANCE
    return blurred(picture, float(np.sqrt(max(left, 0.0))), cv2.BORDER_CONSTANT)


def blurred(
    picture: Float32[np.ndarray, "h w"], sigma_px: float, border: int = cv2.BORDER_REFLECT
) -> Float32[np.ndarray, "h w"]:
    """Blur with a Gaussian out to four sigma; 0 returns the picture itself."""
    if sigma_px < 0.05:
        return picture
    kernel = _kernel(sigma_px)
    done: Float32[np.ndarray, "h w"] = cv2.sepFilter2D(
        picture, cv2.CV_32F, kernel, kernel, borderType=border
    )
    return done


def _kernel(sigma_px: float) -> Float[np.ndarray, "n 1"]:
    """Return weights of exactly the variance asked for: a narrow Gaussian sampled at pixels has less."""
    variance = sigma_px**2
    if variance < 0.4:
        return np.array([[variance / 2], [1 - variance], [variance / 2]])
    return np.asarray(cv2.getGaussianKernel(2 * round(4 * sigma_px) + 1, sigma_px))


def veil(rate: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return where light scattered in the lens arrives: half within 3 % of the width, half all over.

    The sum over the picture is that of the light itself, to about 1 %.
    """
    height, width = rate.shape
    small = cv2.resize(
        rate,
        (max(1, width // _GLARE_STEP), max(1, height // _GLARE_STEP)),
        interpolation=cv2.INTER_AREA,
    )
    near = blurred(small, 0.03 * small.shape[1])
    wide = blurred(small, 0.25 * small.shape[1])
    # Beyond the picture light is lost in the housing; the wide part is nearly its mean.
    full: Float32[np.ndarray, "h w"] = cv2.resize(
        0.5 * (near + wide), (width, height), interpolation=cv2.INTER_LINEAR
    )
    return full
