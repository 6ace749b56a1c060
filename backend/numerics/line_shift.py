"""Shifted stripes: at each camera pixel, where the edge of the stripes passes, to a fraction of a projector pixel."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt16

from backend.numerics.errors import CodeError, FrameError
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
from backend.numerics.reasons import Reason
from backend.numerics.uncertainty import NoiseModel

LEAST_SHIFTS = 4
"""Fewer positions of the stripes don't show the edge's surroundings."""
_MOST_SHIFTS = 64
_REACH_PX = 2.0
"""Width of the filter that finds the edge: wider takes in more stray light, narrower less of the light, and follows
every ripple of its picture."""
_NEWTON_STEPS = 3
_NEAR_PX = 3.0
"""Light within this distance of the edge is its own."""
_MASK_BLUR_PX = 0.8
_STEEPEST_MASK = 4.0
"""By how much at most the mask's gradient is compensated."""


class Stripes(NamedTuple):
    """Stripes shifted in equal steps over half their period; the inverses are the other half."""

    first_edge_px: float
    """Black to white edge of the first pattern: between projector columns k - 1 and k it is at k."""
    step_px: float
    shifts: int
    """Positions; half the period is shifts * step."""

    @property
    def period_px(self) -> float:
        """Width of a white and a black stripe together, in projector [px]."""
        return 2 * self.shifts * self.step_px


class LineShift(NamedTuple):
    """Sub-pixel projector coordinate of every camera pixel."""

    projector_px: Float32[np.ndarray, "h w"]
    """Pixel centres at integers; NaN where `reasons` isn't 0."""
    sigma_px: Float32[np.ndarray, "h w"]
    """Its standard deviation, from the noise and the edge's steepness."""
    contrast_gray: UInt16[np.ndarray, "h w"]
    """Largest |pattern - inverse|."""
    widening_px: Float32[np.ndarray, "h w"]
    """White minus black stripe's width in projector [px], each picture by itself at half its brightness: 0 where
    light is measured as it falls, positive where white is saturated or spills over. NaN without contrast."""
    reasons: UInt16[np.ndarray, "h w"]


class LineShiftLimits(NamedTuple):
    """What a pixel has to show."""

    min_contrast_gray: float = 4.0
    """Pattern and inverse differ by more than this somewhere."""
    saturation_gray: float = 255.0
    """An edge where both reach this is hidden."""
    coarse_error_px: float = 2.0
    """How far the coarse position may be off."""
    own_light: float = 0.5
    """Share of the light that belongs to the edge itself, not to a second reflection or another surface."""
    threshold_gray: float | None = None
    """Compare with this level instead of the inverse (equation 1), for comparison only."""


def decode_line_shift(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    inverses: Sequence[Shaped[np.ndarray, "h w"]],
    stripes: Stripes,
    coarse_px: Float32[np.ndarray, "coarse_h coarse_w"],
    *,
    size_px: int,
    noise: NoiseModel,
    limits: LineShiftLimits | None = None,
    mask: Float[np.ndarray, "across along"] | None = None,
    across_px: Float32[np.ndarray, "coarse_h coarse_w"] | None = None,
) -> LineShift:
    r"""Find the projector coordinate of every pixel from stripes that are shifted over it.

    Parameters
    ----------
    patterns, inverses
        Pictures of the stripes at each shift, uint8 or uint16.
    stripes
        Where their edges are.
    coarse_px
        Coordinate to within half a period, from a Gray code; NaN invalid.
    size_px
        Projector's width (or height) in [px].
    noise
        Of the camera.
    limits
        What a pixel has to show.
    mask
        Intensity mask that the patterns were multiplied with: one row for each coordinate across the stripes, a
        column for each along. None: all 1.
    across_px
        Projector coordinate across, to look the mask up; NaN where unknown. Only used with the mask.

    Raises
    ------
    FrameError
        If pictures don't fit together.
    CodeError
        If there are too few shifts for an edge, or not as many inverses.

    Notes
    -----
    With :math:`D_k` the difference of pattern and inverse whose edge is at k, :math:`D_k - D_{k+1}` is twice the light
    that the columns between the two edges send to the pixel: a picture of the point that the pixel sees, as wide as
    the optics' blur. Its place is where

    .. math:: \sum_i \psi\!\left(\frac{i + 1/2 - u}{\tau}\right) \frac{D_i - D_{i+1}}{M_i} = 0, \qquad
       \psi(z) = z \, e^{-z^2/2}

    over half a period around the crossing of pattern and inverse, with the mask M. Between two steps this is
    equation 11 of the paper, but (a) all pictures are compared at one pixel, so that texture and surfaces next to it
    don't matter, and nothing is interpolated across a jump; (b) the blurred edge isn't taken for straight, which
    would leave a ripple of 0.02 px; (c) offsets between pattern and inverse cancel, as of light that
    is reflected twice; (d) steps of the mask don't drag the edge along. With white noise the standard deviation is
    about :math:`\sigma_D / A` for a blur of 0.8 px, A being the largest difference.
    """
    limits = limits or LineShiftLimits()
    stack = _checked(patterns, inverses, stripes, coarse_px)
    height, width = stack.shape
    out = LineShift(
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.uint16),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.uint16),
    )
    factor, across = _mask_inputs(mask, across_px)
    _decode_rows(
        new_work(),
        stack.addresses,
        stack.wide,
        _Rules(
            shifts=stripes.shifts,
            step=float(stripes.step_px),
            first=float(stripes.first_edge_px),
            reach=reach_of(stripes),
            size=float(size_px),
            contrast=float(limits.min_contrast_gray),
            saturation=float(limits.saturation_gray),
            coarse_error=float(limits.coarse_error_px),
            own_light=float(limits.own_light),
            dark_variance=2 * noise.dark_variance_gray2,
            gain=noise.gray_per_e,
            black=noise.black_gray,
            threshold=-1.0 if limits.threshold_gray is None else float(limits.threshold_gray),
        ),
        kernel_input(coarse_px),
        factor,
        across,
        out,
    )
    return out


