"""A screen and its camera as one curve: the gray level of every control value, and back."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from backend.numerics.errors import ResponseError

LEAST_POINTS = 5
"""A ramp with fewer gray levels that differ tells nothing of its shape."""

LEAST_STEP_GRAY = 0.3
"""Smaller steps between neighbours are rounding and noise: their slope isn't known."""


class MonotoneRamp(NamedTuple):
    """The part of a ramp in which the gray level grows with the control value."""

    control: Float64[np.ndarray, "point"]
    """Increasing."""
    gray: Float64[np.ndarray, "point"]
    """Increasing."""

    @property
    def gray_low(self) -> float:
        """The darkest gray level that tells its control value."""
        return float(self.gray[0])

    @property
    def gray_high(self) -> float:
        """The brightest one."""
        return float(self.gray[-1])


def monotone_ramp(
    control: Float[np.ndarray, "point"],
    gray: Float[np.ndarray, "point"],
    *,
    full_scale_gray: float = 255.0,
    tolerance_gray: float = 1.0,
) -> MonotoneRamp:
    """Take the strictly increasing part of a measured ramp.

    Parameters
    ----------
    control
        Control values in [-1, 1], increasing.
    gray
        Mean gray level at each.
    full_scale_gray
        The largest gray level; what is clipped there is left out.
    tolerance_gray
        The gray level may fall by this much where control rises: noise.

    Raises
    ------
    ResponseError
        If the ramp isn't finite, not in order, falls, or has fewer than five gray levels that differ.
    """
    _check_order(control, gray)
    fall = np.maximum.accumulate(gray) - gray
    if fall.max() > tolerance_gray * full_scale_gray / 255.0:
        worst = int(np.argmax(fall))
        raise ResponseError(
            f"the ramp isn't monotone: at control value {control[worst]:.2f} it has fallen by {fall[worst]:.1f} gray: "
            f"measure it again without other light, on a screen without dynamic contrast"
        )
    rising = np.maximum.accumulate(gray)
    kept = _rising_points(rising, LEAST_STEP_GRAY * full_scale_gray / 255.0)
    kept = kept[rising[kept] < full_scale_gray - 0.2]
    if kept.size < LEAST_POINTS:
        raise ResponseError(
            f"the ramp has {kept.size} gray levels that differ between {gray.min():.0f} and {gray.max():.0f}, "
            f"at least {LEAST_POINTS} are needed: measure 17 or 33 levels at an exposure that isn't clipped"
        )
    return MonotoneRamp(np.asarray(control, np.float64)[kept], rising[kept].astype(np.float64))


def _check_order(control: Float[np.ndarray, "point"], gray: Float[np.ndarray, "point"]) -> None:
    if not (np.isfinite(control).all() and np.isfinite(gray).all()):
        raise ResponseError("the ramp has values that aren't finite: measure it again")
    if len(control) < 2 or (np.diff(control) <= 0).any():
        raise ResponseError(
            f"the ramp's {len(control)} control values aren't increasing: sort them and leave out doubles"
        )


def _rising_points(gray: Float[np.ndarray, "point"], step_gray: float) -> np.ndarray:
    """Return indices of points, each at least a step above the one before; of a flat start the last point."""
    start = int(np.searchsorted(gray, gray[0] + step_gray)) - 1
    kept = [max(start, 0)]
    for i in range(kept[0] + 1, len(gray)):
        if gray[i] - gray[kept[-1]] >= step_gray:
            kept.append(i)
    return np.asarray(kept)


def control_of_gray(ramp: MonotoneRamp, levels: int) -> Float64[np.ndarray, "level"]:
    """Invert a ramp: the control value of every gray level, NaN outside the ramp.

    Monotone cubic (PCHIP) through the measured points: it doesn't overshoot, so the inverse is one-to-one.
    """
    # scipy.interpolate costs 0.4 s to import: only screens pay.
    from scipy.interpolate import PchipInterpolator

    inverse = PchipInterpolator(ramp.gray, ramp.control, extrapolate=False)
    return np.asarray(inverse(np.arange(levels, dtype=np.float64)), np.float64)


def gray_of_control(
    control: Float[np.ndarray, "point"],
    gray: Float[np.ndarray, "point"],
    wanted: Float[np.ndarray, "*shape"],
) -> Float64[np.ndarray, "*shape"]:
    """Look control values up in a measured ramp, clipped ends included; beyond its ends stays what they have."""
    from scipy.interpolate import PchipInterpolator

    forward = PchipInterpolator(control, np.maximum.accumulate(gray))
    return np.asarray(forward(np.clip(wanted, control[0], control[-1])), np.float64)
