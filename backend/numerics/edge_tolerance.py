"""How far an edge may be extrapolated over a saturated gap before noise moves it by a pixel (the paper's figure 13)."""

import numpy as np
from jaxtyping import Float

from backend.numerics.edges import extrapolated_edge

FULL_SCALE_GRAY = 255.0
MIDDLE_GRAY = 128.0


def extrapolation_errors(
    gaps_px: Float[np.ndarray, "gap"],
    noise_share: float,
    *,
    draws: int = 20_000,
    seed: int = 0,
) -> Float[np.ndarray, "gap draw"]:
    r"""Draw errors of `extrapolated_edge` for gaps of different widths by Monte Carlo.

    Parameters
    ----------
    gaps_px
        Distance between the two inner, saturated samples in [px].
    noise_share
        Half width p of the uniform noise of the outer samples, as a share of full scale.
    draws
        Random edges per gap.
    seed
        Of the noise: the same seed gives the same errors.

    Returns
    -------
    Signed errors in [px]: the place found minus the middle of the gap, where the edge is.

    Notes
    -----
    The inner samples read 255, the outer ones, 1 px beside them, :math:`128 + 255 p \, U(-1, 1)` (equations
    13-15, lost in the text at hand; this reading gives the paper's figures). To first order the error is
    :math:`g (m_2 - m_1) / (2 (m_1 + m_2))` with the slopes m of both lines, so its standard deviation is

    .. math:: \sigma = \frac{255 \, p \, g}{2 \cdot 127 \sqrt 6}
    """
    rng = np.random.default_rng(seed)
    shape = (gaps_px.size, draws)
    rising, fallen = (
        MIDDLE_GRAY + FULL_SCALE_GRAY * noise_share * rng.uniform(-1, 1, shape) for _ in range(2)
    )
    gap = np.broadcast_to(gaps_px[:, np.newaxis], shape)
    top = np.full(shape, FULL_SCALE_GRAY)
    found = extrapolated_edge(np.full(shape, -1.0), rising, top, gap, top, fallen)
    return np.asarray(found - gap / 2)


def predicted_error_px(
    gaps_px: Float[np.ndarray, "gap"], noise_share: float
) -> Float[np.ndarray, "gap"]:
    """Predict the standard deviation of `extrapolation_errors` to first order, in [px].

    Examples
    --------
    >>> predicted_error_px(np.array([20.0]), 0.1).round(2)
    array([0.82])
    """
    slope = FULL_SCALE_GRAY - MIDDLE_GRAY
    return np.asarray(FULL_SCALE_GRAY * noise_share * gaps_px / (2 * slope * np.sqrt(6)))


def covered_gap_px(
    gaps_px: Float[np.ndarray, "gap"], errors_px: Float[np.ndarray, "gap"], limit_px: float = 1.0
) -> float:
    """Return the widest gap whose error stays within a limit, interpolated; the last gap if all do.

    Examples
    --------
    >>> covered_gap_px(np.array([0.0, 10.0, 20.0]), np.array([0.0, 0.5, 1.5]))
    15.0
    """
    beyond = np.flatnonzero(errors_px > limit_px)
    if beyond.size == 0:
        return float(gaps_px[-1])
    first = int(beyond[0])
    if first == 0:
        return float(gaps_px[0])
    between = slice(first - 1, first + 1)
    return float(np.interp(limit_px, errors_px[between], gaps_px[between]))
