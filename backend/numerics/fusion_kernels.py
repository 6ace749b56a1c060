"""Compiled kernels from the frames of several exposures to phasors; see `phasors`."""

from typing import Any, NamedTuple

import numba
import numpy as np

from backend.numerics.kernels import kernel, narrow_part, row_loop, take_next, wide_part
from backend.numerics.reasons import Reason
from backend.numerics.sinusoid_rows import (
    NAN,
    ONE,
    TILE,
    ZERO,
    demodulate,
    fill,
    new_rows,
    predict_variance,
)

_SATURATED = np.int32(Reason.SATURATED)
_DARK = np.int32(Reason.DARK)
VALID = np.int32(0)

NO_EXPOSURE = 255
"""Index of a pixel that no exposure serves."""

BY_INDEX, BY_LENGTH, BY_VARIANCE = 0, 1, 2
"""How exposures are chosen: a given index, the longest unsaturated one, all by inverse variance."""


class Fused(NamedTuple):
    """Where fused phasors go."""

    cosine: Any  # int16[k, p]
    sine: Any  # int16[k, p]
    light: Any  # float32[p]
    sigma_gray: Any  # float32[p]
    exposure_index: Any  # uint8[p]
    reasons: Any  # uint16[p]


class Exposures(NamedTuple):
    """The exposures of a fusion."""

    order: Any  # int64[e]: longest first
    exposure_ms: Any  # float32[e]
    variance_gray2: Any  # float32[e]
    per_gray: Any  # float32[e]
    black_gray: float
    steps_per_gray: float


@row_loop
def _weigh(
    exposure_ms: Any,
    exposure: Any,
    usable: Any,
    variance: Any,
    weight: Any,
    total: Any,
    best: Any,
    best_ms: Any,
    index: Any,
) -> None:
    """Add one exposure's weight t^2/sigma^2 where it counts; remember the weightiest exposure."""
    for i in range(total.size):
        share = exposure_ms * exposure_ms / variance[i]
        share = share if usable[i] != VALID else ZERO
        weight[i] = share / exposure_ms
        total[i] += share
        better = share > best[i]
        best[i] = share if better else best[i]
        best_ms[i] = exposure_ms if better else best_ms[i]
        index[i] = exposure if better else index[i]


@row_loop
def _usable_unsaturated(peak: Any, saturation: Any, usable: Any) -> None:
    for i in range(usable.size):
        usable[i] = np.int32(1) if np.float32(peak[i]) < saturation else VALID


@row_loop
def _usable_first(index: Any, usable: Any) -> None:
    for i in range(usable.size):
        usable[i] = usable[i] if index[i] == np.int32(NO_EXPOSURE) else VALID


@row_loop
def _usable_wanted(wanted: Any, exposure: Any, usable: Any) -> None:
    for i in range(usable.size):
        usable[i] = np.int32(1) if np.int32(wanted[i]) == exposure else VALID


@row_loop
def _flag_usable_saturated(peak: Any, saturation: Any, usable: Any, reasons: Any) -> None:
    for i in range(reasons.size):
        bad = usable[i] != VALID and np.float32(peak[i]) >= saturation
        reasons[i] |= _SATURATED if bad else VALID


@row_loop
def _add_weighted(row: Any, offset: Any, weight: Any, total: Any) -> None:
    for i in range(total.size):
        total[i] += weight[i] * (row[i] - offset)


@row_loop
def _scales_of(total: Any, best_ms: Any, scale: Any) -> None:
    for i in range(total.size):
        scale[i] = best_ms[i] / total[i] if total[i] > ZERO else ZERO


@row_loop
def _scales_of_one(total: Any, scale: Any) -> None:
    for i in range(total.size):
        scale[i] = ONE if total[i] > ZERO else ZERO


_MOST = np.float32(32767)


@row_loop
def _store_steps(row: Any, scale: Any, per_gray: Any, steps: Any) -> None:
    """Round gray levels to whole steps; what is beyond the range stays at its end."""
    for i in range(row.size):
        value = np.rint(row[i] * scale[i] * per_gray)
        value = value if value < _MOST else _MOST
        value = value if value > -_MOST else -_MOST
        steps[i] = np.int16(np.int32(value))


@row_loop
def _store_light(row: Any, offset: Any, scale: Any, best_ms: Any, light: Any) -> None:
    for i in range(row.size):
        value = (row[i] - offset) * scale[i] / best_ms[i]
        light[i] = value if value > ZERO else ZERO  # also where no exposure serves


@row_loop
def _store_fused(
    total: Any,
    best_ms: Any,
    index: Any,
    reasons: Any,
    missing: Any,
    sigma_gray: Any,
    exposure_index: Any,
    reasons_out: Any,
) -> None:
    for i in range(total.size):
        served = index[i] != np.int32(NO_EXPOSURE)
        sigma_gray[i] = best_ms[i] / np.sqrt(total[i]) if served else NAN
        exposure_index[i] = np.uint8(index[i])
        reasons_out[i] = np.uint16(reasons[i] if served else missing)


@row_loop
def _add_exposure(rows: Any, mean: Any, black: Any, weight: Any, sums: Any, light: Any) -> None:
    """Add one exposure's phasors and light by their weight."""
    n = weight.size
    for k in range(rows.cosine.shape[0]):
        _add_weighted(rows.cosine[k, :n], ZERO, weight, sums.cosine[k, :n])
        _add_weighted(rows.sine[k, :n], ZERO, weight, sums.sine[k, :n])
    _add_weighted(mean, black, weight, light)


