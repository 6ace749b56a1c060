"""Which gray levels fringes should lie between: straight enough, and wide enough."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from backend.numerics.camera_response import ResponseProblem
from backend.numerics.errors import ResponseError
from backend.numerics.linearisation import Interval, interval_of, optimised_response
from backend.numerics.screen_ramp import LEAST_POINTS, MonotoneRamp, control_of_gray


class IntervalSearch(NamedTuple):
    """The cost of every interval on a grid, and the cheapest one."""

    best: Interval
    cost: float
    """U of the best one."""
    quoted_error_percent: float
    cost_map: Float64[np.ndarray, "high low"]
    """U over (upper gray, lower gray); NaN where an interval is refused."""
    axis_gray: Float64[np.ndarray, "grid"]
    """Gray levels of rows and columns."""


def search_interval(
    problem: ResponseProblem,
    ramp: MonotoneRamp,
    *,
    resolution_weight: float = 20.0,
    grid_gray: int = 5,
    at: tuple[int, int] | None = None,
) -> IntervalSearch:
    r"""Search all pairs of gray levels for the smallest U, then in steps of one gray around it.

    Parameters
    ----------
    problem
        The stack's samples.
    ramp
        The screen's ramp; intervals lie within it.
    resolution_weight
        :math:`\eta`: what a coarse range costs beside a bent one.
    grid_gray
        Step of the full search, in gray levels of 8 bit.
    at
        Darkest and brightest gray level where they are chosen already; None: the best ones.

    Raises
    ------
    ResponseError
        If no pair is left: the ramp is too short, or no response grows; or if the ramp doesn't reach `at`.

    Notes
    -----
    :math:`U(G_{min}, G_{max}) = \max |\mu| + \eta k`, :math:`k = 100\,\% / (G_{max} - G_{min})` (equations 14 and
    15, gray levels of 8 bit), :math:`\mu` the quoted error of the response optimised for that pair. Refused
    are pairs with fewer than five points of the ramp between them, those that hold too few points of the stack at two
    exposures, and those whose response doesn't grow.
    About 900 solutions of some 0.3 ms.
    """
    trial = _Trial(problem, ramp, resolution_weight)
    scale = problem.levels / 256.0
    step = max(1, round(grid_gray * scale))
    axis = np.arange(0, problem.levels, step)
    costs = np.full((axis.size, axis.size), np.nan)
    for column, low in enumerate(axis):
        for row in range(column + 1, axis.size):
            costs[row, column] = trial.cost(int(low), int(axis[row]))
    if np.isnan(costs).all():
        raise ResponseError(
            f"no interval within the ramp's {ramp.gray_low:.0f} to {ramp.gray_high:.0f} gray has a response that grows: "
            f"check that stack and ramp were taken with the same camera settings"
        )
    upper, lower = divmod(int(np.nanargmin(costs)), axis.size)
    pairs = _around(int(axis[lower]), int(axis[upper]), step, fine=max(1, round(scale)))
    best = at or min(pairs, key=lambda pair: trial.ranked(*pair))
    return IntervalSearch(
        best=interval_of(trial.control, *best),
        cost=trial.cost(*best),
        quoted_error_percent=trial.quoted_error(*best),
        cost_map=costs,
        axis_gray=axis.astype(np.float64),
    )


def _around(low: int, high: int, step: int, fine: int) -> Iterator[tuple[int, int]]:
    for change_low in range(-step + fine, step, fine):
        for change_high in range(-step + fine, step, fine):
            yield low + change_low, high + change_high


class _Trial:
    """Solves for one pair after the other."""

    def __init__(
        self, problem: ResponseProblem, ramp: MonotoneRamp, resolution_weight: float
    ) -> None:
        self._problem, self._ramp, self._weight = problem, ramp, resolution_weight
        self._first = problem.solve()
        self.control = control_of_gray(ramp, problem.levels)
        known = np.flatnonzero(np.isfinite(self.control))
        self._lowest, self._highest = int(known[0]), int(known[-1])

    def cost(self, low: int, high: int) -> float:
        """Return U of a pair, NaN if it is refused."""
        width = (high - low) * 256.0 / self._problem.levels
        return self.quoted_error(low, high) + self._weight * 100.0 / max(width, 1.0)

    def ranked(self, low: int, high: int) -> float:
        """Return U of a pair, infinite if it is refused."""
        cost = self.cost(low, high)
        return cost if np.isfinite(cost) else np.inf

    def quoted_error(self, low: int, high: int) -> float:
        """Return max |mu| in percent, NaN if the pair is refused."""
        points = np.searchsorted(self._ramp.gray, [low, high])
        if low < self._lowest or high > self._highest or np.ptp(points) < LEAST_POINTS:
            return np.nan
        if not self._problem.determined(low, high):
            return np.nan
        found = optimised_response(
            self._problem, self._first, self.control, interval_of(self.control, low, high)
        )
        return found.quoted_error_percent if found.monotone else np.nan