def reach_of(stripes: Stripes) -> float:
    """Return the width of the filter that finds the edge, in shifts of the stripes."""
    return float(np.clip(_REACH_PX / stripes.step_px, 1.0, max(stripes.shifts / 4, 1.0)))


def _checked(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    inverses: Sequence[Shaped[np.ndarray, "h w"]],
    stripes: Stripes,
    coarse_px: Float32[np.ndarray, "coarse_h coarse_w"],
) -> Any:
    n = stripes.shifts
    if len(patterns) != n or len(inverses) != n:
        raise CodeError(
            f"{len(patterns)} patterns and {len(inverses)} inverses aren't {n} positions of stripes:"
            " give both of every position"
        )
    if not LEAST_SHIFTS <= n <= _MOST_SHIFTS:
        raise CodeError(
            f"stripes at {n} positions can't be located: give {LEAST_SHIFTS} to {_MOST_SHIFTS} positions"
        )
    stack = frame_stack([*patterns, *inverses])
    if coarse_px.shape != stack.shape:
        raise FrameError(
            f"the coarse position is a map of {coarse_px.shape}, the pictures are {stack.shape}:"
            " decode both of one camera"
        )
    return stack


def _mask_inputs(
    mask: Float[np.ndarray, "across along"] | None, across_px: Float32[np.ndarray, "h w"] | None
) -> tuple[Float32[np.ndarray, "_a _b"], Float32[np.ndarray, "_h _w"]]:
    """Return the mask as the optics blur it across the stripes, and where to look it up."""
    if mask is None or across_px is None:
        return np.ones((1, 1), np.float32), np.zeros((1, 1), np.float32)
    shown = np.rint(mask * 255).astype(np.float32) / np.float32(255)
    blurred = cv2.GaussianBlur(shown, (1, 7), sigmaX=1e-3, sigmaY=_MASK_BLUR_PX)
    return np.ascontiguousarray(blurred, np.float32), kernel_input(across_px)


# ---------------------------------------------------------------- kernels

_HIDDEN = np.uint16(Reason.HIDDEN_EDGE)
_SATURATED = np.uint16(Reason.SATURATED)
_MARGIN = np.uint16(Reason.CODE_MARGIN)
_CONTRADICTION = np.uint16(Reason.ORDER_RESIDUAL)
_OUTSIDE = np.uint16(Reason.OUTSIDE_PROJECTOR)
_MISSING = np.uint16(Reason.MISSING_DATA)
_VALID = np.uint16(0)


class _Rules(NamedTuple):
    shifts: int
    step: float
    first: float
    reach: float
    size: float
    contrast: float
    saturation: float
    coarse_error: float
    own_light: float
    dark_variance: float
    gain: float
    black: float
    threshold: float


class _Pixel(NamedTuple):
    """One thread's buffers for the pixel at hand."""

    white: Any  # float64 [n]: pattern
    black: Any  # float64 [n]: inverse, or what the threshold makes of it
    cycles: Any  # float64 [6 n]: their difference over three cycles
    light: Any  # float64 [n]: of the columns around the edge
    weight: Any  # float64 [n]: one over the mask


@row_loop
def _copy_row(source: Any, target: Any) -> None:
    for i in range(target.size):
        target[i] = source[i]


@row_loop
def _unroll(pixel: Any) -> Any:
    """Write the differences of three cycles: after half a period the stripes are inverted; return the largest."""
    n = pixel.white.size
    largest = 0.0
    for m in range(n):
        difference = pixel.white[m] - pixel.black[m]
        largest = max(largest, abs(difference))
        for turn in range(3):
            pixel.cycles[2 * turn * n + m] = difference
            pixel.cycles[(2 * turn + 1) * n + m] = -difference
    return largest


