"""Exposures for a scene: how noisy the phase will be, and the set of times that makes it least so."""

from collections.abc import Sequence
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.special import ndtr

from backend.numerics.errors import PlanningError
from backend.numerics.uncertainty import NoiseModel

FusionKind = Literal["weighted", "longest"]


class FringeCoding(NamedTuple):
    """What the fringes do with the projector's light."""

    steps: int = 4
    """Frames per frequency, N."""
    low_share: float = 40 / 255
    """Light at the fringes' minimum as a share of the white field's."""
    high_share: float = 220 / 255
    """Light at the fringes' maximum as a share of the white field's."""
    frames: int = 12
    """Frames per exposure, over all frequencies."""
    order_distance_rad: float = 0.2653
    """Half distance between neighbouring fringe orders in [rad] of phase; 0.2653 for 59, 64, 70."""


class ServiceLimits(NamedTuple):
    """When an exposure serves a pixel."""

    full_scale_gray: float = 255.0
    """The camera's largest gray level."""
    headroom_gray: float = 2.0
    """A pixel is saturated above full scale minus this."""
    modulation_min_gray: float = 3.0
    """Smallest usable amplitude B of the fringes."""
    phase_sigma_max_rad: float = 0.0538
    """Noisier pixels count as not covered: one wrong fringe order in a million (59, 64, 70)."""
    noise_weight: float = 0.1
    """Cost of a pixel whose phase is as noisy as just allowed, against 1 for a pixel without a phase:
    one more pixel counts ten times as much as making another one precise."""


class ExposureRange(NamedTuple):
    """Which exposure times are possible."""

    min_ms: float
    max_ms: float
    period_ms: float | None = None
    """Exposures are multiples of it (the projector's frame); None: any."""
    overhead_ms: float = 0.0
    """Added to every frame: read-out, projector trigger."""


class RateHistogram(NamedTuple):
    """How many pixels receive how much light."""

    rates_gray_per_ms: Float[np.ndarray, "bin"]
    """Centres of the bins, equally spaced in the logarithm, increasing."""
    pixels: Float[np.ndarray, "bin"]


class Prediction(NamedTuple):
    """What a set of exposures will give, before anything is captured."""

    exposures_ms: Float[np.ndarray, "exposure"]
    """Increasing."""
    time_s: float
    """Sum over exposures of frames times (exposure + overhead)."""
    coverage: float
    """Share of the pixels whose phase will be usable."""
    saturated: float
    """Share of the pixels that saturate even at the shortest exposure."""
    phase_sigma_median_rad: float
    """Median over the covered pixels; NaN without any."""
    cost: float
    """What the plan minimises, 0..1: the share of the pixels without a usable phase, plus the noise
    of the others, weighted (see `ServiceLimits.noise_weight`)."""
    phase_sigma_rad: Float[np.ndarray, "bin"]
    """Predicted noise per light level; NaN where no exposure serves it."""
    served_by: Integer[np.ndarray, "bin"]
    """Index of the longest exposure that serves the light level; -1 means none."""


class ExposurePlan(NamedTuple):
    """The chosen set of exposures and the best set of every other size."""

    chosen: Prediction
    by_count: tuple[Prediction, ...]
    """Best prediction for each number of exposures tried, ascending."""
    gain: Float[np.ndarray, "count"]
    """Share by which each number of exposures lowers the cost of the number before; the first is NaN."""


class PaperExposures(NamedTuple):
    """Exposures of equation 14, as calculated and as the devices allow."""

    wanted_ms: Float[np.ndarray, "zone"]
    exposures_ms: Float[np.ndarray, "zone"]
    """Rounded to the projector's period and clipped to the camera's range."""
    clipped: Bool[np.ndarray, "zone"]
    """True where the camera's range doesn't hold the wanted time."""


_LIMITS = ServiceLimits()
_CODING = FringeCoding()


# ---------------------------------------------------------------- the paper's rule


