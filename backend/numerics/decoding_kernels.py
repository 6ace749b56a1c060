"""Compiled kernels of fringe decoding: frames to phasors, phasors to a projector coordinate.

Everything is done in tiles of two thousand pixels whose intermediate rows stay in the processor's
cache: no intermediate result ever has the size of a picture. Each row loop is a plain
loop over few rows, because that is what LLVM turns into vector instructions.

The wrappers are in `phasors`, `fringe_orders` and `absolute_phase`, where the models are described.
One file, because the compiled cache notices changes in a kernel's own file only.
"""

from typing import Any, NamedTuple

import numba
import numpy as np

from backend.numerics.kernels import frame_part, kernel, row_loop
from backend.numerics.reasons import Reason

# A row is always cut as rows[k, a:b] from a contiguous array. Cutting rows[:, a:b] first and a row
# of that later gives numba a row of unknown stride, and the loops over it run scalar.

TILE = 2048
"""Pixels per tile; some 30 rows of them stay in the second-level cache."""

BLOCK = 8 * TILE
"""Pixels per task of a thread; its rows are allocated once per task."""

# Numbers in a kernel have to be float32 one by one: a Python float makes the whole loop float64.
_0 = np.float32(0.0)
_QUARTER = np.float32(0.25)
_HALF = np.float32(0.5)
_1 = np.float32(1.0)
_TINY = np.float32(1e-30)
_NAN = np.float32(np.nan)

# arctan(t) / (2 pi) = t P(t^2) on [0, 1], fitted for the smallest worst error (3.8e-8 rad before
# rounding to float32).
_P0 = np.float32(0.15915483236312866)
_P1 = np.float32(-0.05304612219333649)
_P2 = np.float32(0.031745944172143936)
_P3 = np.float32(-0.022136269137263298)
_P4 = np.float32(0.01534602977335453)
_P5 = np.float32(-0.008898718282580376)
_P6 = np.float32(0.0034795941319316626)
_P7 = np.float32(-0.000645303342025727)

_SATURATED = np.int32(Reason.SATURATED)
_DARK = np.int32(Reason.DARK)
_LOW_MODULATION = np.int32(Reason.LOW_MODULATION)
_ORDER_RESIDUAL = np.int32(Reason.ORDER_RESIDUAL)
_GUARD_BAND = np.int32(Reason.GUARD_BAND)
_OUTSIDE = np.int32(Reason.OUTSIDE_PROJECTOR)
_MISSING = np.int32(Reason.MISSING_DATA)
_NONE = np.int32(0)

NO_EXPOSURE = 255
"""Index of a pixel that no exposure serves."""

LATTICE, CHAIN, CODE = 0, 1, 2
"""How fringe orders are found: look-up, from coarse to fine, from a code to fine."""

BY_INDEX, BY_LENGTH, BY_VARIANCE = 0, 1, 2
"""How exposures are chosen: a given index, the longest unsaturated one, all by inverse variance."""


class Steps(NamedTuple):
    """Where each frequency's frames are, and their weights."""

    first_frame: Any  # int64[k + 1]: frames of frequency i are first_frame[i] .. first_frame[i + 1]
    weights: Any  # float32[3, n]: cosine, sine, mean


class Orders(NamedTuple):
    """How to get from the phases of one pixel to its position; `fringe_orders` fills it."""

    mode: int
    periods: Any  # float32[k]
    fuse: (
        bool  # position from all frequencies by least squares; otherwise from the last of the chain
    )
    range_widths: float  # position repeats after this many widths of the code; 0: never
    combinations: Any  # float32[s, k]: chain's virtual frequencies as sums of the phases
    chain_periods: Any  # float32[s]
    half_code: float  # half the width of a code, in the code's whole width
    projection: Any  # float32[d, k]: phases in cycles -> cells of the table
    origin: Any  # float32[d]
    shape: Any  # int64[d]
    nearest: Any  # float32[cells]: position minus the phases' part, of the nearest lattice point
    second: Any  # float32[cells]: of the second nearest


class Limits(NamedTuple):
    """Which pixels are accepted, and the projector's size."""

    min_modulation_gray: float
    max_residual_cycles: float
    guard_band: float
    size_px: float
    black_gray: float


class Noise(NamedTuple):
    """Variance of a gray level: read_variance + per_gray (gray - black)."""

    variance_gray2: float
    per_gray: float
    black_gray: float


@row_loop
def _fill(row, value):
    for i in range(row.size):
        row[i] = value