@row_loop
def _crossing(cycles: Any, guess: Any, farthest: Any) -> Any:
    """Return the shift before the fall through zero nearest to a guess; -1 if there is none."""
    best, least = -1, farthest
    begin = int(guess - farthest) - 1
    end = int(guess + farthest) + 2
    before = cycles[begin]
    for m in range(begin, end):
        after = cycles[m + 1]
        if before > 0.0 and after <= 0.0:
            away = abs(m + before / (before - after) - guess)
            if away <= least:
                least = away
                best = m
        before = after
    return best


@row_loop
def _widening(pixel: Any, step: Any) -> Any:
    """Return the white minus the black share of one cycle, each picture at half of its own brightness."""
    n = pixel.white.size
    low, high = pixel.white[0], pixel.white[0]
    for m in range(n):
        low = min(low, pixel.white[m], pixel.black[m])
        high = max(high, pixel.white[m], pixel.black[m])
    middle = 0.5 * (low + high)
    above = 0.0
    before = pixel.black[n - 1] - middle
    for m in range(2 * n):
        after = (pixel.white[m] if m < n else pixel.black[m - n]) - middle
        if before >= 0.0 and after >= 0.0:
            above += 1.0
        elif before > 0.0 or after > 0.0:
            above += max(before, after) / abs(before - after)
        before = after
    return 2.0 * (above - n) * step