def exposure_for_peak(
    t_pre_ms: float,
    peaks_gray: Float[np.ndarray, "zone"],
    optimum_gray: float = 254.0,
    *,
    black_gray: float = 0.0,
) -> Float[np.ndarray, "zone"]:
    """Return the exposures that bring each zone's peak to the optimum (equation 14).

    Parameters
    ----------
    t_pre_ms
        Exposure at which the peaks were measured, in [ms].
    peaks_gray
        Peak of each zone in [gray].
    optimum_gray
        I_opt in [gray], the level that a peak shall reach.
    black_gray
        Black level in [gray]; the paper neglects it (0).

    Returns
    -------
    t = (I_opt - black) / (P - black) t_pre in [ms], in the order of the peaks.

    Raises
    ------
    PlanningError
        If a peak isn't above the black level, or the exposure isn't positive.

    Examples
    --------
    >>> exposure_for_peak(60.0, np.array([127.0]))
    array([120.])
    """
    if not t_pre_ms > 0:
        raise PlanningError(f"the pre-exposure is {t_pre_ms:g} ms; it has to be above 0")
    if not (peaks_gray > black_gray).all():
        raise PlanningError(
            f"a zone's peak is {np.min(peaks_gray):g} gray, not above the black level"
            f" {black_gray:g}; raise the lowest valley or expose longer"
        )
    return np.asarray((optimum_gray - black_gray) / (peaks_gray - black_gray) * t_pre_ms)


def paper_exposures(
    t_pre_ms: float,
    peaks_gray: Float[np.ndarray, "zone"],
    grid: ExposureRange,
    *,
    optimum_gray: float = 254.0,
    black_gray: float = 0.0,
) -> PaperExposures:
    """Apply equation 14, round to the projector's period, clip to the camera's range.

    Rounding goes down, so that a peak that just fits isn't pushed into saturation, but
    never below the shortest possible exposure.
    """
    wanted = exposure_for_peak(t_pre_ms, peaks_gray, optimum_gray, black_gray=black_gray)
    low, high = _grid_ends(grid)
    return PaperExposures(
        wanted_ms=wanted,
        exposures_ms=on_grid(np.clip(wanted, low, high), grid),
        clipped=(wanted < low) | (wanted > grid.max_ms),
    )


def on_grid(
    exposures_ms: Float[np.ndarray, "exposure"], grid: ExposureRange
) -> Float[np.ndarray, "exposure"]:
    """Round exposures down to the grid, within its ends."""
    low, high = _grid_ends(grid)
    if grid.period_ms:
        exposures_ms = np.floor(exposures_ms / grid.period_ms * (1 + 1e-9)) * grid.period_ms
    return np.asarray(np.clip(exposures_ms, low, high))


def _grid_ends(grid: ExposureRange) -> tuple[float, float]:
    low, high = grid.min_ms, grid.max_ms
    if grid.period_ms:
        low = max(1.0, np.ceil(grid.min_ms / grid.period_ms * (1 - 1e-9))) * grid.period_ms
        high = np.floor(grid.max_ms / grid.period_ms * (1 + 1e-9)) * grid.period_ms
    if not 0 < low <= high:
        raise PlanningError(
            f"no exposure lies within {grid.min_ms:g}..{grid.max_ms:g} ms at a projector period of"
            f" {grid.period_ms or 0:g} ms; widen the camera's range"
        )
    return float(low), float(high)


# ---------------------------------------------------------------- light per pixel


def rate_histogram(
    rates_gray_per_ms: Sequence[Float[np.ndarray, "_h _w"]], *, bins: int = 128
) -> RateHistogram:
    """Pool the light per pixel of all cameras into a histogram over its logarithm.

    Parameters
    ----------
    rates_gray_per_ms
        Per camera C in [gray/ms]; NaN, zero and negative values are left out.
    bins
        Number of bins between the darkest and the brightest pixel.

    Raises
    ------
    PlanningError
        If no pixel has a positive finite value.
    """
    values = np.concatenate(
        [r[np.isfinite(r) & (r > 0)] for r in rates_gray_per_ms] or [np.empty(0)]
    )
    if values.size == 0:
        raise PlanningError(
            "no pixel receives light; point the projector at the part or expose longer"
        )
    log_rates = np.log(values.astype(np.float64))
    low, high = float(log_rates.min()), float(log_rates.max())
    high = max(high, low + 1e-6)
    pixels, edges = np.histogram(log_rates, bins=bins, range=(low, high))
    return RateHistogram(np.exp(0.5 * (edges[1:] + edges[:-1])), pixels.astype(np.float64))


