"""How noisy a camera's gray levels are, from its data sheet and its response."""

import numpy as np
from jaxtyping import Float, Float64

ROUNDING_VARIANCE = 1.0 / 12.0


def gray_noise(
    gray: Float[np.ndarray, "point"],
    *,
    full_scale_gray: float,
    full_well_e: float | None,
    read_noise_e: float = 0.0,
    log_light: Float[np.ndarray, "level"] | None = None,
) -> Float64[np.ndarray, "point"]:
    r"""Predict the standard deviation of one sample, rounding included.

    Parameters
    ----------
    gray
        Mean gray levels.
    full_scale_gray
        The largest gray level, at `full_well_e` electrons.
    full_well_e, read_noise_e
        From the camera's data; None: not known, then half a gray level is assumed.
    log_light
        Response g of every gray level; None: the camera is linear.

    Notes
    -----
    :math:`N = N_{full} e^{g(G) - g(G_{full})}`, :math:`\sigma_G^2 = (N + \sigma_{read}^2) / (N g'(G))^2 + 1/12`.

    Examples
    --------
    >>> float(gray_noise(np.array([255.0]), full_scale_gray=255.0, full_well_e=10000.0)[0].round(2))
    2.57
    """
    if full_well_e is None:
        return np.full(gray.shape, np.sqrt(0.25 + ROUNDING_VARIANCE))
    levels = np.arange(round(full_scale_gray) + 1, dtype=np.float64)
    if log_light is None:
        electrons = full_well_e * np.maximum(levels, 0.5) / full_scale_gray
        per_electron = np.full(levels.shape, full_scale_gray / full_well_e)
    else:
        electrons = full_well_e * np.exp(log_light - log_light[-1])
        slope = np.maximum(np.gradient(log_light), 1e-6)
        per_electron = np.minimum(
            1.0 / (electrons * slope), full_scale_gray / read_noise_floor(read_noise_e)
        )
    variance = (electrons + read_noise_e**2) * per_electron**2 + ROUNDING_VARIANCE
    return np.asarray(np.sqrt(np.interp(gray, levels, variance)), np.float64)


def read_noise_floor(read_noise_e: float) -> float:
    """Return the charge below which a gray level's slope isn't to be trusted."""
    return max(read_noise_e, 1.0)
