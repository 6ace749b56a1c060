"""Compiled kernels from frames, or from phasors, to a projector coordinate; see `absolute_phase`.

Everything is done in tiles of two thousand pixels whose intermediate rows stay in the processor's
cache: no intermediate result ever has the size of a picture. Each row loop is a plain loop over few
rows, because that is what LLVM turns into vector instructions.
"""

from typing import Any, NamedTuple

import numba
import numpy as np

from backend.numerics.kernels import kernel, row_loop, take_next
from backend.numerics.order_rows import (
    CODE,
    LATTICE,
    fold,
    from_coarse,
    locate_by_chain,
    locate_in_lattice,
)
from backend.numerics.reasons import Reason
from backend.numerics.sinusoid_rows import (
    HALF,
    NAN,
    ONE,
    TILE,
    ZERO,
    add_inverse,
    demodulate,
    fill,
    keep_smallest,
    new_rows,
    predict_variance,
    square_into,
    to_cycles,
    widen,
)

_SATURATED = np.int32(Reason.SATURATED)
_DARK = np.int32(Reason.DARK)
_LOW_MODULATION = np.int32(Reason.LOW_MODULATION)
_ORDER_RESIDUAL = np.int32(Reason.ORDER_RESIDUAL)
_GUARD_BAND = np.int32(Reason.GUARD_BAND)
_OUTSIDE = np.int32(Reason.OUTSIDE_PROJECTOR)
_MISSING = np.int32(Reason.MISSING_DATA)
VALID = np.int32(0)


class Limits(NamedTuple):
    """Which pixels are accepted, and the projector's size."""

    min_modulation_gray: float
    max_residual_cycles: float
    guard_band: float
    size_px: float
    black_gray: float
    finest: int
    """Number of the highest frequency."""


class Noise(NamedTuple):
    """Variance of a gray level: read_variance + per_gray (gray - black)."""

    variance_gray2: float
    per_gray: float
    black_gray: float


@row_loop
def _flag_saturated(peak: Any, saturation: Any, reasons: Any) -> None:
    for i in range(reasons.size):
        reasons[i] |= _SATURATED if np.float32(peak[i]) >= saturation else VALID


@row_loop
def _judge_light(mean: Any, black: Any, power: Any, min_modulation: Any, reasons: Any) -> None:
    """Say which pixels are dark or of low contrast."""
    min_power = min_modulation * min_modulation
    for i in range(reasons.size):
        # Written with "not", so that NaN counts as weak.
        weak = not power[i] >= min_power
        dark = mean[i] - black < min_modulation
        reason = _DARK if dark else _LOW_MODULATION
        reasons[i] |= reason if weak else VALID


@row_loop
def _judge_position(misfit: Any, max_misfit: Any, guard: Any, position: Any, reasons: Any) -> None:
    """Say which positions are contradictory or near or over the code's ends.

    Nothing is said of pixels that already are invalid: their position is noise.
    """
    upper = ONE - guard
    for i in range(reasons.size):
        x = position[i]
        # Written with "not", so that NaN counts as contradictory.
        reason = VALID if misfit[i] <= max_misfit else _ORDER_RESIDUAL
        edge = _GUARD_BAND if x < guard or x > upper else VALID
        edge = _OUTSIDE if x < ZERO or x >= ONE else edge
        reason = reason if reason != VALID else edge
        reasons[i] = reasons[i] if reasons[i] != VALID else reason


@row_loop
def _store_position(
    position: Any, reasons: Any, size_px: Any, projector_px: Any, reasons_out: Any
) -> None:
    for i in range(position.size):
        u = position[i] * size_px - HALF
        projector_px[i] = u if reasons[i] == VALID else NAN
        reasons_out[i] = np.uint16(reasons[i])


@row_loop
def _store_roots(power: Any, misfit: Any, modulation: Any, residual: Any) -> None:
    for i in range(power.size):
        modulation[i] = np.sqrt(power[i])
        residual[i] = np.sqrt(misfit[i])


@row_loop
def _store_margin(misfit: Any, second: Any, margin: Any) -> None:
    for i in range(misfit.size):
        margin[i] = np.sqrt(second[i]) - np.sqrt(misfit[i])


@row_loop
def _store_sigma(inverse: Any, variance: Any, reasons: Any, sigma_px: Any) -> None:
    for i in range(inverse.size):
        sigma_px[i] = np.sqrt(inverse[i] * variance[i]) if reasons[i] == VALID else NAN


@row_loop
def _flag_missing(coarse_px: Any, reasons: Any) -> None:
    for i in range(reasons.size):
        missing = not (coarse_px[i] == coarse_px[i])
        reasons[i] |= _MISSING if missing else VALID


class Maps(NamedTuple):
    """Where results go, one value per pixel; a map of size 0 isn't wanted."""

    projector_px: Any  # float32[p]
    modulation_gray: Any  # float32[p]
    residual_cycles: Any  # float32[p]
    margin_cycles: Any  # float32[p] or [0]
    sigma_px: Any  # float32[p] or [0]
    wrapped_rad: Any  # float32[p] or [0]
    reasons: Any  # uint16[p]


class Planes(NamedTuple):
    """Phasors, as `fusion_kernels.Fused` leaves them."""

    cosine: Any  # int16[k, p]
    sine: Any  # int16[k, p]
    light: Any  # float32[p]
    sigma_gray: Any  # float32[p]
    exposure_index: Any  # uint8[p]
    reasons: Any  # uint16[p]
    exposure_ms: Any  # float32[256]
    step_gray: float


@row_loop
def _to_gray(steps: Any, step_gray: Any, gray: Any) -> None:
    for i in range(gray.size):
        gray[i] = np.float32(steps[i]) * step_gray


