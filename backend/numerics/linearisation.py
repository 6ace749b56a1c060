"""Quantities that answer to the control value along a straight line, and how far from it they are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from backend.numerics.camera_response import ResponseProblem
from backend.numerics.errors import ResponseError
from backend.numerics.screen_ramp import MonotoneRamp, control_of_gray

CONTROL_POINTS = 65
"""Equidistant control values at which straightness is judged."""


class Interval(NamedTuple):
    """Gray levels between which fringes lie, and the control values that make them."""

    gray_low: int
    gray_high: int
    control_low: float
    control_high: float


class Optimised(NamedTuple):
    """The response of equations 10 to 13 on one interval."""

    values: Float64[np.ndarray, "level"]
    quoted_error_percent: float
    """Largest over the interval."""
    monotone: bool
    """True if the values grow with the gray level over the whole interval."""


def interval_of(control: Float[np.ndarray, "level"], gray_low: int, gray_high: int) -> Interval:
    """Look the ends of an interval up in an inverted ramp.

    Raises
    ------
    ResponseError
        If the ends are in the wrong order, or the ramp doesn't reach them.
    """
    known = np.flatnonzero(np.isfinite(control))
    if not 0 <= gray_low < gray_high < len(control):
        raise ResponseError(
            f"an interval from gray {gray_low} to {gray_high} is empty: give two gray levels, the lower one first"
        )
    if gray_low < known[0] or gray_high > known[-1]:
        raise ResponseError(
            f"the interval {gray_low} to {gray_high} gray isn't within the ramp, which tells control values "
            f"from gray {known[0]} to {known[-1]} only: choose it there"
        )
    return Interval(gray_low, gray_high, float(control[gray_low]), float(control[gray_high]))


def quoted_error(
    values: Float[np.ndarray, "point"], control: Float[np.ndarray, "point"]
) -> Float64[np.ndarray, "point"]:
    r"""Return the quoted error in percent.

    Notes
    -----
    :math:`\mu_i = (v_i - l_i) / (\max l - \min l) \cdot 100\,\%` (equation 13, the other way round), l being
    the least-squares straight line of the values over the control values.

    Examples
    --------
    >>> quoted_error(np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 1.0])).round(1).tolist()
    [nan, nan, nan]
    >>> abs(quoted_error(np.array([0.0, 1.5, 2.0]), np.array([-1.0, 0.0, 1.0])).round(2)).tolist()
    [8.33, 16.67, 8.33]
    """
    line = straight_line(values, control)
    span = float(np.ptp(line))
    if span < 1e-12:
        return np.full(len(values), np.nan)
    return np.asarray((values - line) / span * 100.0, np.float64)


def straight_line(
    values: Float[np.ndarray, "point"], control: Float[np.ndarray, "point"]
) -> Float64[np.ndarray, "point"]:
    """Return the least-squares straight line of values over control values, at these."""
    centred = control - control.mean()
    slope = float(centred @ values) / float(centred @ centred)
    return np.asarray(values.mean() + slope * centred, np.float64)


def at_equal_controls(
    values: Float[np.ndarray, "level"], control: Float[np.ndarray, "level"], interval: Interval
) -> tuple[Float64[np.ndarray, "point"], Float64[np.ndarray, "point"]]:
    """Return equidistant control values over an interval, and the values of gray levels at them."""
    inside = slice(interval.gray_low, interval.gray_high + 1)
    wanted = np.linspace(interval.control_low, interval.control_high, CONTROL_POINTS)
    return wanted, np.interp(wanted, control[inside], values[inside])


def optimised_response(
    problem: ResponseProblem,
    first: Float[np.ndarray, "level"],
    control: Float[np.ndarray, "level"],
    interval: Interval,
) -> Optimised:
    r"""Solve equations 10 to 12 once, on one interval.

    Parameters
    ----------
    problem
        The stack's samples. Those within 10 gray of black should be left out of it: half a gray
        of rounding is 5 % of their light.
    first
        g_1, the solution of equation 9 from the same samples.
    control
        Control value of every gray level, NaN outside the ramp.
    interval
        Within the ramp.

    Notes
    -----
    :math:`\epsilon(G) = g_1(G) - g_o(Y(G))` is g_1's distance from its straight line in Y over the interval,
    :math:`w(G) = 1 / (1 + |\epsilon|)` inside and 0 outside (the paper prints "and" for "or"). The minimum is
    near :math:`g = g_1 - \epsilon = g_o(Y(G))`: a polynomial that imitates the inverted ramp, pinned to the
    stack. One pass: repeating it with only the latest :math:`\epsilon`, the distance *left*, diverges.
    """
    inside = slice(interval.gray_low, interval.gray_high + 1)
    wanted, sampled = at_equal_controls(first, control, interval)
    line = straight_line(sampled, wanted)
    offset, weight = np.zeros(len(first)), np.zeros(len(first))
    offset[inside] = first[inside] - np.interp(control[inside], wanted, line)
    weight[inside] = 1.0 / (1.0 + np.abs(offset[inside]))
    values = problem.solve(weight, offset)
    error = quoted_error(np.interp(wanted, control[inside], values[inside]), wanted)
    monotone = bool((np.diff(values[inside]) > 0).all())
    return Optimised(values, float(np.abs(error).max()), monotone)


def inverse_table(ramp: MonotoneRamp, levels: int) -> Float64[np.ndarray, "level"]:
    """Return the control value of every gray level; beyond the ramp its end's slope goes on.

    Noise carries samples beyond the ends of the fringes' range: cutting them off there would bend the sinusoid.
    """
    return continued(control_of_gray(ramp, levels))


def continued(values: Float[np.ndarray, "level"]) -> Float64[np.ndarray, "level"]:
    """Continue a table of values along the mean slope of its outermost gray levels."""
    known = np.flatnonzero(np.isfinite(values))
    first, last = int(known[0]), int(known[-1])
    reach = max(1, min(5 * len(values) // 256, last - first))
    levels = np.arange(len(values))
    lower = (values[first + reach] - values[first]) / reach
    upper = (values[last] - values[last - reach]) / reach
    result = np.array(values, np.float64)
    result[:first] = values[first] + lower * (levels[:first] - first)
    result[last + 1 :] = values[last] + upper * (levels[last + 1 :] - last)
    return result


def predistortion(
    ramp: MonotoneRamp, interval: Interval, levels: int, count: int = 256
) -> Float64[np.ndarray, "control"]:
    """Return the display codes that make the gray level a straight line in the control value.

    Equidistant control values from -1 to 1 become codes in [0, 255] (not rounded), the ends those of the interval.
    """
    wanted = np.linspace(interval.gray_low, interval.gray_high, count)
    control = control_of_gray(ramp, levels)
    known = np.isfinite(control)
    shown = np.interp(wanted, np.arange(levels)[known], control[known])
    return np.asarray((shown + 1.0) * 127.5, np.float64)