@row_loop
def _store_phasors(
    rows: Any,
    light: Any,
    black: Any,
    scale: Any,
    best_ms: Any,
    per_gray: Any,
    start: Any,
    fused: Any,
) -> None:
    end = start + scale.size
    for k in range(rows.cosine.shape[0]):
        cosine, sine = rows.cosine[k, : scale.size], rows.sine[k, : scale.size]
        _store_steps(cosine, scale, per_gray, fused.cosine[k, start:end])
        _store_steps(sine, scale, per_gray, fused.sine[k, start:end])
    _store_light(light, black, scale, best_ms, fused.light[start:end])


@row_loop
def _fuse_share(
    counter: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    steps: Any,
    exposures: Any,
    wanted: Any,
    mode: Any,
    saturation: Any,
    fused: Any,
) -> None:
    n_frequencies = steps.first_frame.size - 1
    n_frames = steps.first_frame[n_frequencies]
    rows, sums = new_rows(n_frequencies), new_rows(n_frequencies)
    peaks = np.empty(TILE, np.uint16)
    index_row, usable_row = np.empty(TILE, np.int32), np.empty(TILE, np.int32)
    single = rows.single
    black, per_gray = np.float32(exposures.black_gray), np.float32(exposures.steps_per_gray)
    several = exposures.order.size > 1
    start = TILE * take_next(counter)
    while start < n_px:
        n = min(TILE, n_px - start)
        end = start + n
        weight, total, best, best_ms = single[0, :n], single[1, :n], single[2, :n], single[3, :n]
        light, variance, scale = single[4, :n], single[5, :n], single[6, :n]
        index, usable, reasons, peak = index_row[:n], usable_row[:n], rows.reasons[:n], peaks[:n]
        means = rows.mean[:1]  # one for all frequencies; the weights make it their average
        mean = means[0, :n]
        fill(total, ZERO)
        fill(best, ZERO)
        fill(best_ms, ONE)
        fill(index, NO_EXPOSURE)
        fill(reasons, VALID)
        if several:
            fill(light, ZERO)
            for k in range(n_frequencies):
                fill(sums.cosine[k, :n], ZERO)
                fill(sums.sine[k, :n], ZERO)
        for place in range(exposures.order.size):
            exposure = exposures.order[place]
            first = exposure * n_frames
            demodulate(
                addresses[first : first + n_frames],
                wide,
                start,
                n,
                steps,
                rows.cosine,
                rows.sine,
                means,
                peak,
            )
            predict_variance(
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
            if several:
                _add_exposure(rows, mean, black, weight, sums, light)
        if several:
            _scales_of(total, best_ms, scale)
            _store_phasors(sums, light, ZERO, scale, best_ms, per_gray, start, fused)
        else:
            _scales_of_one(total, scale)
            _store_phasors(rows, mean, black, scale, best_ms, per_gray, start, fused)
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
        start = TILE * take_next(counter)


@kernel
def fuse_exposures(
    work: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    steps: Any,
    exposures: Any,
    wanted: Any,
    mode: Any,
    saturation: Any,
    fused: Any,
) -> None:
    """Fuse the frames of several exposures into phasors, see `phasors.fuse_exposures`."""
    for _ in numba.prange(work.n_threads):
        _fuse_share(
            work.counter,
            addresses,
            wide,
            n_px,
            steps,
            exposures,
            wanted,
            mode,
            saturation,
            fused,
        )


@row_loop
def _add_square_misfit(
    frame: Any, cosine_weight: Any, sine_weight: Any, cosine: Any, sine: Any, mean: Any, total: Any
) -> None:
    for i in range(frame.size):
        d = np.float32(frame[i]) - (mean[i] + cosine_weight * cosine[i] - sine_weight * sine[i])
        total[i] += d * d


@row_loop
def _store_rms(total: Any, inverse_freedom: Any, rms: Any) -> None:
    for i in range(total.size):
        rms[i] = np.sqrt(total[i] * inverse_freedom)


@row_loop
def _misfit_share(
    counter: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    steps: Any,
    design: Any,
    inverse_freedom: Any,
    rms: Any,
) -> None:
    rows = new_rows(steps.first_frame.size - 1)
    peaks = np.empty(TILE, np.uint16)
    total_row = rows.single[0]
    start = TILE * take_next(counter)
    while start < n_px:
        n = min(TILE, n_px - start)
        total = total_row[:n]
        demodulate(addresses, wide, start, n, steps, rows.cosine, rows.sine, rows.mean, peaks[:n])
        fill(total, ZERO)
        for k in range(steps.first_frame.size - 1):
            for frame in range(steps.first_frame[k], steps.first_frame[k + 1]):
                in_phase, quadrature = design[0, frame], design[1, frame]
                c, q, m = rows.cosine[k, :n], rows.sine[k, :n], rows.mean[k, :n]
                if wide:
                    a = wide_part(addresses[frame], start, n)
                    _add_square_misfit(a, in_phase, quadrature, c, q, m, total)
                else:
                    b = narrow_part(addresses[frame], start, n)
                    _add_square_misfit(b, in_phase, quadrature, c, q, m, total)
        _store_rms(total, inverse_freedom, rms[start : start + n])
        start = TILE * take_next(counter)


@kernel
def sinusoid_misfit(
    work: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    steps: Any,
    design: Any,
    inverse_freedom: Any,
    rms: Any,
) -> None:
    """Measure the rms distance of the frames from the sinusoids, see `phasors.sinusoid_misfit`."""
    for _ in numba.prange(work.n_threads):
        _misfit_share(work.counter, addresses, wide, n_px, steps, design, inverse_freedom, rms)