# ---------------------------------------------------------------- prediction


def phase_information(
    rates_gray_per_ms: Float[np.ndarray, "bin"],
    exposures_ms: Float[np.ndarray, "exposure"],
    noise: NoiseModel,
    coding: FringeCoding = _CODING,
    limits: ServiceLimits = _LIMITS,
) -> Float[np.ndarray, "exposure bin"]:
    r"""Return the Fisher information of the phase that each exposure gives each light level.

    Parameters
    ----------
    rates_gray_per_ms
        Light of a pixel under the white field, C in [gray/ms].
    exposures_ms
        Exposures in [ms].
    noise, coding, limits
        Camera, fringes, and when an exposure serves a pixel.

    Returns
    -------
    J in [1/rad^2] of one frequency; 0 where the exposure saturates the pixel or leaves
    the modulation too small.

    Notes
    -----
    .. math:: J = N B^2 / (2 \sigma_I^2), \quad
        \sigma_I^2 = \sigma_{read}^2 + (A - black)\, G + 1/12

    with G gray levels per electron, B half of, and A - black the mean of, the fringe's low and high light C t. The noise is
    that of the mean level, which for N >= 4 equal steps is exact [1]_.

    References
    ----------
    .. [1] C. Rathjen, "Statistical properties of phase-shift algorithms", Journal of the
       Optical Society of America A 12(9), 1997 (1995), doi:10.1364/JOSAA.12.001997.
    """
    signal = exposures_ms[:, None] * rates_gray_per_ms[None, :]
    modulation = signal * (coding.high_share - coding.low_share) / 2
    mean = signal * (coding.high_share + coding.low_share) / 2
    variance = noise.dark_variance_gray2 + mean * noise.gray_per_e
    brightest = noise.black_gray + signal * coding.high_share
    served = (brightest <= limits.full_scale_gray - limits.headroom_gray) & (
        modulation >= limits.modulation_min_gray
    )
    return np.where(served, coding.steps * modulation**2 / (2 * variance), 0.0)


def predict(
    light: RateHistogram,
    exposures_ms: Float[np.ndarray, "exposure"],
    noise: NoiseModel,
    *,
    coding: FringeCoding = _CODING,
    limits: ServiceLimits = _LIMITS,
    fusion: FusionKind = "weighted",
    overhead_ms: float = 0.0,
) -> Prediction:
    """Predict coverage and phase noise of any set of exposures.

    Parameters
    ----------
    light
        Pixels per light level.
    exposures_ms
        Exposures in [ms], in any order, at least one.
    noise, coding, limits
        Camera, fringes, and when an exposure serves a pixel.
    fusion
        "weighted": information of all serving exposures adds up; "longest": the longest
        serving exposure alone.
    overhead_ms
        Added to every frame in [ms].

    Raises
    ------
    PlanningError
        If no exposure is given or one isn't positive.
    """
    if exposures_ms.size == 0 or not (exposures_ms > 0).all():
        raise PlanningError(f"exposures {exposures_ms.tolist()} ms; give at least one, all above 0")
    times = np.sort(exposures_ms.astype(np.float64))
    information = phase_information(light.rates_gray_per_ms, times, noise, coding, limits)
    combined = _combined(information, fusion)
    with np.errstate(divide="ignore"):
        sigma = np.where(combined > 0, 1 / np.sqrt(combined), np.nan)
    covered = sigma <= limits.phase_sigma_max_rad
    total = max(light.pixels.sum(), 1.0)
    too_bright = (
        noise.black_gray + times[0] * light.rates_gray_per_ms * coding.high_share
        > limits.full_scale_gray - limits.headroom_gray
    )
    longest_first = np.argmax(information[::-1] > 0, axis=0)
    return Prediction(
        exposures_ms=times,
        time_s=float(coding.frames * (times + overhead_ms).sum() / 1000),
        coverage=float(light.pixels[covered].sum() / total),
        saturated=float(light.pixels[too_bright].sum() / total),
        phase_sigma_median_rad=_weighted_median(sigma[covered], light.pixels[covered]),
        cost=float((_cost(combined, coding, limits) * light.pixels).sum() / total),
        phase_sigma_rad=sigma,
        served_by=np.where(combined > 0, times.size - 1 - longest_first, -1),
    )


