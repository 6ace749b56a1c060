"""The inner loops of a frame: sample the projected picture, spill charge, add noise, quantise.

Noise comes from a hash of (frame key, pixel index), not from a stream: a frame is the same whichever
thread computes which row.
"""

import threading
from typing import Any

import numba
import numpy as np
from jaxtyping import Float32
from scipy.special import ndtri

from backend.numerics.kernels import kernel, row_loop

LOCK = threading.Lock()
"""Held around parallel kernels, so that two cameras' threads don't fight for the cores."""

_TABLE_SIZE = 4096


def _normal_table() -> Float32[np.ndarray, "n"]:
    """Return normal quantiles whose sum of two independent draws has variance 1."""
    table = ndtri((np.arange(_TABLE_SIZE) + 0.5) / _TABLE_SIZE)
    return np.asarray(table / table.std() / np.sqrt(2.0), np.float32)


NORMAL = _normal_table()


@row_loop
def _mixed(x: Any) -> Any:
    """Scramble 32 bits: multiply and shift, so that every input bit reaches every output bit."""
    x = np.uint32(x ^ (x >> np.uint32(16)))
    x = np.uint32(x * np.uint32(0x7FEB352D))
    x = np.uint32(x ^ (x >> np.uint32(15)))
    x = np.uint32(x * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@row_loop
def hash_row(first: Any, key_a: Any, key_b: Any, bits: Any) -> Any:
    """Two rounds: with one, two frames' noise would be shifted copies of each other."""
    for i in range(bits.size):
        x = _mixed(np.uint32(np.uint32(first) + np.uint32(i) + key_a))
        bits[i] = _mixed(np.uint32(x ^ key_b))


@row_loop
def normal_row(bits: Any, table: Any, noise: Any) -> Any:
    """Turn random bits into standard normal noise."""
    for i in range(noise.size):
        x = bits[i]
        low, high = x & np.uint32(4095), (x >> np.uint32(12)) & np.uint32(4095)
        noise[i] = table[low] + table[high]


@row_loop
def _expose_row(
    charge: Any,
    noise: Any,
    read_variance: Any,
    gray_per_e: Any,
    black: Any,
    full_scale: Any,
    out: Any,
) -> Any:
    for i in range(out.size):
        e = charge[i]
        e += np.sqrt(e + read_variance) * noise[i]
        gray = black + gray_per_e * e + np.float32(0.5)
        out[i] = np.int32(min(max(gray, np.float32(0.0)), full_scale))


@kernel
def expose(
    charge: Any,
    key_a: Any,
    key_b: Any,
    table: Any,
    read_variance: Any,
    gray_per_e: Any,
    black: Any,
    full_scale: Any,
    out: Any,
) -> None:
    """Turn charge [e] into gray levels: shot and read noise, gain, black level, rounding, clipping."""
    height, width = charge.shape
    for y in numba.prange(height):
        bits = np.empty(width, np.uint32)
        noise = np.empty(width, np.float32)
        hash_row(y * width, key_a, key_b, bits)
        normal_row(bits, table, noise)
        _expose_row(charge[y], noise, read_variance, gray_per_e, black, full_scale, out[y])


@row_loop
def _sampled(u: Any, v: Any, mix: Any, pictures: Any, last_x: Any, last_y: Any) -> Any:
    """Interpolate the sharp and the soft picture at a projector pixel and mix them."""
    u = min(max(u, np.float32(0.0)), last_x)
    v = min(max(v, np.float32(0.0)), last_y)
    x, y = np.int32(u), np.int32(v)
    fx, fy = u - np.float32(x), v - np.float32(y)
    gx, gy = np.float32(1.0) - fx, np.float32(1.0) - fy
    a = (pictures[0, y, x] * gx + pictures[0, y, x + 1] * fx) * gy
    a += (pictures[0, y + 1, x] * gx + pictures[0, y + 1, x + 1] * fx) * fy
    b = (pictures[1, y, x] * gx + pictures[1, y, x + 1] * fx) * gy
    b += (pictures[1, y + 1, x] * gx + pictures[1, y + 1, x + 1] * fx) * fy
    return a + mix * (b - a)


@row_loop
def _sample_row(
    u: Any, v: Any, weight: Any, mix: Any, pictures: Any, last_x: Any, last_y: Any, out: Any
) -> Any:
    for i in range(weight.size):
        out[i] += weight[i] * _sampled(u[i], v[i], mix[i], pictures, last_x, last_y)


@row_loop
def _room_row(white: Any, room: Any, ambient: Any, out: Any) -> Any:
    for i in range(out.size):
        out[i] = white * out[i] + room * ambient[i]


@kernel
def light(
    u: Any,
    v: Any,
    weight: Any,
    mix: Any,
    ambient: Any,
    pictures: Any,
    white: Any,
    room: Any,
    out: Any,
) -> None:
    """Fill `out` with light: the sharp and the soft picture sampled, mixed and weighted, plus the room's."""
    samples, height, _ = weight.shape
    last_x, last_y = np.float32(pictures.shape[2] - 1.001), np.float32(pictures.shape[1] - 1.001)
    for y in numba.prange(height):
        out[y, :] = np.float32(0.0)
        for s in range(samples):
            _sample_row(u[s, y], v[s, y], weight[s, y], mix[s, y], pictures, last_x, last_y, out[y])
        _room_row(white, room, ambient[y], out[y])


@row_loop
def _bounce_row(
    pixel: Any,
    u: Any,
    v: Any,
    weight: Any,
    mix: Any,
    pictures: Any,
    white: Any,
    last_x: Any,
    last_y: Any,
    out: Any,
) -> Any:
    for i in range(pixel.size):
        value = _sampled(u[i], v[i], mix[i], pictures, last_x, last_y)
        out[pixel[i]] += white * weight[i] * value


@kernel
def add_bounces(
    first: Any,
    column: Any,
    u: Any,
    v: Any,
    weight: Any,
    mix: Any,
    pictures: Any,
    white: Any,
    out: Any,
) -> None:
    """Add light that came over a mirror; row y's entries are first[y]..first[y + 1], pixels may repeat."""
    last_x, last_y = np.float32(pictures.shape[2] - 1.001), np.float32(pictures.shape[1] - 1.001)
    for y in numba.prange(out.shape[0]):
        a, b = first[y], first[y + 1]
        if b > a:
            _bounce_row(
                column[a:b],
                u[a:b],
                v[a:b],
                weight[a:b],
                mix[a:b],
                pictures,
                white,
                last_x,
                last_y,
                out[y],
            )


@row_loop
def _collect_row(rate: Any, veil: Any, glare: Any, dark: Any, exposure: Any, out: Any) -> Any:
    highest = np.float32(0.0)
    for i in range(out.size):
        e = (rate[i] + glare * (veil[i] - rate[i]) + dark) * exposure
        out[i] = e
        highest = max(highest, e)
    return highest


@kernel
def collect(
    rate: Any, veil: Any, glare: Any, dark: Any, exposure: Any, out: Any, highest: Any
) -> None:
    """Fill `out` with the charge [e] of an exposure, part of the light replaced by glare; `highest` per row."""
    for y in numba.prange(out.shape[0]):
        highest[y] = _collect_row(rate[y], veil[y], glare, dark, exposure, out[y])


@row_loop
def _cut_row(charge: Any, capacity: Any, excess: Any) -> Any:
    for i in range(charge.size):
        excess[i] = max(charge[i] - capacity, np.float32(0.0))
        charge[i] = min(charge[i], capacity)


@row_loop
def _spill_row(charge: Any, excess: Any, carried: Any, capacity: Any, share: Any) -> Any:
    for i in range(charge.size):
        taken = min(capacity - charge[i], carried[i])
        charge[i] += taken
        carried[i] = np.float32(0.9) * (carried[i] - taken) + np.float32(0.5) * share * excess[i]


@kernel
def bloom(charge: Any, capacity: Any, share: Any) -> None:
    """Cut charge at the pixels' capacity; `share` of the rest runs along the column until there is room.

    A tenth of what runs is drained at each pixel, as anti-blooming gates do.
    """
    height, width = charge.shape
    for block in numba.prange((width + 63) // 64):
        first = block * 64
        last = min(width, first + 64)
        carried = np.zeros(last - first, np.float32)
        excess = np.empty((height, last - first), np.float32)
        for y in range(height):
            _cut_row(charge[y, first:last], capacity, excess[y])
        for y in range(height):
            _spill_row(charge[y, first:last], excess[y], carried, capacity, share)
        carried[:] = np.float32(0.0)
        for k in range(height):
            y = height - 1 - k
            _spill_row(charge[y, first:last], excess[y], carried, capacity, share)