@row_loop
def _mean_of(light: Any, index: Any, exposure_ms: Any, mean: Any) -> None:
    """Mean above black in the gray levels of the exposure used."""
    for i in range(mean.size):
        mean[i] = light[i] * exposure_ms[index[i]]


_TURN = np.float32(2 * np.pi)


@row_loop
def _store_wrapped(cycles: Any, reasons: Any, wrapped: Any) -> None:
    for i in range(wrapped.size):
        turn = cycles[i] - ONE if cycles[i] > HALF else cycles[i]
        wrapped[i] = turn * _TURN if reasons[i] == VALID else NAN


@row_loop
def _locate_tile(
    rows: Any,
    mean: Any,
    variance: Any,
    coarse_px: Any,
    start: Any,
    n: Any,
    orders: Any,
    scales: Any,
    limits: Any,
    maps: Any,
) -> None:
    """Turn one tile's phasors into maps; `rows.reasons` holds what is known already."""
    single = rows.single
    power, smallest, inverse = single[0, :n], single[1, :n], single[2, :n]
    position, misfit, second = single[3, :n], single[4, :n], single[5, :n]
    reasons, cell, scratch = rows.reasons[:n], rows.cell[:n], single[6:10]
    with_sigma = maps.sigma_px.size > 0
    fill(smallest, np.float32(np.inf))
    fill(inverse, ZERO)
    for k in range(rows.cosine.shape[0]):
        to_cycles(rows.cosine[k, :n], rows.sine[k, :n], rows.cycles[k, :n], power)
        keep_smallest(power, smallest)
        if with_sigma and scales[1, k] > ZERO:
            add_inverse(power, scales[1, k], inverse)
    if maps.wrapped_rad.size > 0:
        _store_wrapped(rows.cycles[limits.finest, :n], reasons, maps.wrapped_rad[start : start + n])
    _judge_light(
        mean,
        np.float32(limits.black_gray),
        smallest,
        np.float32(limits.min_modulation_gray),
        reasons,
    )
    if orders.mode == LATTICE:
        locate_in_lattice(
            rows.cycles, n, orders, scales[0], scratch, cell, position, misfit, second
        )
    else:
        if orders.mode == CODE:
            coarse = coarse_px[start : start + n]
            from_coarse(coarse, np.float32(limits.size_px), position)
            _flag_missing(coarse, reasons)
        locate_by_chain(rows.cycles, n, orders, scratch, position, misfit, second)
    if orders.range_widths > 0:
        fold(np.float32(orders.range_widths), position)
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
def _decode_share(
    counter: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    steps: Any,
    coarse_px: Any,
    saturation: Any,
    noise: Any,
    orders: Any,
    scales: Any,
    limits: Any,
    maps: Any,
) -> None:
    rows = new_rows(steps.first_frame.size - 1)
    peaks = np.empty(TILE, np.uint16)
    start = TILE * take_next(counter)
    while start < n_px:
        n = min(TILE, n_px - start)
        variance = rows.single[11, :n]
        # The sum of all frequencies' means; `decode_frames` gets weights that make it the average.
        means = rows.mean[:1]
        demodulate(addresses, wide, start, n, steps, rows.cosine, rows.sine, means, peaks[:n])
        mean = means[0, :n]
        fill(rows.reasons, VALID)
        _flag_saturated(peaks[:n], np.float32(saturation), rows.reasons[:n])
        if maps.sigma_px.size > 0:
            predict_variance(
                mean,
                np.float32(noise.variance_gray2),
                np.float32(noise.per_gray),
                np.float32(noise.black_gray),
                variance,
            )
        _locate_tile(
            rows,
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
        start = TILE * take_next(counter)


@kernel
def decode_frames(
    work: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    steps: Any,
    coarse_px: Any,
    saturation: Any,
    noise: Any,
    orders: Any,
    scales: Any,
    limits: Any,
    maps: Any,
) -> None:
    """Decode the frames of one exposure into maps, see `absolute_phase.decode_frames`."""
    for _ in numba.prange(work.n_threads):
        _decode_share(
            work.counter,
            addresses,
            wide,
            n_px,
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
def _locate_share(
    counter: Any, planes: Any, coarse_px: Any, orders: Any, scales: Any, limits: Any, maps: Any
) -> None:
    n_px = planes.reasons.size
    rows = new_rows(planes.cosine.shape[0])
    step_gray = np.float32(planes.step_gray)
    start = TILE * take_next(counter)
    while start < n_px:
        n = min(TILE, n_px - start)
        end = start + n
        mean, variance = rows.single[10, :n], rows.single[11, :n]
        for k in range(planes.cosine.shape[0]):
            _to_gray(planes.cosine[k, start:end], step_gray, rows.cosine[k, :n])
            _to_gray(planes.sine[k, start:end], step_gray, rows.sine[k, :n])
        _mean_of(
            planes.light[start:end], planes.exposure_index[start:end], planes.exposure_ms, mean
        )
        widen(planes.reasons[start:end], rows.reasons[:n])
        if maps.sigma_px.size > 0:
            square_into(planes.sigma_gray[start:end], variance)
        _locate_tile(rows, mean, variance, coarse_px, start, n, orders, scales, limits, maps)
        start = TILE * take_next(counter)


@kernel
def locate_phasors(
    work: Any, planes: Any, coarse_px: Any, orders: Any, scales: Any, limits: Any, maps: Any
) -> None:
    """Turn phasors into maps, see `absolute_phase.absolute_phase`."""
    for _ in numba.prange(work.n_threads):
        _locate_share(work.counter, planes, coarse_px, orders, scales, limits, maps)
