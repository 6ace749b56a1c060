"""Two lights in one pixel: the part's own stripe, and one that comes by a second reflection from a few columns away."""

from collections.abc import Sequence
from math import erf
from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, Shaped

from backend.numerics.kernels import (
    frame_stack,
    kernel,
    narrow_part,
    row_loop,
    wide_part,
)
from backend.numerics.line_shift import (
    LineShift,
    Stripes,
    _gather_light,
    _mask_inputs,
    _noise_factor,
    _Pixel,
    _refine,
    _unroll,
    reach_of,
)
from backend.numerics.uncertainty import NoiseModel

_MISFIT = 0.06
"""Of the light's picture from that of one point, over its amplitude: more is worth a second look."""
_BETTER = 0.5
"""Two lights have to leave less than this share of the misfit."""
_APART_PX = 1.2
"""Lights nearer to one another can't be told apart."""
_LEAST_SHARE = 0.08
"""Of the second light in the first one."""
_COARSE, _FINE = 0.25, 0.05
"""Steps of the search, in shifts of the stripes."""
_CHUNK = 512
"""Pixels between two requests for memory."""
_FINE_STEPS = 11
"""Over two coarse steps."""
_NOISIER = 2.0
"""Standard deviation of a coordinate after the other light is taken off, over that of a plain one."""
_FOOTPRINT = 0.243
"""Variance of a camera pixel's own width and its lens's blur, in camera [px^2]."""
_BLURS_PX = np.arange(0.4, 1.81, 0.05)


class Separated(NamedTuple):
    """A line-shift result whose mixed pixels are corrected."""

    projector_px: Float32[np.ndarray, "h w"]
    sigma_px: Float32[np.ndarray, "h w"]
    mixed: Bool[np.ndarray, "h w"]
    """A second light was found and taken off."""
    blur_px: float
    """Width of the stripes' blur that most pixels show, in projector [px]."""


