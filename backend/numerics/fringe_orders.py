"""How wrapped phases of several frequencies become one position: four ways to find the fringe orders.

All of them are prepared here once per code, as tables; the pixels are done by one kernel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from jaxtyping import Float64, Int64

from backend.numerics.errors import FrequencyError
from backend.numerics.order_rows import CHAIN, CODE, LATTICE, Orders

MIN_DISTANCE_CYCLES = 0.02
"""Fringe orders nearer to each other than this are mixed up by 13 mrad of phase noise."""

WRAP_MARGIN_CYCLES = 0.2
"""How far noise may carry a phase over the end of its period."""

DEFAULT_RESIDUAL_SHARE = 0.7
"""Share of half the lattice's distance up to which a pixel's residual is accepted by default."""

_MAX_FREQUENCIES = 6
_CELLS = {1: 4096, 2: 2**14, 3: 2**17, 4: 2**17, 5: 2**17}
"""Cells of the look-up table by dimension; two candidates per cell make up for coarse cells."""

_SAME_CYCLES = 1e-6
"""Lattice points nearer than this are one point: the code repeats there."""


@dataclass(frozen=True, eq=False)
class FringeOrders:
    """A prepared way from wrapped phases to a position."""

    strategy: str
    """"maximum_likelihood", "cascade", "hierarchical" or "code_aided"."""
    periods: tuple[float, ...]
    """Periods over the width, in the order of the phases."""
    range_widths: float
    """The position is unambiguous over this many widths; infinite if it never repeats."""
    distance_cycles: float
    """Smallest distance between two fringe orders in the space of the phases (its half is the
    misfit at which they are mixed up)."""
    default_residual_cycles: float
    """Limit of the residual that goes with this way if none is set."""
    tables: Orders
    """What the kernel reads."""


def maximum_likelihood(periods: Sequence[float], *, guard_band: float = 0.0) -> FringeOrders:
    r"""Prepare the likeliest fringe orders, by look-up in the space orthogonal to the frequencies.

    Parameters
    ----------
    periods
        Periods over the width of 2 to 6 frequencies, whole numbers or not.
    guard_band
        Share of the width at each end where positions aren't wanted: orders there needn't be told
        apart from those at the other end.

    Raises
    ------
    FrequencyError
        If two places in [0, 1) have the same phases, or nearly so.

    Notes
    -----
    With phases :math:`w_i \in [0, 1)` in cycles and orders :math:`k_i`, :math:`w = f x - k`: every
    order vector is a line along :math:`f`, and its distance from the phases, seen in the space
    orthogonal to :math:`f`, doesn't depend on x. For equal noise on all phases the nearest line is
    the likeliest [1]_, and the position on it is the least-squares one,
    :math:`x = \sum f_i (w_i + k_i) / \sum f_i^2`. For (59, 64, 70) there are 190 lines within the
    period cube, 0.0845 cycles apart, plus those that noise reaches over the cube's faces.

    A table gives the two nearest lines of a cell's centre, and the kernel compares the two: exact
    except in the few cells where three lines meet, at a misfit that is refused anyway.

    References
    ----------
    .. [1] T. Petkovic, T. Pribanic, M. Donlic, "Temporal phase unwrapping using orthographic
       projection", Optics and Lasers in Engineering 90, 34 (2017),
       doi:10.1016/j.optlaseng.2016.09.006.
    """
    return _maximum_likelihood(tuple(float(value) for value in periods), float(guard_band))


@lru_cache(maxsize=16)
def _maximum_likelihood(periods: tuple[float, ...], guard_band: float) -> FringeOrders:
    # scipy.spatial costs 0.1 s to import: only those who build a table pay.
    from scipy.spatial import cKDTree

    if not 2 <= len(periods) <= _MAX_FREQUENCIES:
        raise FrequencyError(
            f"maximum likelihood needs 2 to {_MAX_FREQUENCIES} frequencies, got {len(periods)}: "
            "choose another way to find the fringe orders, or other frequencies"
        )
    range_widths = unambiguous_range(periods)
    if range_widths < 1 - 1e-9:
        raise FrequencyError(
            f"fringes of {_listed(periods)} periods repeat after {range_widths:.4g} of the width: "
            "choose periods without a common divisor, or add a Gray code"
        )
    frequencies = np.array(periods)
    lines, places = _order_lines(frequencies)
    basis = _orthogonal_basis(frequencies)
    points = -lines @ basis
    points, lines, places = _without_repeats(points, lines, places)
    distance_cycles = _smallest_distance(
        points[(places >= guard_band) & (places <= 1 - guard_band)]
    )
    if distance_cycles < MIN_DISTANCE_CYCLES:
        raise FrequencyError(
            f"fringes of {_listed(periods)} periods are told apart by {distance_cycles:.3g} cycles only "
            f"(at least {MIN_DISTANCE_CYCLES:g} are needed): choose periods that differ less regularly, or add a Gray code"
        )
    low, shape, cell_size = _cells(basis)
    centres = np.stack([axis.ravel() for axis in np.indices(tuple(shape))], axis=1)
    found = cKDTree(points).query(low + (centres + 0.5) * cell_size, k=2)
    nearest = np.asarray(found[1])
    offsets = (lines @ frequencies) / (frequencies @ frequencies)
    tables = Orders(
        mode=LATTICE,
        periods=frequencies.astype(np.float32),
        fuse=True,
        range_widths=range_widths if np.isfinite(range_widths) else 0.0,
        combinations=np.zeros((0, 0), np.float32),
        chain_periods=np.zeros(0, np.float32),
        half_code=0.0,
        projection=np.ascontiguousarray((basis / cell_size).T.astype(np.float32)),
        origin=(-low / cell_size).astype(np.float32),
        shape=shape,
        nearest=np.ascontiguousarray(offsets[nearest[:, 0]].astype(np.float32)),
        second=np.ascontiguousarray(offsets[nearest[:, 1]].astype(np.float32)),
    )
    return FringeOrders(
        strategy="maximum_likelihood",
        periods=periods,
        range_widths=range_widths,
        distance_cycles=distance_cycles,
        default_residual_cycles=DEFAULT_RESIDUAL_SHARE * distance_cycles / 2,
        tables=tables,
    )


def unambiguous_range(periods: Sequence[float]) -> float:
    """Find after how many widths all phases are the same again; infinite if not within 100 widths.

    Examples
    --------
    >>> unambiguous_range([59, 64, 70]), unambiguous_range([30, 36, 42])
    (1.0, 0.16666666666666666)
    """
    frequencies = np.asarray(periods, dtype=np.float64)
    ranges = np.arange(1, int(100 * frequencies[0]) + 1) / frequencies[0]
    cycles = np.outer(ranges, frequencies)
    same = np.all(np.abs(cycles - np.rint(cycles)) < _SAME_CYCLES, axis=1)
    return float(ranges[np.argmax(same)]) if same.any() else float("inf")


def _order_lines(
    frequencies: Float64[np.ndarray, "k"],
) -> tuple[Int64[np.ndarray, "n k"], Float64[np.ndarray, "n"]]:
    """List the order vectors that occur in [0, 1), noise over the ends of a period included.

    The second result is the middle of the interval in which each of them occurs.
    """
    margin = WRAP_MARGIN_CYCLES
    ends = []
    for periods in frequencies:
        orders = np.arange(-1, np.ceil(periods) + 2)
        ends += [(orders - margin) / periods, (orders + margin) / periods]
    beyond = margin / frequencies.max()
    borders = np.unique(np.concatenate([*ends, [-beyond, 1 + beyond]]))
    borders = borders[(borders >= -beyond) & (borders <= 1 + beyond)]
    found: dict[tuple[int, ...], list[float]] = {}
    for middle in (borders[:-1] + borders[1:]) / 2:
        cycles = frequencies * middle
        low = np.floor(cycles - margin).astype(int)
        high = np.floor(cycles + margin).astype(int)
        for chosen in product(*(range(a, b + 1) for a, b in zip(low, high, strict=True))):
            found.setdefault(chosen, []).append(float(middle))
    lines = np.array(list(found), dtype=np.int64)
    places = np.array([(min(seen) + max(seen)) / 2 for seen in found.values()])
    return lines, places


def _orthogonal_basis(frequencies: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "k d"]:
    """Span the space orthogonal to the frequency vector by orthonormal columns."""
    _, _, rows = np.linalg.svd(frequencies[np.newaxis, :])
    return np.ascontiguousarray(rows[1:].T)


def _without_repeats(
    points: Float64[np.ndarray, "n d"],
    lines: Int64[np.ndarray, "n k"],
    places: Float64[np.ndarray, "n"],
) -> tuple[Float64[np.ndarray, "m d"], Int64[np.ndarray, "m k"], Float64[np.ndarray, "m"]]:
    """Keep one of the lines that are one point: they are whole ranges apart, which the kernel folds."""
    from scipy.spatial import cKDTree

    repeats = {later for _, later in cKDTree(points).query_pairs(10 * _SAME_CYCLES)}
    kept = np.array([index for index in range(len(points)) if index not in repeats])
    return points[kept], lines[kept], places[kept]


def _smallest_distance(points: Float64[np.ndarray, "n d"]) -> float:
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return float("inf")
    distances = np.asarray(cKDTree(points).query(points, k=2)[0])
    return float(distances[:, 1].min())


def _cells(
    basis: Float64[np.ndarray, "k d"],
) -> tuple[Float64[np.ndarray, "d"], Int64[np.ndarray, "d"], Float64[np.ndarray, "d"]]:
    """Divide the shadow of the unit cube of phases: low corner, cells and cell size by dimension."""
    low = np.minimum(basis, 0).sum(axis=0)
    extent = np.maximum(basis, 0).sum(axis=0) - low
    dimensions = basis.shape[1]
    cell_size = float((extent.prod() / _CELLS[dimensions]) ** (1 / dimensions))
    shape = np.maximum(np.ceil(extent / cell_size), 1).astype(np.int64)
    return low, shape, extent / shape


def cascade(periods: Sequence[float], *, fuse: bool = False) -> FringeOrders:
    r"""Prepare the heterodyne cascade: beats of beats give a coarse position, beats a finer one.

    Parameters
    ----------
    periods
        Two or three frequencies; for (70, 64, 59) the beats are 5, 6 and 1 period.
    fuse
        Take the position from all frequencies by least squares; otherwise from the highest alone,
        as the paper does.

    Raises
    ------
    FrequencyError
        If no beat has at most one period over the width.

    Notes
    -----
    The order at one stage is :math:`k = \mathrm{round}(f_h x_l - w_h)`. For (59, 64, 70) the decisive
    stage has the noise :math:`\sigma_D = 15.8 \sigma_\varphi`, so the cascade needs 1.34 times less
    noise than maximum likelihood for the same safety, and its position is 1.6 times noisier.

    References
    ----------
    .. [1] C. Reich, R. Ritter, J. Thesing, "White light heterodyne principle for 3D-measurement",
       Proceedings of SPIE 3100, 236 (1997), doi:10.1117/12.287750.
    """
    values = tuple(float(value) for value in periods)
    if len(values) not in (2, 3):
        raise FrequencyError(
            f"the cascade needs two or three frequencies, got {len(values)}: "
            "choose another way to find the fringe orders"
        )
    descending = np.argsort(values)[::-1]
    unit = np.eye(len(values))[descending]
    beats = [unit[0] - unit[1]]
    if len(values) == 3:
        beats.append(unit[1] - unit[2])
        beats.append(beats[0] - beats[1])
    frequencies = np.array(values)
    stages = [beat if beat @ frequencies > 0 else -beat for beat in beats]
    stages = [stage for stage in stages if stage @ frequencies > _SAME_CYCLES]
    stages.sort(key=lambda stage: float(stage @ frequencies))
    chain = [*_rising(stages, frequencies), unit[0]]
    return _chained("cascade", values, np.array(chain), fuse=fuse)


def _rising(
    stages: Sequence[Float64[np.ndarray, "k"]], frequencies: Float64[np.ndarray, "k"]
) -> list[Float64[np.ndarray, "k"]]:
    """Keep the coarsest beat and the finest, the paper's two: a middle one would only add noise."""
    distinct: list[Float64[np.ndarray, k]] = []
    for stage in stages:
        if not distinct or stage @ frequencies > distinct[-1] @ frequencies + _SAME_CYCLES:
            distinct.append(stage)
    return [distinct[0], distinct[-1]] if len(distinct) > 1 else distinct