def _combined(
    information: Float[np.ndarray, "exposure bin"], fusion: FusionKind
) -> Float[np.ndarray, "bin"]:
    # Information grows with the exposure as long as it serves, so the longest is the best.
    return np.asarray(information.sum(axis=0) if fusion == "weighted" else information.max(axis=0))


_WRONG_ORDERS_ALLOWED = 0.01
"""A pixel with this probability of a wrong fringe order is worth nothing."""


def _cost(
    information: Float[np.ndarray, "*any"], coding: FringeCoding, limits: ServiceLimits
) -> Float[np.ndarray, "*any"]:
    """Return 1 for no phase or one whose order can't be trusted, else the weighted phase variance."""
    sigma = 1 / np.sqrt(np.maximum(information, 1e-12))
    wrong_order = 2.4 * ndtr(-coding.order_distance_rad / sigma)
    noise = limits.noise_weight * (sigma / limits.phase_sigma_max_rad) ** 2
    return np.where(
        information > 0, np.minimum(noise + wrong_order / _WRONG_ORDERS_ALLOWED, 1.0), 1.0
    )


def _weighted_median(values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n"]) -> float:
    if not weights.any():
        return float("nan")
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])


# ---------------------------------------------------------------- planning


class _Problem(NamedTuple):
    """Candidates and what each of them gives, ready for the search."""

    times_ms: Float[np.ndarray, "candidate"]
    information: Float[np.ndarray, "candidate bin"]
    pixels: Float[np.ndarray, "bin"]
    budget_ms: float
    """Budget for the sum of the exposures alone."""
    overhead_ms: float
    coding: FringeCoding
    limits: ServiceLimits
    fusion: FusionKind

    def cost(self, chosen: tuple[int, ...]) -> float:
        combined = _combined(self.information[list(chosen)], self.fusion)
        return float((_cost(combined, self.coding, self.limits) * self.pixels).sum())

    def fits(self, chosen: tuple[int, ...]) -> bool:
        spent = self.times_ms[list(chosen)].sum() + len(chosen) * self.overhead_ms
        return bool(spent <= self.budget_ms * (1 + 1e-9))