@row_loop
def _add_frame(frame, weight_cosine, weight_sine, weight_mean, cosine, sine, mean):
    for i in range(frame.size):
        gray = np.float32(frame[i])
        cosine[i] += weight_cosine * gray
        sine[i] += weight_sine * gray
        mean[i] += weight_mean * gray


@row_loop
def _add_four(frame_0, frame_1, frame_2, frame_3, weights, first, cosine, sine, mean):
    c0, c1, c2, c3 = (
        weights[0, first],
        weights[0, first + 1],
        weights[0, first + 2],
        weights[0, first + 3],
    )
    s0, s1, s2, s3 = (
        weights[1, first],
        weights[1, first + 1],
        weights[1, first + 2],
        weights[1, first + 3],
    )
    m0, m1, m2, m3 = (
        weights[2, first],
        weights[2, first + 1],
        weights[2, first + 2],
        weights[2, first + 3],
    )
    for i in range(frame_0.size):
        g0, g1 = np.float32(frame_0[i]), np.float32(frame_1[i])
        g2, g3 = np.float32(frame_2[i]), np.float32(frame_3[i])
        cosine[i] += c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3
        sine[i] += s0 * g0 + s1 * g1 + s2 * g2 + s3 * g3
        mean[i] += m0 * g0 + m1 * g1 + m2 * g2 + m3 * g3


@row_loop
def _keep_peak(frame, peak):
    for i in range(frame.size):
        gray = frame[i]
        old = peak[i]
        peak[i] = gray if gray > old else old


@row_loop
def _keep_peak_of_four(frame_0, frame_1, frame_2, frame_3, peak):
    for i in range(frame_0.size):
        g0, g1, g2, g3 = frame_0[i], frame_1[i], frame_2[i], frame_3[i]
        a = g0 if g0 > g1 else g1
        b = g2 if g2 > g3 else g3
        c = a if a > b else b
        old = peak[i]
        peak[i] = c if c > old else old


@row_loop
def _count_saturated(frame, saturation, count):
    for i in range(frame.size):
        count[i] += np.uint16(1) if np.float32(frame[i]) >= saturation else np.uint16(0)


@row_loop
def _demodulate(addresses, sample, start, n, steps, cosine, sine, mean, peak):
    """Fit a sinusoid to each frequency of one tile; keep each pixel's brightest sample.

    Means are added to as many rows as `mean` has: one per frequency, or one for all.
    """
    _fill(peak, 0)
    weights = steps.weights
    for k in range(mean.shape[0]):
        _fill(mean[k, :n], _0)
    for k in range(cosine.shape[0]):
        cosine_k, sine_k, mean_k = cosine[k, :n], sine[k, :n], mean[k % mean.shape[0], :n]
        _fill(cosine_k, _0)
        _fill(sine_k, _0)
        frame, end = steps.first_frame[k], steps.first_frame[k + 1]
        while frame + 4 <= end:
            a = frame_part(addresses[frame], start, n, sample)
            b = frame_part(addresses[frame + 1], start, n, sample)
            c = frame_part(addresses[frame + 2], start, n, sample)
            d = frame_part(addresses[frame + 3], start, n, sample)
            _add_four(a, b, c, d, weights, frame, cosine_k, sine_k, mean_k)
            _keep_peak_of_four(a, b, c, d, peak)
            frame += 4
        while frame < end:
            a = frame_part(addresses[frame], start, n, sample)
            w_cosine, w_sine, w_mean = weights[0, frame], weights[1, frame], weights[2, frame]
            _add_frame(a, w_cosine, w_sine, w_mean, cosine_k, sine_k, mean_k)
            _keep_peak(a, peak)
            frame += 1


@row_loop
def _average(rows, first, average):
    """Average rows; with a loop per row, as a loop over rows inside one over pixels isn't vectorised."""
    _fill(average, _0)
    for k in range(rows.shape[0]):
        _add_scaled(rows[k, first : first + average.size], _1 / np.float32(rows.shape[0]), average)


@row_loop
def _add_scaled(row, factor, total):
    for i in range(total.size):
        total[i] += factor * row[i]


# ---- phasor -> phase and strength ----------------------------------------------------------------


@row_loop
def _to_cycles(cosine, sine, cycles, power):
    """Turn phasors into their phase in [0, 1] cycles and their squared length, in place if asked."""
    for i in range(cycles.size):
        c, s = cosine[i], sine[i]
        abs_c, abs_s = abs(c), abs(s)
        longer = abs_c if abs_c > abs_s else abs_s
        shorter = abs_s if abs_c > abs_s else abs_c
        t = shorter / (longer + _TINY)
        z = t * t
        even = _P4 + z * (_P5 + z * (_P6 + z * _P7))
        p = t * (_P0 + z * (_P1 + z * (_P2 + z * (_P3 + z * even))))
        p = _QUARTER - p if abs_s > abs_c else p
        p = _HALF - p if c < _0 else p
        cycles[i] = _1 - p if s < _0 else p
        power[i] = c * c + s * s