def hierarchical(periods: Sequence[float], *, fuse: bool = True) -> FringeOrders:
    """Prepare unwrapping from the coarsest frequency to the finest, for example 1, 8, 64 periods.

    Parameters
    ----------
    periods
        At least one frequency; the lowest has at most one period over the width.
    fuse
        Take the position from all frequencies by least squares; otherwise from the highest alone.

    Raises
    ------
    FrequencyError
        If the lowest frequency has more than one period.

    References
    ----------
    .. [1] J. M. Huntley, H. O. Saldner, "Temporal phase-unwrapping algorithm for automated
       interferogram analysis", Applied Optics 32(17), 3047 (1993), doi:10.1364/AO.32.003047.
    """
    values = tuple(float(value) for value in periods)
    chain = np.eye(len(values))[np.argsort(values)]
    return _chained("hierarchical", values, chain, fuse=fuse)


def code_aided(periods: Sequence[float], *, codes: int, fuse: bool = True) -> FringeOrders:
    r"""Prepare unwrapping with a Gray code that gives the coarse position.

    Parameters
    ----------
    periods
        At least one frequency; the lowest is settled by the code, the others from coarse to fine.
    codes
        Codes over the width. As many as periods is the plain way, at whose borders a shifted edge
        makes an error of a whole period; twice as many (one more bit, a complementary code) leave
        a quarter of a period to each side.
    fuse
        Take the position from all frequencies by least squares; otherwise from the highest alone.

    Raises
    ------
    FrequencyError
        If there are fewer codes than periods of the lowest frequency.

    Notes
    -----
    A code c says :math:`x_c = (c + 1/2)/M \pm 1/(2M)`, so the order is
    :math:`k = \mathrm{round}(f x_c - w)` with :math:`1/2 - f/(2M)` of a period to spare. The residual
    holds by how much code and phase contradict each other beyond the code's own width.

    References
    ----------
    .. [1] Q. Zhang, X. Su, L. Xiang, X. Sun, "3-D shape measurement based on complementary Gray-code
       light", Optics and Lasers in Engineering 50(4), 574 (2012),
       doi:10.1016/j.optlaseng.2011.06.024.
    """
    values = tuple(float(value) for value in periods)
    lowest = min(values, default=0.0)
    if codes < lowest - 1e-9 or not values:
        raise FrequencyError(
            f"{codes} codes can't settle {lowest:g} periods: give at least as many codes as periods, better twice as many"
        )
    chain = np.eye(len(values))[np.argsort(values)]
    return _chained("code_aided", values, chain, fuse=fuse, half_code=0.5 / codes)