def plan_exposures(
    light: RateHistogram,
    noise: NoiseModel,
    grid: ExposureRange,
    *,
    budget_s: float,
    count_range: tuple[int, int] = (1, 5),
    coding: FringeCoding = _CODING,
    limits: ServiceLimits = _LIMITS,
    fusion: FusionKind = "weighted",
    gain_min: float = 0.25,
) -> ExposurePlan:
    r"""Choose the exposures that measure most pixels, with least noise, within a time budget.

    Parameters
    ----------
    light
        Pixels per light level, see `rate_histogram`.
    noise, coding, limits
        Camera, fringes, and when an exposure serves a pixel.
    grid
        Possible exposures.
    budget_s
        Time for all frames of all exposures in [s].
    count_range
        Smallest and largest number of exposures.
    fusion
        How the exposures will be combined.
    gain_min
        One exposure more is taken as long as it lowers the cost by at least this share. 0 takes
        the best number whatever its gain.

    Returns
    -------
    The chosen set, the best set of each number, and what each further exposure gains.

    Raises
    ------
    PlanningError
        If the budget doesn't hold the smallest number of exposures, or the range is empty.

    Notes
    -----
    With the longest serving exposure alone the cost is a sum over intervals of light between
    neighbouring exposures, and dynamic programming over (number, longest exposure, time spent)
    is exact up to the rounding of time to 1/400 of the budget (spent time is rounded up, so the
    budget holds). With weighted fusion an exposure made for bright pixels also informs all darker ones, which
    isn't a sum over intervals: the programme's set is the start of a descent on the true
    cost that moves one exposure, or two at once so that they can trade time.
    Cost: about 0.5 s for 90 candidates, 128 bins and 5 exposures.
    """
    low, high = count_range
    if not 1 <= low <= high:
        raise PlanningError(f"the number of exposures is {low}..{high}; give 1 <= least <= most")
    problem = _problem(light, noise, grid, budget_s, coding, limits, fusion, high)
    _check_budget(problem, budget_s, low)
    starts = _programme(problem, high)
    best: list[Prediction] = []
    for count in range(low, high + 1):
        candidates = [s for s in _starts(problem, starts, count) if problem.fits(s)]
        if not candidates:
            break
        sets = [_descend(problem, start) for start in candidates]
        chosen = min(sets, key=problem.cost)
        best.append(
            predict(
                light,
                problem.times_ms[list(chosen)],
                noise,
                coding=coding,
                limits=limits,
                fusion=fusion,
                overhead_ms=grid.overhead_ms,
            )
        )
    # what no exposure can serve (shadows, mirrors) mustn't hide what a further exposure gains elsewhere
    cost = np.array([p.cost for p in best]) - _unservable(problem)
    gain = np.concatenate([[np.nan], 1 - cost[1:] / np.maximum(cost[:-1], 1e-12)])
    return ExposurePlan(best[_enough(cost, gain_min)], tuple(best), gain)


def _problem(
    light: RateHistogram,
    noise: NoiseModel,
    grid: ExposureRange,
    budget_s: float,
    coding: FringeCoding,
    limits: ServiceLimits,
    fusion: FusionKind,
    most: int,
) -> _Problem:
    if not (np.isfinite(budget_s) and budget_s > 0):
        raise PlanningError(f"the time budget is {budget_s:g} s; it has to be above 0 and finite")
    budget_ms = 1000 * budget_s / coding.frames
    times = _candidates(light, noise, grid, budget_ms, coding, limits, most)
    information = phase_information(light.rates_gray_per_ms, times, noise, coding, limits)
    return _Problem(
        times, information, light.pixels, budget_ms, grid.overhead_ms, coding, limits, fusion
    )


def _candidates(
    light: RateHistogram,
    noise: NoiseModel,
    grid: ExposureRange,
    budget_ms: float,
    coding: FringeCoding,
    limits: ServiceLimits,
    most: int,
    number: int = 90,
) -> Float[np.ndarray, "candidate"]:
    """Return possible exposures, log-spaced from the brightest pixel's limit to the darkest's."""
    low, high = _grid_ends(grid)
    usable = limits.full_scale_gray - limits.headroom_gray - noise.black_gray
    lit = light.rates_gray_per_ms[light.pixels > 0]
    # 0.999: just below the edge of a bin's centre, not at the mercy of rounding
    bright = 0.999 * usable / (coding.high_share * lit.max())
    # Shorter than the brightest pixel needs makes sense only if the budget is short of time.
    shortest = np.clip(min(bright, budget_ms / (4 * most)), low, high)
    longest = np.clip(0.999 * usable / (coding.high_share * lit.min()), shortest, high)
    longest = min(longest, max(budget_ms, shortest))
    times = np.geomspace(shortest, longest, number)
    return np.unique(np.round(on_grid(times, grid), 9))


def _check_budget(problem: _Problem, budget_s: float, least: int) -> None:
    needed = np.sort(problem.times_ms)[:least]
    spent_ms = needed.sum() + least * problem.overhead_ms
    if needed.size < least:
        raise PlanningError(
            f"only {needed.size} different exposures are possible but {least} are asked for;"
            " lower the least number of exposures or widen the camera's range"
        )
    if spent_ms > problem.budget_ms * (1 + 1e-9):
        raise PlanningError(
            f"the time budget of {budget_s:g} s can't hold {least} exposure(s): the shortest possible"
            f" need {spent_ms * problem.coding.frames / 1000:.3g} s for {problem.coding.frames}"
            " frames each; raise the budget or lower the number of exposures or frames"
        )