@row_loop
def _keep_smallest(power, smallest):
    for i in range(power.size):
        old = smallest[i]
        smallest[i] = power[i] if power[i] < old else old


@row_loop
def _add_inverse(power, factor, total):
    for i in range(power.size):
        total[i] += factor / (power[i] + _TINY)


# ---- phases -> position --------------------------------------------------------------------------


@row_loop
def _cell_of_three(w0, w1, w2, projection, origin, shape, base, factor, cell):
    """Look up two coordinates in the plane orthogonal to three frequencies; fast path of `_cell`."""
    a0, a1, a2, a3 = projection[0, 0], projection[0, 1], projection[0, 2], origin[0]
    b0, b1, b2, b3 = projection[1, 0], projection[1, 1], projection[1, 2], origin[1]
    f0, f1, f2 = factor[0], factor[1], factor[2]
    a_end, b_end = np.float32(shape[0] - 1), np.float32(shape[1] - 1)
    n_b = np.int32(shape[1])
    for i in range(cell.size):
        a = a0 * w0[i] + a1 * w1[i] + a2 * w2[i] + a3
        b = b0 * w0[i] + b1 * w1[i] + b2 * w2[i] + b3
        # Written so that NaN ends at 0: a wild index would read foreign memory.
        a = a if a > _0 else _0
        b = b if b > _0 else _0
        a = a if a < a_end else a_end
        b = b if b < b_end else b_end
        cell[i] = np.int32(a) * n_b + np.int32(b)
        base[i] = f0 * w0[i] + f1 * w1[i] + f2 * w2[i]


@row_loop
def _cell_along(coordinate, n_cells, cell):
    end = np.float32(n_cells - 1)
    for i in range(cell.size):
        a = coordinate[i]
        a = a if a > _0 else _0
        a = a if a < end else end
        cell[i] = cell[i] * np.int32(n_cells) + np.int32(a)


@row_loop
def _cell(cycles, n, orders, factor, scratch, base, cell):
    """Look up the table's cell of each pixel, and the phases' part of the position."""
    _fill(cell, 0)
    for d in range(orders.projection.shape[0]):
        _fill(scratch, orders.origin[d])
        for k in range(cycles.shape[0]):
            _add_scaled(cycles[k, :n], orders.projection[d, k], scratch)
        _cell_along(scratch, orders.shape[d], cell)
    _fill(base, _0)
    for k in range(cycles.shape[0]):
        _add_scaled(cycles[k, :n], factor[k], base)


@row_loop
def _gather(table, cell, values):
    for i in range(cell.size):
        values[i] = table[cell[i]]


@row_loop
def _nearer_of_three(w0, w1, w2, periods, base, offset, other_offset, position, misfit, second):
    """Compare two candidates; fast path of `_misfit` and `_keep_better`."""
    f0, f1, f2 = periods[0], periods[1], periods[2]
    for i in range(position.size):
        p0, p1, p2 = w0[i], w1[i], w2[i]
        x, y = base[i] + offset[i], base[i] + other_offset[i]
        d0, d1, d2 = f0 * x - p0, f1 * x - p1, f2 * x - p2
        e0, e1, e2 = f0 * y - p0, f1 * y - p1, f2 * y - p2
        d0, d1, d2 = d0 - np.rint(d0), d1 - np.rint(d1), d2 - np.rint(d2)
        e0, e1, e2 = e0 - np.rint(e0), e1 - np.rint(e1), e2 - np.rint(e2)
        d = d0 * d0 + d1 * d1 + d2 * d2
        e = e0 * e0 + e1 * e1 + e2 * e2
        first = d < e
        position[i] = x if first else y
        misfit[i] = d if first else e
        second[i] = e if first else d


@row_loop
def _add_misfit(cycles, periods, position, misfit, slope):
    for i in range(position.size):
        d = periods * position[i] - cycles[i]
        d = d - np.rint(d)
        misfit[i] += d * d
        slope[i] += periods * d


@row_loop
def _misfit(cycles, n, periods, position, scratch, misfit):
    """Sum the squared distances between phases and position, in cycles^2."""
    _fill(misfit, _0)
    _fill(scratch, _0)
    for k in range(cycles.shape[0]):
        _add_misfit(cycles[k, :n], periods[k], position, misfit, scratch)