def _chained(
    strategy: str,
    periods: tuple[float, ...],
    chain: Float64[np.ndarray, "s k"],
    *,
    fuse: bool,
    half_code: float | None = None,
) -> FringeOrders:
    """Put a chain of virtual frequencies, coarse to fine, into tables."""
    frequencies = np.array(periods)
    chain_periods = chain @ frequencies
    coarsest = float(chain_periods[0])
    if half_code is None and coarsest > 1 + 1e-9:
        raise FrequencyError(
            f"fringes of {_listed(periods)} periods leave {coarsest:g} periods at the coarsest step of "
            f"the {strategy} way, which repeat after {1 / coarsest:.4g} of the width: "
            "add a frequency so that it has at most one period, or a Gray code"
        )
    range_widths = 1 / coarsest if half_code is None else float("inf")
    distance_cycles = 2 * _half_distance(chain, chain_periods, half_code)
    tables = Orders(
        mode=CHAIN if half_code is None else CODE,
        periods=frequencies.astype(np.float32),
        fuse=fuse,
        range_widths=range_widths if np.isfinite(range_widths) else 0.0,
        combinations=np.ascontiguousarray(chain.astype(np.float32)),
        chain_periods=chain_periods.astype(np.float32),
        half_code=half_code or 0.0,
        projection=np.zeros((0, 0), np.float32),
        origin=np.zeros(0, np.float32),
        shape=np.zeros(0, np.int64),
        nearest=np.zeros(0, np.float32),
        second=np.zeros(0, np.float32),
    )
    return FringeOrders(
        strategy=strategy,
        periods=periods,
        range_widths=range_widths,
        distance_cycles=distance_cycles,
        default_residual_cycles=DEFAULT_RESIDUAL_SHARE * distance_cycles / 2,
        tables=tables,
    )