def _unservable(problem: _Problem) -> float:
    """Return the share of the pixels that no possible exposure serves."""
    served = (problem.information > 0).any(axis=0)
    return float(problem.pixels[~served].sum() / max(problem.pixels.sum(), 1.0))


def _enough(cost: Float[np.ndarray, "count"], gain_min: float) -> int:
    """Return the index of the last number of exposures that is worth its step."""
    if gain_min <= 0:
        return int(np.argmin(cost))
    chosen = 0
    for index in range(1, cost.size):
        # measured from the number chosen so far: two small steps may make a worthwhile one
        if cost[index] <= cost[chosen] * (1 - gain_min) ** (index - chosen):
            chosen = index
    return chosen


_TIME_STEPS = 400


def _programme(problem: _Problem, most: int) -> list[tuple[int, ...] | None]:
    """Solve the longest-exposure problem exactly; entry k - 1 is the best set of k or None."""
    intervals = _interval_costs(problem)
    number = problem.times_ms.size
    price = np.ceil(
        (problem.times_ms + problem.overhead_ms) / problem.budget_ms * _TIME_STEPS - 1e-6
    ).astype(np.int64)
    # best[j, s]: cost of the light that needs at most exposure j, j chosen, s time steps spent
    best = np.full((number, _TIME_STEPS + 1), np.inf)
    for j in range(number):
        if price[j] <= _TIME_STEPS:
            best[j, price[j] :] = intervals[0, j]
    tables, choices = [best], [np.full(best.shape, -1)]
    for _ in range(1, most):
        best, choice = _one_more(tables[-1], intervals, price)
        tables.append(best)
        choices.append(choice)
    return [_traced(tables, choices, price, intervals[-1, :-1], k) for k in range(most)]


def _interval_costs(problem: _Problem) -> Float[np.ndarray, "candidate_1 candidate"]:
    """Return the cost of the light between neighbouring exposures.

    Entry [i + 1, j] with i < j: pixels that exposure j saturates or starves stay with i.
    It is written as the change that adding j to a set with longest exposure i makes, so that sums
    over a chain are the cost of the chain: [0, j] is the cost of j alone.
    """
    single = _cost(problem.information, problem.coding, problem.limits)
    weighted = single * problem.pixels
    served = problem.information > 0
    number = problem.times_ms.size
    costs = np.full((number + 1, number + 1), np.inf)
    costs[0, :number] = weighted.sum(axis=1)
    costs[-1, :] = 0.0
    for i in range(number):
        # served by the longer one: it takes over from whatever served before, i or shorter
        gain = np.where(served[i], weighted[i], problem.pixels)
        change = np.where(served[i + 1 :], weighted[i + 1 :] - gain, 0.0)
        costs[i + 1, i + 1 : number] = change.sum(axis=1)
    return costs


def _one_more(
    best: Float[np.ndarray, "candidate step"],
    intervals: Float[np.ndarray, "candidate_1 candidate_1b"],
    price: Integer[np.ndarray, "candidate"],
) -> tuple[Float[np.ndarray, "candidate step"], Integer[np.ndarray, "candidate step"]]:
    more = np.full(best.shape, np.inf)
    choice = np.full(best.shape, -1)
    for j in range(1, best.shape[0]):
        if price[j] > _TIME_STEPS:
            break
        sums = best[:j, : _TIME_STEPS + 1 - price[j]] + intervals[1 : j + 1, j][:, None]
        choice[j, price[j] :] = np.argmin(sums, axis=0)
        more[j, price[j] :] = sums.min(axis=0)
    return more, choice


def _traced(
    tables: list[Float[np.ndarray, "candidate step"]],
    choices: list[Integer[np.ndarray, "candidate step"]],
    price: Integer[np.ndarray, "candidate"],
    end: Float[np.ndarray, "candidate"],
    k: int,
) -> tuple[int, ...] | None:
    totals = tables[k][:, -1] + end
    j, step = int(np.argmin(totals)), _TIME_STEPS
    if not np.isfinite(totals[j]):
        return None
    chain = [j]
    for level in range(k, 0, -1):
        previous = int(choices[level][j, step])
        step -= int(price[j])
        j = previous
        chain.append(j)
    return tuple(sorted(chain))