def separate_lights(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    inverses: Sequence[Shaped[np.ndarray, "h w"]],
    stripes: Stripes,
    located: LineShift,
    *,
    noise: NoiseModel,
    mask: Float[np.ndarray, "across along"] | None = None,
    across_px: Float32[np.ndarray, "h w"] | None = None,
) -> Separated:
    r"""Find pixels that see two places of the stripes at once, and keep the brighter one.

    Parameters
    ----------
    patterns, inverses, stripes, noise, mask, across_px
        As `decode_line_shift` took them.
    located
        What it found.

    Notes
    -----
    The light of the columns (see `decode_line_shift`) is one blurred point where a pixel sees one place. In corners of
    mirror-like parts it shows two: :math:`L_i = a_1 g(i - u_1) + a_2 g(i - u_2)`, g being the blur that most pixels
    show, widened where the columns run fast over the picture. Least squares over a grid of both places, and the weaker
    light is taken off. It may have a negative amplitude: light from the next half period. Lights less than 1.2 px
    apart can't be told apart, and of two equal ones the wrong one may be kept: the row code tells.
    """
    stack = frame_stack([*patterns, *inverses])
    factor, across = _mask_inputs(mask, across_px)
    lights = _Lights(
        addresses=stack.addresses,
        wide=stack.wide,
        shifts=stripes.shifts,
        step=float(stripes.step_px),
        first=float(stripes.first_edge_px),
        reach=reach_of(stripes),
        dark_variance=2 * noise.dark_variance_gray2,
        gain=noise.gray_per_e,
        black=noise.black_gray,
    )
    coordinate = located.projector_px.ravel()
    valid = np.flatnonzero(np.isfinite(coordinate))
    spread = _extra_variance(located.projector_px).ravel()
    where = across.ravel() if across.size > 1 else np.full(coordinate.size, np.nan, np.float32)

    def misfits(pixels: Int64[np.ndarray, "n"], blur_px: float) -> Float32[np.ndarray, "n"]:
        blurs = _widened(blur_px, spread[pixels])
        out = np.empty(pixels.size, np.float32)
        _misfits(pixels, coordinate[pixels], blurs, where[pixels], lights, factor, out)
        return out

    some = valid[:: max(1, valid.size // 4000)]
    if some.size == 0:
        return Separated(
            located.projector_px, located.sigma_px, np.zeros(located.reasons.shape, bool), 0.0
        )
    blur_px = float(min(_BLURS_PX, key=lambda blur: float(np.median(misfits(some, float(blur))))))
    doubtful = valid[misfits(valid, blur_px) > _MISFIT]
    blurs = _widened(blur_px, spread[doubtful])
    found = np.empty((2, doubtful.size), np.float32)
    _separate(doubtful, coordinate[doubtful], blurs, where[doubtful], lights, factor, *found)
    corrected = np.isfinite(found[0])
    out = Separated(
        located.projector_px.copy(),
        located.sigma_px.copy(),
        np.zeros(located.reasons.shape, bool),
        blur_px,
    )
    pixels = doubtful[corrected]
    out.projector_px.reshape(-1)[pixels] = found[0, corrected]
    out.sigma_px.reshape(-1)[pixels] = found[1, corrected]
    out.mixed.reshape(-1)[pixels] = True
    return out


class _Lights(NamedTuple):
    addresses: Any
    wide: bool
    shifts: int
    step: float
    first: float
    reach: float
    dark_variance: float
    gain: float
    black: float


def _widened(blur_px: float, extra: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
    return np.sqrt(np.maximum(np.float32(blur_px**2) + extra, np.float32(0.16)))


def _extra_variance(projector_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return what the footprint of a pixel adds to the blur, beyond that of most pixels, in [px^2]."""
    steepness = np.zeros(projector_px.shape, np.float32)
    for axis in (0, 1):
        slope = np.gradient(projector_px, axis=axis) if projector_px.shape[axis] > 1 else 0.0
        steepness += np.square(slope)
    known = steepness[np.isfinite(steepness)]
    usual = np.float32(np.median(known)) if known.size else np.float32(0)
    extra = np.float32(_FOOTPRINT) * (np.nan_to_num(steepness, nan=float(usual)) - usual)
    return np.asarray(np.minimum(extra, np.float32(4.0)))


# ---------------------------------------------------------------- kernels


@row_loop
def _load(pixel: Any, index: Any, lights: Any) -> Any:
    """Read one pixel of all frames; return the sum of pattern and inverse, averaged."""
    n, total = lights.shifts, 0.0
    for m in range(n):
        p, q = lights.addresses[m], lights.addresses[n + m]
        if lights.wide:
            pixel.white[m] = wide_part(p, index, 1)[0]
            pixel.black[m] = wide_part(q, index, 1)[0]
        else:
            pixel.white[m] = narrow_part(p, index, 1)[0]
            pixel.black[m] = narrow_part(q, index, 1)[0]
        total += pixel.white[m] + pixel.black[m]
    return total / n


@row_loop
def _light_at(pixel: Any, coordinate: Any, lights: Any, factor: Any, across: Any) -> Any:
    """Gather the light around a coordinate; return the column at its beginning, and the coordinate's place in it."""
    n = lights.shifts
    _unroll(pixel)
    guess = (coordinate + 0.5 - lights.first) / lights.step
    origin = 2 * n * (np.int64(np.floor(guess / (2 * n))) - 1)
    first = int(guess - origin + 0.5) - n // 2
    column0 = lights.first + (first + origin) * lights.step
    _gather_light(pixel, first, column0, lights, factor, across)
    return column0, guess - origin - first


@row_loop
def _integrate(pixel: Any, out: Any) -> Any:
    """Return to differences of pattern and inverse, whose noise is white, with the mask taken off."""
    half = 0.0
    for i in range(pixel.light.size):
        half += 0.5 * pixel.light[i] * pixel.weight[i]
    out[0] = half
    for i in range(pixel.light.size):
        out[i + 1] = out[i] - pixel.light[i] * pixel.weight[i]
    mean = 0.0
    for i in range(out.size):
        mean += out[i] / out.size
    for i in range(out.size):
        out[i] -= mean


@row_loop
def _edge(place: Any, width: Any, out: Any) -> None:
    """Draw the edge of one light, without its mean."""
    mean = 0.0
    for i in range(out.size):
        out[i] = erf((place - i) / width)
        mean += out[i] / out.size
    for i in range(out.size):
        out[i] -= mean


@row_loop
def _dot(a: Any, b: Any) -> Any:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@row_loop
def _one_misfit(measured: Any, drawn: Any) -> Any:
    """Return the residual's root mean square over the amplitude of the best single light."""
    square, along = _dot(drawn, drawn), _dot(drawn, measured)
    amplitude = along / square
    left = max(_dot(measured, measured) - along * amplitude, 0.0)
    return np.sqrt(left / measured.size), amplitude


@kernel
def _misfits(
    pixels: Any, coordinate: Any, blurs: Any, across: Any, lights: Any, factor: Any, out: Any
) -> None:
    n = lights.shifts
    for chunk in numba.prange((pixels.size + _CHUNK - 1) // _CHUNK):
        pixel = _Pixel(np.empty(n), np.empty(n), np.empty(6 * n), np.empty(n), np.empty(n))
        measured, drawn = np.empty(n + 1), np.empty(n + 1)
        for k in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, pixels.size)):
            _load(pixel, pixels[k], lights)
            _, place = _light_at(pixel, np.float64(coordinate[k]), lights, factor, across[k])
            _integrate(pixel, measured)
            _edge(place, 1.4142135 * blurs[k] / lights.step, drawn)
            misfit, amplitude = _one_misfit(measured, drawn)
            out[k] = misfit / max(amplitude, 1e-3)


@row_loop
def _pair(measured: Any, a: Any, b: Any, whole: Any) -> Any:
    """Return what the best two amplitudes at two places leave, and both."""
    aa, bb, ab = _dot(a, a), _dot(b, b), _dot(a, b)
    ya, yb = _dot(measured, a), _dot(measured, b)
    determinant = aa * bb - ab * ab
    if determinant < 1e-6:
        return whole, 0.0, 0.0
    x = (ya * bb - yb * ab) / determinant
    y = (yb * aa - ya * ab) / determinant
    return whole - x * ya - y * yb, x, y


@row_loop
def _search(measured: Any, width: Any, least: Any, table: Any, begins: Any, step: Any) -> Any:
    """Try all pairs of places begin + number * step; return the best residual, places and amplitudes."""
    count = table.shape[1]
    for side in range(2):
        for g in range(count):
            _edge(begins[side] + g * step, width, table[side, g])
    whole = _dot(measured, measured)
    best, place_a, place_b, amount_a, amount_b = whole, 0.0, 0.0, 0.0, 0.0
    for g in range(count):
        for h in range(count):
            here, there = begins[0] + g * step, begins[1] + h * step
            if there - here < least:
                continue
            left, x, y = _pair(measured, table[0, g], table[1, h], whole)
            if left < best and max(x, y) > 0.0:
                best, place_a, place_b, amount_a, amount_b = left, here, there, x, y
    return best, place_a, place_b, amount_a, amount_b


@row_loop
def _take_off(pixel: Any, place: Any, amplitude: Any, width: Any) -> None:
    for i in range(pixel.light.size):
        light = amplitude * (erf((place - i) / width) - erf((place - i - 1) / width))
        pixel.light[i] -= light / pixel.weight[i]


@row_loop
def _brighter(pixel: Any, place: Any, width: Any, least: Any, reach: Any) -> Any:
    """Take the weaker of two lights off; return the place of the brighter one and its slope (1 if there is none)."""
    n = pixel.light.size
    measured, drawn = np.empty(n + 1), np.empty(n + 1)
    _integrate(pixel, measured)
    _edge(place, width, drawn)
    misfit, _ = _one_misfit(measured, drawn)
    begins = np.empty(2)
    begins[0], begins[1] = 0.5, 0.5
    coarse = np.empty((2, int((n - 1) / _COARSE) + 1, n + 1))
    _, a, b, _, _ = _search(measured, width, least, coarse, begins, _COARSE)
    begins[0], begins[1] = a - _COARSE, b - _COARSE
    fine = np.empty((2, _FINE_STEPS, n + 1))
    left, a, b, x, y = _search(measured, width, least, fine, begins, _FINE)
    strong, weak = max(x, y), min(x, y)
    better = np.sqrt(max(left, 0.0) / (n + 1)) < _BETTER * misfit
    if not better or strong <= 0.0 or abs(weak) < _LEAST_SHARE * strong or abs(weak) > strong:
        return 0.0, 1.0
    _take_off(pixel, b if x > y else a, weak, width)
    return _refine(pixel, a if x > y else b, reach)


@kernel
def _separate(
    pixels: Any,
    coordinate: Any,
    blurs: Any,
    across: Any,
    lights: Any,
    factor: Any,
    found: Any,
    sigma: Any,
) -> None:
    n = lights.shifts
    for k in numba.prange(pixels.size):
        pixel = _Pixel(np.empty(n), np.empty(n), np.empty(6 * n), np.empty(n), np.empty(n))
        total = _load(pixel, pixels[k], lights)
        column0, place = _light_at(pixel, np.float64(coordinate[k]), lights, factor, across[k])
        width = 1.4142135 * blurs[k] / lights.step
        place, slope = _brighter(pixel, place, width, _APART_PX / lights.step, lights.reach)
        found[k], sigma[k] = np.nan, np.nan
        if slope < 0.0:
            variance = lights.dark_variance + lights.gain * max(total - 2.0 * lights.black, 0.0)
            found[k] = column0 - 0.5 + place * lights.step
            noise = _noise_factor(pixel, place, lights.reach) * lights.step / -slope
            sigma[k] = _NOISIER * np.sqrt(variance) * noise


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    frame, one = np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.float32)
    located = LineShift(one, one, np.zeros((1, 1), np.uint16), one, np.zeros((1, 1), np.uint16))
    frames = [frame] * 4
    separate_lights(frames, frames, Stripes(0.0, 1.0, 4), located, noise=NoiseModel(1.0, 0.0))