def _half_distance(
    chain: Float64[np.ndarray, "s k"],
    chain_periods: Float64[np.ndarray, "s"],
    half_code: float | None,
) -> float:
    """Smallest phase error, as a vector in cycles, that makes some stage choose the wrong order."""
    halves = []
    if half_code is not None:
        # One frequency on its own has no contradiction between phases; what the code leaves decides.
        halves.append(max(0.5 - half_code * chain_periods[0], 0.25))
    for coarse, fine in zip(range(len(chain) - 1), range(1, len(chain)), strict=True):
        decision = chain[coarse] * chain_periods[fine] / chain_periods[coarse] - chain[fine]
        halves.append(0.5 / float(np.linalg.norm(decision)))
    return min(halves, default=0.5)


def stage_noise_gain(orders: FringeOrders) -> float:
    """Largest noise of a decision of a chain over the noise of a phase, 15.81 for (59, 64, 70).

    Examples
    --------
    >>> round(stage_noise_gain(cascade([59, 64, 70])), 2)
    15.81
    """
    chain = orders.tables.combinations.astype(np.float64)
    periods = orders.tables.chain_periods.astype(np.float64)
    gains = [
        float(np.linalg.norm(chain[i] * periods[i + 1] / periods[i] - chain[i + 1]))
        for i in range(len(chain) - 1)
    ]
    return max(gains, default=0.0)


def _listed(periods: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in periods)
