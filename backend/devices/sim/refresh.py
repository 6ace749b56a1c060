"""How much light a projector gives while a camera exposes: gamma, contrast, bit planes.

A DLP chip knows on and off only. It shows the 8 bits of a gray level one after the other, each for a
time in proportion to its weight, once per frame period. An exposure of a whole number of periods sees
exactly the gray level; any other sees part of a period more, and which part depends on when it began.
"""

import numpy as np
from jaxtyping import Float, Float32

_BITS = 8
_ORDER = np.array([6, 7, 5, 7, 4, 3, 2, 1, 0])
"""Which bit is shown in each slot of the period; the longest in two halves, against flicker."""
_WEIGHTS = 2.0**_ORDER / (2**_BITS - 1) / np.where(_ORDER == 7, 2, 1)
"""Share of the period of each slot."""
_STARTS = np.concatenate([[0.0], np.cumsum(_WEIGHTS)[:-1]])
_TOLERANCE_MS = 1e-3
"""Exposures are set in whole us: a period of 1000/120 ms can't be met better."""


def mean_light(gamma: float, contrast_ratio: float) -> Float32[np.ndarray, "256"]:
    """Return the light of each code over whole periods: 1 for white, 1 / contrast for black."""
    linear = (np.arange(256) / 255.0) ** gamma
    black = 1.0 / contrast_ratio
    return np.asarray(black + (1.0 - black) * linear, np.float32)


def whole_periods(exposure_ms: float, period_ms: float | None) -> bool:
    """Tell whether an exposure is a multiple of the period, so that its start doesn't matter."""
    if period_ms is None:
        return True
    count = round(exposure_ms / period_ms)
    return count >= 1 and abs(exposure_ms - count * period_ms) <= _TOLERANCE_MS


def light_during(
    mean: Float32[np.ndarray, "256"], exposure_ms: float, period_ms: float, phase: float
) -> Float32[np.ndarray, "256"]:
    """Return the light of each code over one exposure, relative to white over whole periods.

    Parameters
    ----------
    mean
        Light of each code over whole periods.
    exposure_ms, period_ms
        Of the camera and of the projector, in [ms].
    phase
        Where in its period the projector is when the exposure begins, in [0, 1).

    Notes
    -----
    With a duty d of the code, an exposure of k + r periods deviates by up to r (1 - r) or so over
    (k + r) d: about 1 % at 100 ms and 1/120 s, and 80 % below one period.
    """
    level = np.rint(255.0 * mean).astype(np.int64)
    bits = (level[:, None] >> _ORDER) & 1
    periods = exposure_ms / period_ms
    on = _on_time(phase + periods) - _on_time(phase)
    seen = bits @ on
    share = level / (2**_BITS - 1) * periods
    ratio = np.divide(seen, share, out=np.ones(256), where=level > 0)
    return np.asarray(mean * ratio, np.float32)


def _on_time(until: float) -> Float[np.ndarray, "slot"]:
    """Return how long each slot has been open since time 0, in periods."""
    whole = np.floor(until)
    return np.asarray(whole * _WEIGHTS + np.clip(until - whole - _STARTS, 0, _WEIGHTS), np.float64)