@row_loop
def _keep_better(other_position, other_misfit, position, misfit, second):
    for i in range(position.size):
        worse = other_misfit[i] > misfit[i]
        second[i] = other_misfit[i] if worse else misfit[i]
        position[i] = position[i] if worse else other_position[i]
        misfit[i] = misfit[i] if worse else other_misfit[i]


@row_loop
def _locate_in_lattice(cycles, n, orders, factor, scratch, cell, position, misfit, second):
    """Find the likeliest fringe orders: of a cell's two nearest lattice points the nearer one."""
    base, offset, other_offset = scratch[0, :n], scratch[1, :n], scratch[2, :n]
    if cycles.shape[0] == 3:
        w0, w1, w2 = cycles[0, :n], cycles[1, :n], cycles[2, :n]
        _cell_of_three(
            w0, w1, w2, orders.projection, orders.origin, orders.shape, base, factor, cell
        )
        _gather(orders.nearest, cell, offset)
        _gather(orders.second, cell, other_offset)
        _nearer_of_three(
            w0, w1, w2, orders.periods, base, offset, other_offset, position, misfit, second
        )
    else:
        other_position, other_misfit = other_offset, scratch[3, :n]
        _cell(cycles, n, orders, factor, offset, base, cell)
        _gather(orders.nearest, cell, position)
        _gather(orders.second, cell, other_position)
        _add_row(base, position)
        _add_row(base, other_position)
        _misfit(cycles, n, orders.periods, position, offset, misfit)
        _misfit(cycles, n, orders.periods, other_position, offset, other_misfit)
        _keep_better(other_position, other_misfit, position, misfit, second)


@row_loop
def _add_row(row, total):
    for i in range(total.size):
        total[i] += row[i]


@row_loop
def _start_chain(phase, periods, position):
    for i in range(position.size):
        position[i] = (phase[i] - np.floor(phase[i])) / periods


@row_loop
def _next_in_chain(phase, periods, position):
    for i in range(position.size):
        order = np.rint(periods * position[i] - phase[i])
        position[i] = (phase[i] + order) / periods


@row_loop
def _second_from_code(phase, periods, half_code, position, second):
    """How far code and phase contradict each other, in squared cycles beyond what the code allows."""
    for i in range(position.size):
        d = periods * position[i] - phase[i]
        beyond = abs(d - np.rint(d)) - half_code * periods
        beyond = beyond if beyond > _0 else _0
        second[i] = beyond * beyond


@row_loop
def _from_coarse(coarse_px, size_px, position):
    for i in range(position.size):
        position[i] = (coarse_px[i] + _HALF) / size_px


@row_loop
def _fuse_frequencies(slope, inverse_square, fuse, position, misfit):
    """Move positions to the least-squares one (if asked); the misfit is that of the least squares."""
    for i in range(position.size):
        step = slope[i] * inverse_square
        misfit[i] -= slope[i] * step
        misfit[i] = misfit[i] if misfit[i] > _0 else _0
        position[i] -= step * fuse


@row_loop
def _locate_by_chain(cycles, n, orders, scratch, position, misfit, second):
    """Find fringe orders from coarse to fine: each virtual frequency settles the next one's order."""
    phase, slope = scratch[0, :n], scratch[1, :n]
    for stage in range(orders.chain_periods.size):
        _fill(phase, _0)
        for k in range(cycles.shape[0]):
            if orders.combinations[stage, k] != _0:
                _add_scaled(cycles[k, :n], orders.combinations[stage, k], phase)
        periods = orders.chain_periods[stage]
        if stage > 0:
            _next_in_chain(phase, periods, position)
        elif orders.mode == CODE:
            _second_from_code(phase, periods, np.float32(orders.half_code), position, second)
            _next_in_chain(phase, periods, position)
        else:
            _start_chain(phase, periods, position)
    _misfit(cycles, n, orders.periods, position, slope, misfit)
    square = _0
    for k in range(orders.periods.size):
        square += orders.periods[k] * orders.periods[k]
    fuse = _1 if orders.fuse else _0
    _fuse_frequencies(slope, _1 / square, fuse, position, misfit)
    if orders.mode == CODE:
        _add_row(second, misfit)
    # A chain knows no second-best candidate.
    _fill(second, _NAN)


# ---- position -> maps ----------------------------------------------------------------------------


@row_loop
def _fold(range_widths, position):
    """Bring positions of a code that repeats back to the range that holds [0, 1) in its middle."""
    low = (_1 - range_widths) * _HALF
    high = low + range_widths
    for i in range(position.size):
        x = position[i]
        x = x + range_widths if x < low else x
        position[i] = x - range_widths if x >= high else x