def _starts(
    problem: _Problem, programme: list[tuple[int, ...] | None], count: int
) -> list[tuple[int, ...]]:
    """Return sets to start the descent from: the programme's, and the cheapest possible."""
    starts = [tuple(range(count))] if count <= problem.times_ms.size else []
    planned = programme[count - 1]
    if planned is not None:
        starts.insert(0, planned)
    return starts


def _descend(problem: _Problem, start: tuple[int, ...]) -> tuple[int, ...]:
    """Move one or two exposures at a time to the best place until nothing improves."""
    chosen, cost = start, problem.cost(start)
    while True:
        better = _best_move(problem, chosen, cost, 1) or _best_move(problem, chosen, cost, 2)
        if better is None:
            return chosen
        chosen, cost = better, problem.cost(better)


def _best_move(
    problem: _Problem, chosen: tuple[int, ...], cost: float, moved: int
) -> tuple[int, ...] | None:
    if len(chosen) < moved:
        return None
    best, best_cost = None, cost * (1 - 1e-9)
    for positions in combinations(range(len(chosen)), moved):
        kept = tuple(c for i, c in enumerate(chosen) if i not in positions)
        candidate, candidate_cost = _best_filling(problem, kept, moved)
        if candidate is not None and candidate_cost < best_cost:
            best, best_cost = candidate, candidate_cost
    return best


def _best_filling(
    problem: _Problem, kept: tuple[int, ...], moved: int
) -> tuple[tuple[int, ...] | None, float]:
    """Try every one (or every second pair) of the candidates beside those kept."""
    free = np.setdiff1d(np.arange(problem.times_ms.size), kept)
    if moved == 1:
        sets = free[:, None]
    else:
        first, second = np.triu_indices(free.size, 1)
        sets = np.stack([free[first], free[second]], axis=1)
    overhead = (len(kept) + moved) * problem.overhead_ms
    spent = problem.times_ms[sets].sum(axis=1) + problem.times_ms[list(kept)].sum() + overhead
    sets = sets[spent <= problem.budget_ms * (1 + 1e-9)]
    if sets.shape[0] == 0:
        return None, np.inf
    base = problem.information[list(kept)]
    combine = np.add if problem.fusion == "weighted" else np.maximum
    combined = problem.information[sets[:, 0]]
    for column in range(1, moved):
        combined = combine(combined, problem.information[sets[:, column]])
    if kept:
        combined = combine(combined, _combined(base, problem.fusion)[None, :])
    costs = _cost(combined, problem.coding, problem.limits) @ problem.pixels
    index = int(np.argmin(costs))
    return tuple(sorted([*kept, *(int(c) for c in sets[index])])), float(costs[index])


# ---------------------------------------------------------------- single exposures, to compare with


def single_exposures(
    light: RateHistogram,
    noise: NoiseModel,
    grid: ExposureRange,
    *,
    coding: FringeCoding = _CODING,
    limits: ServiceLimits = _LIMITS,
    share: float = 0.02,
) -> tuple[float, float]:
    """Return a low and a high single exposure in [ms], as one would set them by hand.

    The low one leaves at most `share` of the pixels saturated (the bright part is measured, the dark
    one lost); the high one uses the full range for the darkest tenth of the pixels.
    """
    usable = limits.full_scale_gray - limits.headroom_gray - noise.black_gray
    cumulative = np.cumsum(light.pixels) / max(light.pixels.sum(), 1.0)
    bright = light.rates_gray_per_ms[np.searchsorted(cumulative, 1 - share, side="left")]
    dark = light.rates_gray_per_ms[np.searchsorted(cumulative, 0.1, side="left")]
    times = on_grid(usable / (coding.high_share * np.array([bright, dark])), grid)
    return float(times[0]), float(times[1])
