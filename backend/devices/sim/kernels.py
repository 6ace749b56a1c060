"""The inner loops of a frame: sample the projected picture, spill charge, add noise, quantise.

Noise comes from a hash of (frame key, pixel index), not from a stream: a frame is the same whichever
thread computes which row.
"""

# ruff: noqa: ANN001, ANN202 - numba kernels take their types from the call
# mypy: allow-untyped-defs

import threading

import numba
import numpy as np
from scipy.special import ndtri

from backend.numerics.kernels import kernel, row_loop

LOCK = threading.Lock()
"""Held around parallel kernels, so that two cameras' threads don't fight for the cores."""

_TABLE_SIZE = 4096


def _normal_table():
    """Return normal quantiles whose sum of two independent draws has variance 1."""
    table = ndtri((np.arange(_TABLE_SIZE) + 0.5) / _TABLE_SIZE)
    return (table / table.std() / np.sqrt(2.0)).astype(np.float32)


NORMAL = _normal_table()


@row_loop
def _mixed(x):
    """Scramble 32 bits: multiply and shift, so that every input bit reaches every output bit."""
    x = np.uint32(x ^ (x >> np.uint32(16)))
    x = np.uint32(x * np.uint32(0x7FEB352D))
    x = np.uint32(x ^ (x >> np.uint32(15)))
    x = np.uint32(x * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@row_loop
def _hash_row(first, key_a, key_b, bits):
    """Two rounds: with one, two frames' noise would be shifted copies of each other."""
    for i in range(bits.size):
        x = _mixed(np.uint32(np.uint32(first) + np.uint32(i) + key_a))
        bits[i] = _mixed(np.uint32(x ^ key_b))


@row_loop
def _normal_row(bits, table, noise):
    for i in range(noise.size):
        x = bits[i]
        low, high = x & np.uint32(4095), (x >> np.uint32(12)) & np.uint32(4095)
        noise[i] = table[low] + table[high]


@row_loop
def _expose_row(charge, noise, read_variance, gray_per_e, black, full_scale, out):
    for i in range(out.size):
        e = charge[i]
        e += np.sqrt(e + read_variance) * noise[i]
        gray = black + gray_per_e * e + np.float32(0.5)
        out[i] = np.int32(min(max(gray, np.float32(0.0)), full_scale))


@kernel
def expose(charge, key_a, key_b, table, read_variance, gray_per_e, black, full_scale, out):
    """Turn charge [e] into gray levels: shot and read noise, gain, black level, rounding, clipping."""
    height, width = charge.shape
    for y in numba.prange(height):
        bits = np.empty(width, np.uint32)
        noise = np.empty(width, np.float32)
        _hash_row(y * width, key_a, key_b, bits)
        _normal_row(bits, table, noise)
        _expose_row(charge[y], noise, read_variance, gray_per_e, black, full_scale, out[y])


@row_loop
def _sampled(u, v, mix, pictures, last_x, last_y):
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
def _sample_row(u, v, weight, mix, pictures, last_x, last_y, out):
    for i in range(weight.size):
        out[i] += weight[i] * _sampled(u[i], v[i], mix[i], pictures, last_x, last_y)


@row_loop
def _room_row(white, room, ambient, out):
    for i in range(out.size):
        out[i] = white * out[i] + room * ambient[i]


@kernel
def light(u, v, weight, mix, ambient, pictures, white, room, out):
    """Fill `out` with light: the sharp and the soft picture sampled, mixed and weighted, plus the room's."""
    samples, height, _ = weight.shape
    last_x, last_y = np.float32(pictures.shape[2] - 1.001), np.float32(pictures.shape[1] - 1.001)
    for y in numba.prange(height):
        out[y, :] = np.float32(0.0)
        for s in range(samples):
            _sample_row(u[s, y], v[s, y], weight[s, y], mix[s, y], pictures, last_x, last_y, out[y])
        _room_row(white, room, ambient[y], out[y])


@row_loop
def _bounce_row(pixel, u, v, weight, mix, pictures, white, last_x, last_y, out):
    for i in range(pixel.size):
        value = _sampled(u[i], v[i], mix[i], pictures, last_x, last_y)
        out[pixel[i]] += white * weight[i] * value


@kernel
def add_bounces(first, column, u, v, weight, mix, pictures, white, out):
    """Add light that came over a mirror; row y's entries are first[y]..first[y + 1], pixels may repeat."""
    last_x, last_y = np.float32(pictures.shape[2] - 1.001), np.float32(pictures.shape[1] - 1.001)
    for y in numba.prange(out.shape[0]):
        a, b = first[y], first[y + 1]
        if b > a:
            _bounce_row(
                column[a:b], u[a:b], v[a:b], weight[a:b], mix[a:b], pictures, white, last_x, last_y, out[y]
            )


@row_loop
def _collect_row(rate, veil, glare, dark, exposure, out):
    highest = np.float32(0.0)
    for i in range(out.size):
        e = (rate[i] + glare * (veil[i] - rate[i]) + dark) * exposure
        out[i] = e
        highest = max(highest, e)
    return highest


@kernel
def collect(rate, veil, glare, dark, exposure, out, highest):
    """Fill `out` with the charge [e] of an exposure, part of the light replaced by glare; `highest` per row."""
    for y in numba.prange(out.shape[0]):
        highest[y] = _collect_row(rate[y], veil[y], glare, dark, exposure, out[y])


@row_loop
def _cut_row(charge, capacity, excess):
    for i in range(charge.size):
        excess[i] = max(charge[i] - capacity, np.float32(0.0))
        charge[i] = min(charge[i], capacity)


@row_loop
def _spill_row(charge, excess, carried, capacity, share):
    for i in range(charge.size):
        taken = min(capacity - charge[i], carried[i])
        charge[i] += taken
        carried[i] = np.float32(0.9) * (carried[i] - taken) + np.float32(0.5) * share * excess[i]


@kernel
def bloom(charge, capacity, share):
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
