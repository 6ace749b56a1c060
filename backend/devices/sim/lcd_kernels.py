"""The inner loops of a frame of the mirror rig: what each pixel sees of the screen, and what the sensor makes of it."""

from typing import Any

import numba
import numpy as np

from backend.devices.sim.kernels import hash_row, normal_row
from backend.numerics.kernels import kernel, row_loop

_MOST_SAMPLES = 16


@row_loop
def _sampled(picture: Any, u: Any, v: Any) -> Any:
    """Interpolate a picture between pixel centres; it ends half a pixel beyond the outermost, dark."""
    height, width = picture.shape
    if u < -0.5 or v < -0.5 or u > width - 0.5 or v > height - 0.5:
        return np.float32(0.0)
    u = min(max(u, np.float32(0.0)), np.float32(width - 1.001))
    v = min(max(v, np.float32(0.0)), np.float32(height - 1.001))
    x, y = int(u), int(v)
    fx, fy = u - np.float32(x), v - np.float32(y)
    upper = picture[y, x] + fx * (picture[y, x + 1] - picture[y, x])
    lower = picture[y + 1, x] + fx * (picture[y + 1, x + 1] - picture[y + 1, x])
    return upper + fy * (lower - upper)


@row_loop
def _samples(half: Any) -> Any:
    """Return how many samples a box takes, and their distance: with the box's own variance."""
    count = min(max(int(np.ceil(np.float32(2.0) * half)), 2), _MOST_SAMPLES)
    spread = np.float32(1.0) / np.sqrt(np.float32(1.0) - np.float32(1.0) / (count * count))
    return count, np.float32(2.0) * half / np.float32(count) * spread


@row_loop
def _gather_row(
    picture: Any, u: Any, v: Any, half_u: Any, half_v: Any, weight: Any, ambient: Any, out: Any
) -> Any:
    for i in range(out.size):
        light = np.float32(0.0)
        if weight[i] > 0:
            across, step_u = _samples(half_u[i])
            down, step_v = _samples(half_v[i])
            for b in range(down):
                dv = (np.float32(b) - np.float32(0.5) * np.float32(down - 1)) * step_v
                for a in range(across):
                    du = (np.float32(a) - np.float32(0.5) * np.float32(across - 1)) * step_u
                    light += _sampled(picture, u[i] + du, v[i] + dv)
            light /= np.float32(across * down)
        out[i] = weight[i] * light + ambient[i]


@kernel
def gather(
    picture: Any, u: Any, v: Any, half_u: Any, half_v: Any, weight: Any, ambient: Any, out: Any
) -> None:
    """Fill `out` with the mean of a picture over a box per pixel, times weight, plus ambient."""
    for y in numba.prange(out.shape[0]):
        _gather_row(picture, u[y], v[y], half_u[y], half_v[y], weight[y], ambient[y], out[y])


@row_loop
def _develop_row(
    light: Any,
    noise: Any,
    noisy: Any,
    white_e: Any,
    read_variance: Any,
    share_per_e: Any,
    tone: Any,
    out: Any,
) -> Any:
    last = tone.size - 1
    for i in range(out.size):
        e = light[i] * white_e
        if noisy:
            e += np.sqrt(e + read_variance) * noise[i]
        at = min(max(e * share_per_e, np.float32(0.0)), np.float32(1.0)) * np.float32(last)
        k = min(int(at), last - 1)
        out[i] = int(tone[k] + (at - np.float32(k)) * (tone[k + 1] - tone[k]) + np.float32(0.5))


@kernel
def develop(
    light: Any,
    key_a: Any,
    key_b: Any,
    table: Any,
    noisy: Any,
    white_e: Any,
    read_variance: Any,
    share_per_e: Any,
    tone: Any,
    out: Any,
) -> None:
    """Turn light into gray levels: charge, shot and read noise, gain, clipping, tone curve, rounding."""
    height, width = light.shape
    for y in numba.prange(height):
        bits = np.empty(width, np.uint32)
        noise = np.empty(width, np.float32)
        if noisy:
            hash_row(y * width, key_a, key_b, bits)
            normal_row(bits, table, noise)
        _develop_row(light[y], noise, noisy, white_e, read_variance, share_per_e, tone, out[y])
