"""How long after its acknowledgement a display shows what it was asked to show."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

COMPLETE = 0.985
"""Share of the change from black to white at which it counts as over."""


@dataclass(frozen=True)
class Settling:
    """One direction of change, from black to white or back."""

    delays_ms: Float[np.ndarray, "delay"]
    """From the acknowledgement to the start of the exposure."""
    shares: Float[np.ndarray, "repetition camera delay"]
    """Of the change that an exposure saw: 0 nothing, 1 all."""

    @property
    def over_ms(self) -> float:
        """The shortest delay from which on every repetition and camera saw the whole change; NaN if none did."""
        return first_complete_ms(self.delays_ms, self.shares)


def share_of_change(
    gray: Float[np.ndarray, "h w"],
    before: Float[np.ndarray, "h w"],
    after: Float[np.ndarray, "h w"],
    lit: Bool[np.ndarray, "h w"],
) -> float:
    """Return how far a picture is on its way from one steady picture to another, over the pixels that change.

    The mean over pixels, not of their quotients: a pixel's weight is its light.
    """
    change = float((after[lit] - before[lit]).sum())
    return float((gray[lit] - before[lit]).sum()) / change


def changing_pixels(
    dark: Float[np.ndarray, "h w"], bright: Float[np.ndarray, "h w"], *, full_scale_gray: float
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that tell black from white: clearly lit, and not saturated."""
    gain = bright - dark
    return np.asarray(
        (gain > 0.25 * np.percentile(gain, 99.0)) & (gain > 3.0) & (bright < full_scale_gray - 1.0)
    )


def first_complete_ms(
    delays_ms: Float[np.ndarray, "delay"], shares: Float[np.ndarray, "repetition camera delay"]
) -> float:
    """Return the first delay from which on all shares are complete; NaN if the last ones aren't.

    Examples
    --------
    >>> shares = np.array([[[0.0, 0.99, 0.4, 1.0, 1.0]]])
    >>> first_complete_ms(np.array([0.0, 8.0, 17.0, 25.0, 33.0]), shares)
    25.0
    """
    complete = np.asarray((shares >= COMPLETE).all(axis=(0, 1)))
    late = np.flatnonzero(~complete)
    first = 0 if late.size == 0 else int(late[-1]) + 1
    return float(delays_ms[first]) if first < delays_ms.size else float("nan")
