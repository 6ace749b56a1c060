"""From fringes seen in a mirror to places on the screen: N-step phase and coarse-to-fine unwrapping."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt16

from backend.numerics.errors import FrequencyError
from backend.numerics.kernels import (
    frame_stack,
    kernel,
    kernel_input,
    narrow_part,
    new_work,
    row_loop,
    take_next,
    wide_part,
)
from backend.numerics.sine_code import SineCode, step_fit

TILE = 4096
"""Pixels done at a time: their rows stay in the cache."""

ONE = np.float32(1.0)
TURN = np.float32(1.0 / (2.0 * np.pi))


class ScreenPosition(NamedTuple):
    """Where along one axis of the screen each pixel looks."""

    wrapped_rad: Float32[np.ndarray, "_k _h _w"]
    """Phase of each period count, in (-pi, pi], the coarsest first; NaN where a gray level has no value."""
    share: Float32[np.ndarray, "_h _w"]
    """Position in the pattern, about 0 to 1; NaN where a phase is missing."""
    residual_cycles: Float32[np.ndarray, "_h _w"]
    """Largest disagreement of a period count with the coarser one before it, in cycles of the finer, 0 to 1/2."""
    modulation: Float32[np.ndarray, "_h _w"]
    """Amplitude of the finest fringes in linear values."""
    modulation_gray: Float32[np.ndarray, "_h _w"]
    """The same in gray levels as captured."""
    mean_gray: Float32[np.ndarray, "_h _w"]
    """Mean of the finest fringes in gray levels as captured."""
    darkest_gray: UInt16[np.ndarray, "_h _w"]
    brightest_gray: UInt16[np.ndarray, "_h _w"]
    """Over all frames."""


def check_periods(periods: Sequence[float]) -> None:
    """Refuse period counts, in ascending order, that can't be unwrapped from coarse to fine.

    Raises
    ------
    FrequencyError
        If there is none, the coarsest has more than one period over the screen, or two are alike.
    """
    if not periods:
        raise FrequencyError("fringes need at least one period count")
    listed = ", ".join(f"{p:g}" for p in periods)
    if periods[0] > 1.0:
        raise FrequencyError(
            f"fringes of {listed} periods can't be unwrapped: the coarsest has {periods[0]:g} periods over the screen, "
            "so positions repeat; add one of at most 1 period, such as 0.9"
        )
    if any(finer <= coarser for coarser, finer in pairwise(periods)):
        raise FrequencyError(f"fringes of {listed} periods hold one count twice: leave one of each")


def screen_position(
    frames: Sequence[Shaped[np.ndarray, "..."]],
    code: SineCode,
    values: Float[np.ndarray, "levels"] | None = None,
) -> ScreenPosition:
    r"""Decode fringes of one axis.

    Parameters
    ----------
    frames
        Period count by period count in the order of `code`, step by step; uint8 or uint16.
    code
        Period counts in ascending order and the shifts of their steps; need not be whole numbers.
    values
        Linear value of each gray level, NaN where it can't be trusted; None: the gray levels.

    Returns
    -------
    ScreenPosition
        Float32 maps. Pixels with any untrusted gray level are NaN in phase and position.

    Raises
    ------
    FrequencyError
        If the frames aren't as many as the code says.
    FrameError
        If frames differ in size or type.

    Notes
    -----
    With values :math:`V_k = A + B \cos(\varphi + \delta_k)` the phase is the least-squares one, for four
    equal steps :math:`\mathrm{atan2}(V_3 - V_1, V_0 - V_2)` up to the order of the shifts. The coarsest
    count :math:`p_0 \le 1` gives :math:`u_0 = \varphi_0 / (2 \pi p_0)` directly, taken into
    :math:`[-m, 1 + m]` with :math:`m = (1/p_0 - 1)/2`, so that noise at the screen's edges doesn't wrap;
    each finer one :math:`u_i = (\varphi_i / 2 \pi + \mathrm{round}(p_i u_{i-1} - \varphi_i / 2 \pi)) / p_i`.
    Where the first count is above 1 the position repeats and `share` means nothing; see `check_periods`.
    """
    if len(frames) != code.n_frames:
        raise FrequencyError(
            f"{len(frames)} frames were given for {code.n_frames} steps: give one frame per step"
        )
    stack = frame_stack(frames)
    levels = 2**16 if stack.wide else 2**8
    n = len(code.periods)
    wrapped = np.empty((n, *stack.shape), np.float32)
    maps = np.empty((5, *stack.shape), np.float32)
    extremes = np.empty((2, *stack.shape), np.uint16)
    _decode(
        new_work(),
        stack.addresses,
        stack.wide,
        wrapped[0].size,
        _table(values, levels),
        _weights(code),
        np.cumsum([0, *map(len, code.shifts_rad)]),
        np.array(code.periods, np.float32),
        wrapped.reshape(n, -1),
        maps.reshape(5, -1),
        extremes.reshape(2, -1),
    )
    return ScreenPosition(wrapped, *maps, *extremes)


def _table(values: Float[np.ndarray, "levels"] | None, levels: int) -> Float32[np.ndarray, "n"]:
    if values is None:
        return np.arange(levels, dtype=np.float32)
    table = np.full(levels, np.nan, np.float32)
    table[: min(levels, values.size)] = values[:levels]
    return table


def _weights(code: SineCode) -> Float32[np.ndarray, "n 3"]:
    fits = [step_fit(shifts).weights.T for shifts in code.shifts_rad]
    return np.ascontiguousarray(np.concatenate(fits), np.float32)


@row_loop
def _clear(row: Any) -> None:
    for i in range(row.size):
        row[i] = np.float32(0.0)


@row_loop
def _start_extremes(low: Any, high: Any) -> None:
    for i in range(low.size):
        low[i] = 65535
        high[i] = 0


@row_loop
def _note_extremes(frame: Any, low: Any, high: Any) -> None:
    for i in range(frame.size):
        gray = np.uint16(frame[i])
        low[i] = min(low[i], gray)
        high[i] = max(high[i], gray)


@row_loop
def _add_values(frame: Any, table: Any, weights: Any, cosine: Any, sine: Any) -> None:
    for i in range(frame.size):
        value = table[frame[i]]
        cosine[i] += weights[0] * value
        sine[i] += weights[1] * value


@row_loop
def _add_gray(frame: Any, weights: Any, cosine: Any, sine: Any, mean: Any) -> None:
    for i in range(frame.size):
        gray = np.float32(frame[i])
        cosine[i] += weights[0] * gray
        sine[i] += weights[1] * gray
        mean[i] += weights[2] * gray


@row_loop
def _phases(cosine: Any, sine: Any, wrapped: Any) -> None:
    for i in range(cosine.size):
        wrapped[i] = np.arctan2(sine[i], cosine[i])


@row_loop
def _amplitudes(cosine: Any, sine: Any, amplitude: Any) -> None:
    for i in range(cosine.size):
        amplitude[i] = np.sqrt(cosine[i] * cosine[i] + sine[i] * sine[i])


@row_loop
def _start_position(wrapped: Any, period: Any, share: Any, residual: Any) -> None:
    margin = (ONE / period - ONE) * np.float32(0.5)
    for i in range(wrapped.size):
        cycles = wrapped[i] * TURN
        cycles -= np.floor(cycles + margin * period)
        share[i] = cycles / period
        residual[i] = np.float32(0.0)


@row_loop
def _refine_position(wrapped: Any, period: Any, share: Any, residual: Any) -> None:
    for i in range(wrapped.size):
        cycles = wrapped[i] * TURN
        expected = period * share[i] - cycles
        order = np.floor(expected + np.float32(0.5))
        residual[i] = max(residual[i], abs(expected - order))
        share[i] = (cycles + order) / period


@row_loop
def _decode_share(
    counter: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    table: Any,
    weights: Any,
    first_frame: Any,
    periods: Any,
    wrapped: Any,
    maps: Any,
    extremes: Any,
) -> None:
    rows = np.empty((4, TILE), np.float32)
    start = TILE * take_next(counter)
    while start < n_px:
        n = min(TILE, n_px - start)
        end = start + n
        _start_extremes(extremes[0, start:end], extremes[1, start:end])
        share, residual = maps[0, start:end], maps[1, start:end]
        _clear(maps[4, start:end])
        for k in range(periods.size):
            cosine, sine = rows[0, :n], rows[1, :n]
            gray_cosine, gray_sine = rows[2, :n], rows[3, :n]
            _clear(cosine)
            _clear(sine)
            _clear(gray_cosine)
            _clear(gray_sine)
            finest = k == periods.size - 1
            for f in range(first_frame[k], first_frame[k + 1]):
                if wide:
                    a = wide_part(addresses[f], start, n)
                    _add_values(a, table, weights[f], cosine, sine)
                    _note_extremes(a, extremes[0, start:end], extremes[1, start:end])
                    if finest:
                        _add_gray(a, weights[f], gray_cosine, gray_sine, maps[4, start:end])
                else:
                    b = narrow_part(addresses[f], start, n)
                    _add_values(b, table, weights[f], cosine, sine)
                    _note_extremes(b, extremes[0, start:end], extremes[1, start:end])
                    if finest:
                        _add_gray(b, weights[f], gray_cosine, gray_sine, maps[4, start:end])
            phase = wrapped[k, start:end]
            _phases(cosine, sine, phase)
            if k == 0:
                _start_position(phase, periods[k], share, residual)
            else:
                _refine_position(phase, periods[k], share, residual)
            if finest:
                _amplitudes(cosine, sine, maps[2, start:end])
                _amplitudes(gray_cosine, gray_sine, maps[3, start:end])
        start = TILE * take_next(counter)


@kernel
def _decode(
    work: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    table: Any,
    weights: Any,
    first_frame: Any,
    periods: Any,
    wrapped: Any,
    maps: Any,
    extremes: Any,
) -> None:
    for _ in numba.prange(work.n_threads):
        _decode_share(
            work.counter,
            addresses,
            wide,
            n_px,
            table,
            weights,
            first_frame,
            periods,
            wrapped,
            maps,
            extremes,
        )


def phase_ripple_rad(
    wrapped_rad: Float32[np.ndarray, "h w"],
    share: Float32[np.ndarray, "h w"],
    *,
    periods: float,
    harmonic: int,
) -> float:
    r"""Measure the error of one period count's phase that repeats `harmonic` times per fringe.

    Parameters
    ----------
    wrapped_rad
        Phase of that period count.
    share
        Position found by finer fringes (or, for the finest, smoothed); NaN where unknown.
    periods
        Of the pattern: its phase is 2 pi periods share.
    harmonic
        The number of steps N: a response that isn't linear gives N-step phase errors of N, 2N ... times the phase.

    Returns
    -------
    Amplitude in [rad]; NaN where fewer than 100 pixels are known.

    Notes
    -----
    Least squares of :math:`e = c_0 + c_1 \cos N\varphi + c_2 \sin N\varphi` over pixels whose error lies
    within 4 robust standard deviations: mixed pixels at edges aren't the response's fault.
    """
    known = np.isfinite(wrapped_rad) & np.isfinite(share)
    if np.count_nonzero(known) < _LEAST_PIXELS:
        return float("nan")
    phase = wrapped_rad[known].astype(np.float64)
    error = phase - 2 * np.pi * periods * share[known]
    error = (error + np.pi) % (2 * np.pi) - np.pi
    middle = np.median(error)
    usual = 1.4826 * np.median(np.abs(error - middle))
    near = np.abs(error - middle) <= 4 * usual + 1e-6
    angle = harmonic * phase[near]
    design = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    found = np.linalg.lstsq(design.T @ design, design.T @ error[near], rcond=None)[0]
    return float(np.hypot(found[1], found[2]))


_LEAST_PIXELS = 100


def warm_up_kernels() -> None:
    """Compile or load the kernel; one compilation serves uint8 and uint16."""
    frames = [np.zeros((2, 2), np.uint8)] * 4
    screen_position(frames, SineCode.equal_steps((0.9,), 4), kernel_input(np.arange(256.0)))