@row_loop
def _flag_saturated(peak, saturation, reasons):
    for i in range(reasons.size):
        reasons[i] |= _SATURATED if np.float32(peak[i]) >= saturation else _NONE


@row_loop
def _judge_light(mean, black, power, min_modulation, reasons):
    """Say which pixels are dark or of low contrast."""
    min_power = min_modulation * min_modulation
    for i in range(reasons.size):
        # Written with "not", so that NaN counts as weak.
        weak = not power[i] >= min_power
        dark = mean[i] - black < min_modulation
        reason = _DARK if dark else _LOW_MODULATION
        reasons[i] |= reason if weak else _NONE


@row_loop
def _judge_position(misfit, max_misfit, guard, position, reasons):
    """Say which positions are contradictory or near or over the code's ends.

    Nothing is said of pixels that already are invalid: their position is noise.
    """
    upper = _1 - guard
    for i in range(reasons.size):
        x = position[i]
        # Written with "not", so that NaN counts as contradictory.
        reason = _NONE if misfit[i] <= max_misfit else _ORDER_RESIDUAL
        edge = _GUARD_BAND if x < guard or x > upper else _NONE
        edge = _OUTSIDE if x < _0 or x >= _1 else edge
        reason = reason if reason != _NONE else edge
        reasons[i] = reasons[i] if reasons[i] != _NONE else reason


@row_loop
def _store_position(position, reasons, size_px, projector_px, reasons_out):
    for i in range(position.size):
        u = position[i] * size_px - _HALF
        projector_px[i] = u if reasons[i] == _NONE else _NAN
        reasons_out[i] = np.uint16(reasons[i])


@row_loop
def _store_roots(power, misfit, modulation, residual):
    for i in range(power.size):
        modulation[i] = np.sqrt(power[i])
        residual[i] = np.sqrt(misfit[i])


@row_loop
def _store_margin(misfit, second, margin):
    for i in range(misfit.size):
        margin[i] = np.sqrt(second[i]) - np.sqrt(misfit[i])


@row_loop
def _store_sigma(inverse, variance, reasons, sigma_px):
    for i in range(inverse.size):
        sigma_px[i] = np.sqrt(inverse[i] * variance[i]) if reasons[i] == _NONE else _NAN


@row_loop
def _predict_variance(mean, variance, per_gray, black, predicted):
    for i in range(mean.size):
        light = mean[i] - black
        light = light if light > _0 else _0
        predicted[i] = variance + per_gray * light


@row_loop
def _widen(row, wide):
    for i in range(row.size):
        wide[i] = np.int32(row[i])


@row_loop
def _flag_missing(coarse_px, reasons):
    for i in range(reasons.size):
        missing = not (coarse_px[i] == coarse_px[i])
        reasons[i] |= _MISSING if missing else _NONE


@row_loop
def _square_into(row, squares):
    for i in range(row.size):
        squares[i] = row[i] * row[i]


class Maps(NamedTuple):
    """Where results go, one value per pixel; a map of size 0 isn't wanted."""

    projector_px: Any  # float32[p]
    modulation_gray: Any  # float32[p]
    residual_cycles: Any  # float32[p]
    margin_cycles: Any  # float32[p] or [0]
    sigma_px: Any  # float32[p] or [0]
    reasons: Any  # uint16[p]


class Rows(NamedTuple):
    """One thread's intermediate rows."""

    cosine: Any  # float32[k, TILE]
    sine: Any
    mean: Any
    cycles: Any
    single: Any  # float32[12, TILE]
    cell: Any  # int32[TILE]
    reasons: Any  # int32[TILE]


@row_loop
def _rows(n_frequencies):
    shape = (n_frequencies, TILE)
    return Rows(
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty((12, TILE), np.float32),
        np.empty(TILE, np.int32),
        np.empty(TILE, np.int32),
    )


