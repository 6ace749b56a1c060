"""Row loops that turn phases into positions; compiled into the kernels, explained in `fringe_orders`."""

from typing import Any, NamedTuple

import numpy as np

from backend.numerics.kernels import row_loop
from backend.numerics.sinusoid_rows import HALF, NAN, ONE, ZERO, add_row, add_scaled, fill

LATTICE, CHAIN, CODE = 0, 1, 2
"""How fringe orders are found: look-up, from coarse to fine, from a code to fine."""


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


@row_loop
def _cell_of_three(
    w0: Any,
    w1: Any,
    w2: Any,
    projection: Any,
    origin: Any,
    shape: Any,
    base: Any,
    factor: Any,
    cell: Any,
) -> None:
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
        a = a if a > ZERO else ZERO
        b = b if b > ZERO else ZERO
        a = a if a < a_end else a_end
        b = b if b < b_end else b_end
        cell[i] = np.int32(a) * n_b + np.int32(b)
        base[i] = f0 * w0[i] + f1 * w1[i] + f2 * w2[i]


@row_loop
def _cell_along(coordinate: Any, n_cells: Any, cell: Any) -> None:
    end = np.float32(n_cells - 1)
    for i in range(cell.size):
        a = coordinate[i]
        a = a if a > ZERO else ZERO
        a = a if a < end else end
        cell[i] = cell[i] * np.int32(n_cells) + np.int32(a)


@row_loop
def _cell(
    cycles: Any, n: Any, orders: Any, factor: Any, scratch: Any, base: Any, cell: Any
) -> None:
    """Look up the table's cell of each pixel, and the phases' part of the position."""
    fill(cell, 0)
    for d in range(orders.projection.shape[0]):
        fill(scratch, orders.origin[d])
        for k in range(cycles.shape[0]):
            add_scaled(cycles[k, :n], orders.projection[d, k], scratch)
        _cell_along(scratch, orders.shape[d], cell)
    fill(base, ZERO)
    for k in range(cycles.shape[0]):
        add_scaled(cycles[k, :n], factor[k], base)


@row_loop
def _gather(table: Any, cell: Any, values: Any) -> None:
    for i in range(cell.size):
        values[i] = table[cell[i]]


@row_loop
def _nearer_of_three(
    w0: Any,
    w1: Any,
    w2: Any,
    periods: Any,
    base: Any,
    offset: Any,
    other_offset: Any,
    position: Any,
    misfit: Any,
    second: Any,
) -> None:
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
def _add_misfit(cycles: Any, periods: Any, position: Any, misfit: Any, slope: Any) -> None:
    for i in range(position.size):
        d = periods * position[i] - cycles[i]
        d = d - np.rint(d)
        misfit[i] += d * d
        slope[i] += periods * d


@row_loop
def _misfit(cycles: Any, n: Any, periods: Any, position: Any, scratch: Any, misfit: Any) -> None:
    """Sum the squared distances between phases and position, in cycles^2."""
    fill(misfit, ZERO)
    fill(scratch, ZERO)
    for k in range(cycles.shape[0]):
        _add_misfit(cycles[k, :n], periods[k], position, misfit, scratch)


@row_loop
def _keep_better(
    other_position: Any, other_misfit: Any, position: Any, misfit: Any, second: Any
) -> None:
    for i in range(position.size):
        worse = other_misfit[i] > misfit[i]
        second[i] = other_misfit[i] if worse else misfit[i]
        position[i] = position[i] if worse else other_position[i]
        misfit[i] = misfit[i] if worse else other_misfit[i]


@row_loop
def locate_in_lattice(
    cycles: Any,
    n: Any,
    orders: Any,
    factor: Any,
    scratch: Any,
    cell: Any,
    position: Any,
    misfit: Any,
    second: Any,
) -> None:
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
        add_row(base, position)
        add_row(base, other_position)
        _misfit(cycles, n, orders.periods, position, offset, misfit)
        _misfit(cycles, n, orders.periods, other_position, offset, other_misfit)
        _keep_better(other_position, other_misfit, position, misfit, second)


@row_loop
def _start_chain(phase: Any, periods: Any, position: Any) -> None:
    for i in range(position.size):
        position[i] = (phase[i] - np.floor(phase[i])) / periods


@row_loop
def _next_in_chain(phase: Any, periods: Any, position: Any) -> None:
    for i in range(position.size):
        order = np.rint(periods * position[i] - phase[i])
        position[i] = (phase[i] + order) / periods


@row_loop
def _second_from_code(phase: Any, periods: Any, half_code: Any, position: Any, second: Any) -> None:
    """How far code and phase contradict each other, in squared cycles beyond what the code allows."""
    for i in range(position.size):
        d = periods * position[i] - phase[i]
        beyond = abs(d - np.rint(d)) - half_code * periods
        beyond = beyond if beyond > ZERO else ZERO
        second[i] = beyond * beyond


@row_loop
def from_coarse(coarse_px: Any, size_px: Any, position: Any) -> None:
    """Start at the position that a Gray code gave."""
    for i in range(position.size):
        position[i] = (coarse_px[i] + HALF) / size_px


@row_loop
def _fuse_frequencies(
    slope: Any, inverse_square: Any, fuse: Any, position: Any, misfit: Any
) -> None:
    """Move positions to the least-squares one (if asked); the misfit is that of the least squares."""
    for i in range(position.size):
        step = slope[i] * inverse_square
        misfit[i] -= slope[i] * step
        misfit[i] = misfit[i] if misfit[i] > ZERO else ZERO
        position[i] -= step * fuse


@row_loop
def locate_by_chain(
    cycles: Any, n: Any, orders: Any, scratch: Any, position: Any, misfit: Any, second: Any
) -> None:
    """Find fringe orders from coarse to fine: each virtual frequency settles the next one's order."""
    phase, slope = scratch[0, :n], scratch[1, :n]
    for stage in range(orders.chain_periods.size):
        fill(phase, ZERO)
        for k in range(cycles.shape[0]):
            if orders.combinations[stage, k] != ZERO:
                add_scaled(cycles[k, :n], orders.combinations[stage, k], phase)
        periods = orders.chain_periods[stage]
        if stage > 0:
            _next_in_chain(phase, periods, position)
        elif orders.mode == CODE:
            _second_from_code(phase, periods, np.float32(orders.half_code), position, second)
            _next_in_chain(phase, periods, position)
        else:
            _start_chain(phase, periods, position)
    _misfit(cycles, n, orders.periods, position, slope, misfit)
    square = ZERO
    for k in range(orders.periods.size):
        square += orders.periods[k] * orders.periods[k]
    fuse = ONE if orders.fuse else ZERO
    _fuse_frequencies(slope, ONE / square, fuse, position, misfit)
    if orders.mode == CODE:
        add_row(second, misfit)
    # A chain knows no second-best candidate.
    fill(second, NAN)


@row_loop
def fold(range_widths: Any, position: Any) -> None:
    """Bring positions of a code that repeats back to the range that holds [0, 1) in its middle."""
    low = (ONE - range_widths) * HALF
    high = low + range_widths
    for i in range(position.size):
        x = position[i]
        x = x + range_widths if x < low else x
        position[i] = x - range_widths if x >= high else x