@row_loop
def _gather_light(
    pixel: Any, first: Any, column0: Any, rules: Any, factor: Any, across: Any
) -> None:
    """Take the light of the columns between neighbouring edges, and what the mask did to it."""
    n = pixel.light.size
    masked = factor.size > 1 and across == across
    row = 0
    if masked:
        row = min(max(int(np.floor(across + 0.5)), 0), factor.shape[0] - 1)
    for i in range(n):
        pixel.light[i] = pixel.cycles[first + i] - pixel.cycles[first + i + 1]
        pixel.weight[i] = 1.0
        if masked:
            column = int(np.floor(column0 + (i + 0.5) * rules.step))
            column = min(max(column, 0), factor.shape[1] - 1)
            pixel.weight[i] = factor[row, column]
    if masked:
        middle = pixel.weight[n // 2]
        for i in range(n):
            ratio = middle / max(pixel.weight[i], 1e-3)
            pixel.weight[i] = min(max(ratio, 1.0 / _STEEPEST_MASK), _STEEPEST_MASK)


@row_loop
def _balance(pixel: Any, place: Any, reach: Any) -> Any:
    """Return the sum that is zero at the edge, and its derivative with respect to the place."""
    total, slope = 0.0, 0.0
    for i in range(pixel.light.size):
        z = (i + 0.5 - place) / reach
        bell = np.exp(-0.5 * z * z) * pixel.weight[i]
        total += z * bell * pixel.light[i]
        slope -= (1.0 - z * z) * bell * pixel.light[i]
    return total, slope / reach


@row_loop
def _noise_factor(pixel: Any, place: Any, reach: Any) -> Any:
    """Return the sum's standard deviation over that of one difference."""
    n = pixel.light.size
    before, first, squares = 0.0, 0.0, 0.0
    for i in range(n):
        z = (i + 0.5 - place) / reach
        coefficient = z * np.exp(-0.5 * z * z) * pixel.weight[i]
        if i == 0:
            first = coefficient
        else:
            squares += (coefficient - before) ** 2
        before = coefficient
    # The last difference is the first one, inverted.
    return np.sqrt(squares + (first + before) ** 2)


@row_loop
def _own_share(pixel: Any, place: Any, near: Any, largest: Any) -> Any:
    own = 0.0
    for i in range(pixel.light.size):
        if abs(i + 0.5 - place) <= near:
            own += pixel.light[i]
    return 0.5 * own / largest


@row_loop
def _is_hidden(pixel: Any, m: Any, saturation: Any) -> Any:
    """Tell whether one of the two pictures beside the crossing is saturated in pattern and inverse."""
    n = pixel.white.size
    here, there = m % n, (m + 1) % n
    return (
        min(pixel.white[here], pixel.black[here]) >= saturation
        or min(pixel.white[there], pixel.black[there]) >= saturation
    )


@row_loop
def _refine(pixel: Any, place: Any, reach: Any) -> Any:
    """Return the place where the sum is zero and its (negative) slope there; a slope of 1 if there is none."""
    start = place
    slope = -1.0
    for _ in range(_NEWTON_STEPS):
        balance, slope = _balance(pixel, place, reach)
        if slope >= 0.0 or abs(place - start) > 1.5:
            return place, 1.0
        place -= min(max(balance / slope, -0.5), 0.5)
    return place, slope


@row_loop
def _locate(pixel: Any, coarse: Any, largest: Any, rules: Any, factor: Any, across: Any) -> Any:
    """Return coordinate, its noise over that of a difference, and the reasons of a pixel with contrast."""
    n = pixel.white.size
    guess = (coarse + 0.5 - rules.first) / rules.step
    # The second of three cycles, so that there is room on either side.
    origin = 2 * n * (np.int64(np.floor(guess / (2 * n))) - 1)
    m = _crossing(pixel.cycles, guess - origin, 0.75 * n)
    if m < 0:
        return np.nan, np.nan, _CONTRADICTION
    if _is_hidden(pixel, m, rules.saturation):
        return np.nan, np.nan, _HIDDEN
    start = m + pixel.cycles[m] / (pixel.cycles[m] - pixel.cycles[m + 1])
    first = int(start + 0.5) - n // 2
    column0 = rules.first + (first + origin) * rules.step
    _gather_light(pixel, first, column0, rules, factor, across)
    place, slope = _refine(pixel, start - first, rules.reach)
    coordinate = column0 - 0.5 + place * rules.step
    near = max(_NEAR_PX / rules.step, 1.5)
    if (
        slope >= 0.0
        or abs(coordinate - coarse) > rules.coarse_error
        or _own_share(pixel, place, near, largest) < rules.own_light
    ):
        return np.nan, np.nan, _CONTRADICTION
    if not -0.5 <= coordinate <= rules.size - 0.5:
        return np.nan, np.nan, _OUTSIDE
    return coordinate, _noise_factor(pixel, place, rules.reach) * rules.step / -slope, _VALID


@row_loop
def _judge(pixel: Any, coarse: Any, rules: Any, factor: Any, across: Any) -> Any:
    """Return coordinate, its standard deviation, contrast, widening and reasons of one pixel."""
    n = pixel.white.size
    largest, total, brightest = _unroll(pixel), 0.0, 0.0
    for m in range(n):
        total += pixel.white[m] + pixel.black[m]
        brightest = max(brightest, min(pixel.white[m], pixel.black[m]))
    if largest <= rules.contrast:
        reason = _SATURATED if brightest >= rules.saturation else _MARGIN
        return np.nan, np.nan, largest, np.nan, reason
    widening = _widening(pixel, rules.step)
    if coarse != coarse:
        return np.nan, np.nan, largest, widening, _MISSING
    coordinate, factor_px, reason = _locate(pixel, coarse, largest, rules, factor, across)
    variance = rules.dark_variance + rules.gain * max(total / n - 2.0 * rules.black, 0.0)
    return coordinate, np.sqrt(variance) * factor_px, largest, widening, reason


@row_loop
def _decode_share(
    counter: Any,
    addresses: Any,
    wide: Any,
    rules: Any,
    coarse: Any,
    factor: Any,
    across: Any,
    out: Any,
) -> None:
    n, width = rules.shifts, coarse.shape[1]
    rows = np.empty((2 * n, width), np.float32)
    pixel = _Pixel(np.empty(n), np.empty(n), np.empty(6 * n), np.empty(n), np.empty(n))
    row = take_next(counter)
    while row < coarse.shape[0]:
        start = row * width
        for m in range(2 * n):
            if wide:
                _copy_row(wide_part(addresses[m], start, width), rows[m])
            else:
                _copy_row(narrow_part(addresses[m], start, width), rows[m])
        for i in range(width):
            for m in range(n):
                pixel.white[m] = rows[m, i]
                pixel.black[m] = rows[n + m, i]
                if rules.threshold >= 0.0:
                    pixel.black[m] = 2.0 * rules.threshold - pixel.white[m]
            place = np.float64(across[row, i]) if across.size > 1 else np.nan
            found = _judge(pixel, np.float64(coarse[row, i]), rules, factor, place)
            out.projector_px[row, i] = found[0]
            out.sigma_px[row, i] = found[1]
            out.contrast_gray[row, i] = np.uint16(min(found[2], 65535.0))
            out.widening_px[row, i] = found[3]
            out.reasons[row, i] = found[4]
        row = take_next(counter)


@kernel
def _decode_rows(
    work: Any,
    addresses: Any,
    wide: Any,
    rules: Any,
    coarse: Any,
    factor: Any,
    across: Any,
    out: Any,
) -> None:
    for _ in numba.prange(work.n_threads):
        _decode_share(work.counter, addresses, wide, rules, coarse, factor, across, out)


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    frame, coarse = np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.float32)
    frames = [frame] * LEAST_SHIFTS
    decode_line_shift(
        frames,
        frames,
        Stripes(0.0, 1.0, LEAST_SHIFTS),
        coarse,
        size_px=8,
        noise=NoiseModel(1.0, 0.0),
    )
