"""Which exposure a live picture asks for, from its gray levels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_BRIGHTEST_SHARE = 1e-3
"""Of the pixels: so few may be brighter than what is aimed at, glints and hot pixels among them."""
_GOAL_BIN, _TOO_BRIGHT_BIN = 225, 250
"""Of 256 bins: where the brightest pixels are to be, and from where on they may be cut off."""
_DARK_BIN = 12
"""Below it a level is mostly black level and noise, and says little about the light."""
_SHORTER, _MUCH_SHORTER, _LONGER = 0.5, 0.2, 4.0
_MUCH_SATURATED_SHARE = 0.1


@dataclass(frozen=True)
class Advice:
    """The exposure to try next; the present one where nothing better is possible."""

    exposure_ms: float
    remark: str = ""
    """Why the scene stays too bright or too dark; empty: it doesn't."""


def advised(
    histograms: Sequence[Sequence[int]], exposure_ms: float, stops_ms: Sequence[float]
) -> Advice:
    """Return the stop at which the brightest camera's brightest pixels are just below saturation.

    Parameters
    ----------
    histograms
        Pixels in 256 bins from black to full scale, one per camera, all taken at this exposure.
    exposure_ms
        That exposure, in [ms].
    stops_ms
        Exposures that can be set, ascending, in [ms].

    Notes
    -----
    Gray levels grow with the exposure as long as nothing saturates. Where something does, or where there is hardly
    any light, a picture doesn't say how far: then it is a step into the right direction, and the next picture tells more.

    Examples
    --------
    >>> half_bright = [0] * 112 + [1000] + [0] * 143
    >>> advised([half_bright], 20.0, (10.0, 20.0, 30.0, 40.0)).exposure_ms
    40.0
    >>> saturated = [0] * 255 + [1000]
    >>> advised([saturated], 10.0, (10.0, 20.0)).remark
    'Too bright even at 10 ms: close the iris or dim the projector.'
    """
    counts = np.array(histograms, dtype=np.float64)
    top = max(map(_brightest_bin, counts))
    if top >= _TOO_BRIGHT_BIN:
        is_much = max(c[_TOO_BRIGHT_BIN:].sum() / c.sum() for c in counts) > _MUCH_SATURATED_SHARE
        factor = _MUCH_SHORTER if is_much else _SHORTER
    else:
        factor = _LONGER if top < _DARK_BIN else _GOAL_BIN / top
    wanted_ms = exposure_ms * factor
    below = [stop for stop in stops_ms if stop <= wanted_ms * (1 + 1e-6)]
    found_ms = below[-1] if below else stops_ms[0]
    if top >= _TOO_BRIGHT_BIN and exposure_ms <= stops_ms[0] * (1 + 1e-6):
        return Advice(
            exposure_ms,
            f"Too bright even at {stops_ms[0]:.4g} ms: close the iris or dim the projector.",
        )
    if top < _GOAL_BIN / 2 and exposure_ms >= stops_ms[-1] * (1 - 1e-6):
        return Advice(
            exposure_ms,
            f"Too dark even at {stops_ms[-1]:.4g} ms: open the iris or raise the gain.",
        )
    return Advice(found_ms)


def _brightest_bin(counts: np.ndarray[tuple[int], np.dtype[np.float64]]) -> int:
    """Return the bin that all but the brightest few pixels stay in or below; 0 for an empty histogram."""
    above = np.cumsum(counts[::-1])[::-1]
    return int(np.max(np.flatnonzero(above > _BRIGHTEST_SHARE * counts.sum()), initial=0))