@row_loop
def _locate_tile(
    rows, cosine, sine, first, mean, variance, coarse_px, start, n, orders, scales, limits, maps
):
    """Turn one tile's phasors into maps; `rows.reasons` holds what is known already."""
    single = rows.single
    power, smallest, inverse = single[0, :n], single[1, :n], single[2, :n]
    position, misfit, second = single[3, :n], single[4, :n], single[5, :n]
    reasons, cell, scratch = rows.reasons[:n], rows.cell[:n], single[6:10]
    with_sigma = maps.sigma_px.size > 0
    _fill(smallest, np.float32(np.inf))
    _fill(inverse, _0)
    for k in range(cosine.shape[0]):
        _to_cycles(
            cosine[k, first : first + n], sine[k, first : first + n], rows.cycles[k, :n], power
        )
        _keep_smallest(power, smallest)
        if with_sigma and scales[1, k] > _0:
            _add_inverse(power, scales[1, k], inverse)
    _judge_light(
        mean,
        np.float32(limits.black_gray),
        smallest,
        np.float32(limits.min_modulation_gray),
        reasons,
    )
    if orders.mode == LATTICE:
        _locate_in_lattice(
            rows.cycles, n, orders, scales[0], scratch, cell, position, misfit, second
        )
    else:
        if orders.mode == CODE:
            coarse = coarse_px[start : start + n]
            _from_coarse(coarse, np.float32(limits.size_px), position)
            _flag_missing(coarse, reasons)
        _locate_by_chain(rows.cycles, n, orders, scratch, position, misfit, second)
    if orders.range_widths > 0:
        _fold(np.float32(orders.range_widths), position)
    max_residual = np.float32(limits.max_residual_cycles)
    guard = np.float32(limits.guard_band)
    _judge_position(misfit, max_residual * max_residual, guard, position, reasons)
    end = start + n
    _store_position(
        position,
        reasons,
        np.float32(limits.size_px),
        maps.projector_px[start:end],
        maps.reasons[start:end],
    )
    _store_roots(smallest, misfit, maps.modulation_gray[start:end], maps.residual_cycles[start:end])
    if maps.margin_cycles.size > 0:
        _store_margin(misfit, second, maps.margin_cycles[start:end])
    if with_sigma:
        _store_sigma(inverse, variance, reasons, maps.sigma_px[start:end])


@row_loop
def _decode_block(
    addresses,
    sample,
    n_px,
    block,
    steps,
    coarse_px,
    saturation,
    noise,
    orders,
    scales,
    limits,
    maps,
):
    rows = _rows(steps.first_frame.size - 1)
    peaks = np.empty(TILE, sample.dtype)
    for start in range(block, min(block + BLOCK, n_px), TILE):
        n = min(TILE, n_px - start)
        variance = rows.single[11, :n]
        # The sum of all frequencies' means; `decode_frames` gets weights that make it the average.
        means = rows.mean[:1]
        _demodulate(addresses, sample, start, n, steps, rows.cosine, rows.sine, means, peaks[:n])
        mean = means[0, :n]
        _fill(rows.reasons, _NONE)
        _flag_saturated(peaks[:n], np.float32(saturation), rows.reasons[:n])
        if maps.sigma_px.size > 0:
            _predict_variance(
                mean,
                np.float32(noise.variance_gray2),
                np.float32(noise.per_gray),
                np.float32(noise.black_gray),
                variance,
            )
        _locate_tile(
            rows,
            rows.cosine,
            rows.sine,
            0,
            mean,
            variance,
            coarse_px,
            start,
            n,
            orders,
            scales,
            limits,
            maps,
        )


