"""Row loops that fit sinusoids to frames and turn phasors into phases; compiled into the kernels.

A row is always cut as rows[k, a:b] from a contiguous array. Cutting rows[:, a:b] first and a row of
that later gives numba a row of unknown stride, and the loops over it run scalar.
"""

from typing import Any, NamedTuple

import numpy as np

from backend.numerics.kernels import narrow_part, row_loop, wide_part

TILE = 2048
"""Pixels per tile; some 30 rows of them stay in the second-level cache.

Threads take tile after tile, see `take_next`."""

# Numbers in a kernel have to be float32 one by one: a Python float makes the whole loop float64.
ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
NAN = np.float32(np.nan)
_QUARTER = np.float32(0.25)
_TINY = np.float32(1e-30)

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


class Steps(NamedTuple):
    """Where each frequency's frames are, and their weights."""

    first_frame: Any  # int64[k + 1]: frames of frequency i are first_frame[i] .. first_frame[i + 1]
    weights: Any  # float32[3, n]: cosine, sine, mean


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
def new_rows(n_frequencies: Any) -> Any:
    """Allocate one thread's rows; the sums begin finite, so that 0 times what is left there is 0."""
    shape = (n_frequencies, TILE)
    return Rows(
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty((12, TILE), np.float32),
        np.empty(TILE, np.int32),
        np.empty(TILE, np.int32),
    )


@row_loop
def fill(row: Any, value: Any) -> None:
    """Set every element."""
    for i in range(row.size):
        row[i] = value


@row_loop
def add_row(row: Any, total: Any) -> None:
    """Add a row to another one."""
    for i in range(total.size):
        total[i] += row[i]


@row_loop
def add_scaled(row: Any, factor: Any, total: Any) -> None:
    """Add a row times a factor to another one."""
    for i in range(total.size):
        total[i] += factor * row[i]


@row_loop
def _add_frame(
    frame: Any,
    weight_cosine: Any,
    weight_sine: Any,
    weight_mean: Any,
    cosine: Any,
    sine: Any,
    mean: Any,
) -> None:
    for i in range(frame.size):
        gray = np.float32(frame[i])
        cosine[i] += weight_cosine * gray
        sine[i] += weight_sine * gray
        mean[i] += weight_mean * gray


@row_loop
def _add_four(
    frame_0: Any,
    frame_1: Any,
    frame_2: Any,
    frame_3: Any,
    weights: Any,
    first: Any,
    keep: Any,
    cosine: Any,
    sine: Any,
    mean: Any,
) -> None:
    """Add four frames to sums, or start the sums with them if `keep` is 0: that saves clearing them."""
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
        cosine[i] = keep * cosine[i] + c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3
        sine[i] = keep * sine[i] + s0 * g0 + s1 * g1 + s2 * g2 + s3 * g3
        mean[i] += m0 * g0 + m1 * g1 + m2 * g2 + m3 * g3


@row_loop
def _keep_peak(frame: Any, peak: Any) -> None:
    for i in range(frame.size):
        gray = np.uint16(frame[i])
        old = peak[i]
        peak[i] = gray if gray > old else old


@row_loop
def _keep_peak_of_four(frame_0: Any, frame_1: Any, frame_2: Any, frame_3: Any, peak: Any) -> None:
    for i in range(frame_0.size):
        g0, g1, g2, g3 = frame_0[i], frame_1[i], frame_2[i], frame_3[i]
        a = g0 if g0 > g1 else g1
        b = g2 if g2 > g3 else g3
        c = np.uint16(a if a > b else b)
        old = peak[i]
        peak[i] = c if c > old else old


@row_loop
def _add_four_frames(
    addresses: Any,
    started: Any,
    wide: Any,
    start: Any,
    n: Any,
    weights: Any,
    frame: Any,
    cosine: Any,
    sine: Any,
    mean: Any,
    peak: Any,
) -> None:
    first, second = addresses[frame], addresses[frame + 1]
    third, fourth = addresses[frame + 2], addresses[frame + 3]
    keep = ONE if started else ZERO
    if wide:
        p, q = wide_part(first, start, n), wide_part(second, start, n)
        r, s = wide_part(third, start, n), wide_part(fourth, start, n)
        _add_four(p, q, r, s, weights, frame, keep, cosine, sine, mean)
        _keep_peak_of_four(p, q, r, s, peak)
    else:
        a, b = narrow_part(first, start, n), narrow_part(second, start, n)
        c, d = narrow_part(third, start, n), narrow_part(fourth, start, n)
        _add_four(a, b, c, d, weights, frame, keep, cosine, sine, mean)
        _keep_peak_of_four(a, b, c, d, peak)


@row_loop
def demodulate(
    addresses: Any,
    wide: Any,
    start: Any,
    n: Any,
    steps: Any,
    cosine: Any,
    sine: Any,
    mean: Any,
    peak: Any,
) -> None:
    """Fit a sinusoid to each frequency of one tile; keep each pixel's brightest sample.

    Means are added to as many rows as `mean` has: one per frequency, or one for all.
    """
    fill(peak, 0)
    weights = steps.weights
    for k in range(mean.shape[0]):
        fill(mean[k, :n], ZERO)
    for k in range(cosine.shape[0]):
        cosine_k, sine_k, mean_k = cosine[k, :n], sine[k, :n], mean[k % mean.shape[0], :n]
        start_frame, end = steps.first_frame[k], steps.first_frame[k + 1]
        frame = start_frame
        if end - start_frame < 4:
            fill(cosine_k, ZERO)
            fill(sine_k, ZERO)
        while frame + 4 <= end:
            _add_four_frames(
                addresses,
                frame > start_frame,
                wide,
                start,
                n,
                weights,
                frame,
                cosine_k,
                sine_k,
                mean_k,
                peak,
            )
            frame += 4
        while frame < end:
            w_cosine, w_sine, w_mean = weights[0, frame], weights[1, frame], weights[2, frame]
            if wide:
                p = wide_part(addresses[frame], start, n)
                _add_frame(p, w_cosine, w_sine, w_mean, cosine_k, sine_k, mean_k)
                _keep_peak(p, peak)
            else:
                q = narrow_part(addresses[frame], start, n)
                _add_frame(q, w_cosine, w_sine, w_mean, cosine_k, sine_k, mean_k)
                _keep_peak(q, peak)
            frame += 1


@row_loop
def to_cycles(cosine: Any, sine: Any, cycles: Any, power: Any) -> None:
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
        p = HALF - p if c < ZERO else p
        cycles[i] = ONE - p if s < ZERO else p
        power[i] = c * c + s * s


@row_loop
def keep_smallest(power: Any, smallest: Any) -> None:
    """Keep the smaller of two values."""
    for i in range(power.size):
        old = smallest[i]
        smallest[i] = power[i] if power[i] < old else old


@row_loop
def add_inverse(power: Any, factor: Any, total: Any) -> None:
    """Add a factor over each value."""
    for i in range(power.size):
        total[i] += factor / (power[i] + _TINY)


@row_loop
def predict_variance(mean: Any, variance: Any, per_gray: Any, black: Any, predicted: Any) -> None:
    """Predict the variance of gray levels from their mean."""
    for i in range(mean.size):
        light = mean[i] - black
        light = light if light > ZERO else ZERO
        predicted[i] = variance + per_gray * light


@row_loop
def widen(row: Any, wide: Any) -> None:
    """Copy a row of small integers to int32."""
    for i in range(row.size):
        wide[i] = np.int32(row[i])


@row_loop
def square_into(row: Any, squares: Any) -> None:
    """Square a row into another one."""
    for i in range(row.size):
        squares[i] = row[i] * row[i]