@kernel
def decode_frames(
    addresses, sample, n_px, steps, coarse_px, saturation, noise, orders, scales, limits, maps
):
    """Decode the frames of one exposure into maps, see `absolute_phase.decode_frames`."""
    for block in numba.prange((n_px + BLOCK - 1) // BLOCK):
        _decode_block(
            addresses,
            sample,
            n_px,
            block * BLOCK,
            steps,
            coarse_px,
            saturation,
            noise,
            orders,
            scales,
            limits,
            maps,
        )


@row_loop
def _locate_block(
    cosine, sine, mean, sigma_gray, known_reasons, block, coarse_px, orders, scales, limits, maps
):
    n_px = known_reasons.size
    rows = _rows(cosine.shape[0])
    for start in range(block, min(block + BLOCK, n_px), TILE):
        n = min(TILE, n_px - start)
        end = start + n
        mean_row, variance = rows.single[10, :n], rows.single[11, :n]
        _average(mean, start, mean_row)
        _widen(known_reasons[start:end], rows.reasons[:n])
        if maps.sigma_px.size > 0:
            _square_into(sigma_gray[start:end], variance)
        _locate_tile(
            rows,
            cosine,
            sine,
            start,
            mean_row,
            variance,
            coarse_px,
            start,
            n,
            orders,
            scales,
            limits,
            maps,
        )


@kernel
def locate_phasors(
    cosine, sine, mean, sigma_gray, known_reasons, coarse_px, orders, scales, limits, maps
):
    """Turn phasors into maps, see `absolute_phase.absolute_phase`."""
    for block in numba.prange((known_reasons.size + BLOCK - 1) // BLOCK):
        _locate_block(
            cosine,
            sine,
            mean,
            sigma_gray,
            known_reasons,
            block * BLOCK,
            coarse_px,
            orders,
            scales,
            limits,
            maps,
        )


# ---- several exposures -> phasors ----------------------------------------------------------------


class Fused(NamedTuple):
    """Where fused phasors go."""

    cosine: Any  # float32[k, p]
    sine: Any  # float32[k, p]
    mean: Any  # float32[k, p]
    sigma_gray: Any  # float32[p]
    exposure_index: Any  # uint8[p]
    saturated_samples: Any  # uint16[p]
    reasons: Any  # uint16[p]


@row_loop
def _weigh(exposure_ms, exposure, usable, variance, weight, total, best, best_ms, index):
    """Add one exposure's weight t^2/sigma^2 where it counts; remember the weightiest exposure."""
    for i in range(total.size):
        share = exposure_ms * exposure_ms / variance[i]
        share = share if usable[i] != _NONE else _0
        weight[i] = share / exposure_ms
        total[i] += share
        better = share > best[i]
        best[i] = share if better else best[i]
        best_ms[i] = exposure_ms if better else best_ms[i]
        index[i] = exposure if better else index[i]


@row_loop
def _usable_unsaturated(peak, saturation, usable):
    for i in range(usable.size):
        usable[i] = np.int32(1) if np.float32(peak[i]) < saturation else _NONE


@row_loop
def _usable_first(index, usable):
    for i in range(usable.size):
        usable[i] = usable[i] if index[i] == np.int32(NO_EXPOSURE) else _NONE


@row_loop
def _usable_wanted(wanted, exposure, usable):
    for i in range(usable.size):
        usable[i] = np.int32(1) if np.int32(wanted[i]) == exposure else _NONE


@row_loop
def _flag_usable_saturated(peak, saturation, usable, reasons):
    for i in range(reasons.size):
        bad = usable[i] != _NONE and np.float32(peak[i]) >= saturation
        reasons[i] |= _SATURATED if bad else _NONE


@row_loop
def _add_weighted(row, offset, weight, total):
    for i in range(total.size):
        total[i] += weight[i] * (row[i] - offset)


@row_loop
def _scales_of(total, best_ms, scale):
    for i in range(total.size):
        scale[i] = best_ms[i] / total[i] if total[i] > _0 else _0


@row_loop
def _rescale(scale, offset, row):
    for i in range(row.size):
        row[i] = row[i] * scale[i] + offset


@row_loop
def _store_fused(total, best_ms, index, reasons, missing, sigma_gray, exposure_index, reasons_out):
    for i in range(total.size):
        served = index[i] != np.int32(NO_EXPOSURE)
        sigma_gray[i] = best_ms[i] / np.sqrt(total[i]) if served else _NAN
        exposure_index[i] = np.uint8(index[i])
        reasons_out[i] = np.uint16(reasons[i] if served else missing)


@row_loop
def _fuse_block(addresses, sample, n_px, block, steps, exposures, wanted, mode, saturation, fused):
    n_frequencies = steps.first_frame.size - 1
    n_frames = steps.first_frame[n_frequencies]
    rows = _rows(n_frequencies)
    peaks = np.empty(TILE, sample.dtype)
    index_row, usable_row = np.empty(TILE, np.int32), np.empty(TILE, np.int32)
    single = rows.single
    for start in range(block, min(block + BLOCK, n_px), TILE):
        n = min(TILE, n_px - start)
        end = start + n
        weight, total, best, best_ms = single[0, :n], single[1, :n], single[2, :n], single[3, :n]
        mean, variance, scale = single[4, :n], single[5, :n], single[6, :n]
        index, usable, reasons, peak = index_row[:n], usable_row[:n], rows.reasons[:n], peaks[:n]
        _fill(total, _0)
        _fill(best, _0)
        _fill(best_ms, _0)
        _fill(index, NO_EXPOSURE)
        _fill(reasons, _NONE)
        _fill(fused.saturated_samples[start:end], 0)
        for k in range(n_frequencies):
            _fill(fused.cosine[k, start:end], _0)
            _fill(fused.sine[k, start:end], _0)
            _fill(fused.mean[k, start:end], _0)
        for place in range(exposures.order.size):
            exposure = exposures.order[place]
            first = exposure * n_frames
            black = np.float32(exposures.black_gray)
            _demodulate(
                addresses[first : first + n_frames],
                sample,
                start,
                n,
                steps,
                rows.cosine,
                rows.sine,
                rows.mean,
                peak,
            )
            for frame in range(first, first + n_frames):
                _count_saturated(
                    frame_part(addresses[frame], start, n, sample),
                    np.float32(saturation),
                    fused.saturated_samples[start:end],
                )
            _average(rows.mean, 0, mean)
            _predict_variance(
                mean,
                exposures.variance_gray2[exposure],
                exposures.per_gray[exposure],
                black,
                variance,
            )
            if mode == BY_INDEX:
                _usable_wanted(wanted[start:end], np.int32(exposure), usable)
                _flag_usable_saturated(peak, np.float32(saturation), usable, reasons)
            else:
                _usable_unsaturated(peak, np.float32(saturation), usable)
            if mode == BY_LENGTH:
                _usable_first(index, usable)
            _weigh(
                exposures.exposure_ms[exposure],
                np.int32(exposure),
                usable,
                variance,
                weight,
                total,
                best,
                best_ms,
                index,
            )
            for k in range(n_frequencies):
                _add_weighted(rows.cosine[k, :n], _0, weight, fused.cosine[k, start:end])
                _add_weighted(rows.sine[k, :n], _0, weight, fused.sine[k, start:end])
                _add_weighted(rows.mean[k, :n], black, weight, fused.mean[k, start:end])
        _scales_of(total, best_ms, scale)
        for k in range(n_frequencies):
            _rescale(scale, _0, fused.cosine[k, start:end])
            _rescale(scale, _0, fused.sine[k, start:end])
            _rescale(scale, np.float32(exposures.black_gray), fused.mean[k, start:end])
        missing = _DARK if mode == BY_INDEX else _SATURATED
        _store_fused(
            total,
            best_ms,
            index,
            reasons,
            missing,
            fused.sigma_gray[start:end],
            fused.exposure_index[start:end],
            fused.reasons[start:end],
        )


class Exposures(NamedTuple):
    """The exposures of a fusion."""

    order: Any  # int64[e]: longest first
    exposure_ms: Any  # float32[e]
    variance_gray2: Any  # float32[e]
    per_gray: Any  # float32[e]
    black_gray: float


@kernel
def fuse_exposures(addresses, sample, n_px, steps, exposures, wanted, mode, saturation, fused):
    """Fuse the frames of several exposures into phasors, see `phasors.fuse_exposures`."""
    for block in numba.prange((n_px + BLOCK - 1) // BLOCK):
        _fuse_block(
            addresses,
            sample,
            n_px,
            block * BLOCK,
            steps,
            exposures,
            wanted,
            mode,
            saturation,
            fused,
        )


# ---- how well a sinusoid fits --------------------------------------------------------------------


@row_loop
def _add_square_misfit(frame, cosine_weight, sine_weight, cosine, sine, mean, total):
    for i in range(frame.size):
        d = np.float32(frame[i]) - (mean[i] + cosine_weight * cosine[i] - sine_weight * sine[i])
        total[i] += d * d


@row_loop
def _store_rms(total, inverse_freedom, rms):
    for i in range(total.size):
        rms[i] = np.sqrt(total[i] * inverse_freedom)


@row_loop
def _misfit_block(addresses, sample, n_px, block, steps, design, inverse_freedom, rms):
    rows = _rows(steps.first_frame.size - 1)
    peaks = np.empty(TILE, sample.dtype)
    total_row = rows.single[0]
    for start in range(block, min(block + BLOCK, n_px), TILE):
        n = min(TILE, n_px - start)
        total = total_row[:n]
        _demodulate(
            addresses, sample, start, n, steps, rows.cosine, rows.sine, rows.mean, peaks[:n]
        )
        _fill(total, _0)
        for k in range(steps.first_frame.size - 1):
            for frame in range(steps.first_frame[k], steps.first_frame[k + 1]):
                _add_square_misfit(
                    frame_part(addresses[frame], start, n, sample),
                    design[0, frame],
                    design[1, frame],
                    rows.cosine[k, :n],
                    rows.sine[k, :n],
                    rows.mean[k, :n],
                    total,
                )
        _store_rms(total, inverse_freedom, rms[start : start + n])


@kernel
def sinusoid_misfit(addresses, sample, n_px, steps, design, inverse_freedom, rms):
    """Measure the rms distance of the frames from the sinusoids, see `phasors.sinusoid_misfit`."""
    for block in numba.prange((n_px + BLOCK - 1) // BLOCK):
        _misfit_block(addresses, sample, n_px, block * BLOCK, steps, design, inverse_freedom, rms)
