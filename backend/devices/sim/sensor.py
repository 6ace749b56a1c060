"""The simulated image sensor: light in electrons per ms to gray levels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from backend.devices.sim import kernels

_CAPACITY = 1.06
"""Charge that a pixel holds over charge at full scale: the converter saturates first, cleanly."""


@dataclass(frozen=True)
class Sensor:
    """What one camera's sensor is like; the same charge per pixel whatever the bit depth."""

    full_well_e: float
    read_noise_e: float
    black_level_gray8: float
    """Gray level of a dark pixel at 8 bit."""
    dark_current_e_per_ms: float
    blooming_share: float
    glare_share: float
    hot_pixel_share: float
    seed: int

    def black_level_gray(self, bits: int) -> float:
        """Return the black level at a bit depth, in its gray levels."""
        return self.black_level_gray8 * 2.0 ** (bits - 8)

    def picture(
        self,
        rate_e_per_ms: Float32[np.ndarray, "h w"],
        veil_e_per_ms: Float32[np.ndarray, "h w"],
        *,
        exposure_ms: float,
        gain_db: float,
        bits: int,
        frame_key: int,
    ) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
        r"""Expose, read out and quantise one frame.

        Parameters
        ----------
        rate_e_per_ms
            Light on each pixel, in [e/ms].
        veil_e_per_ms
            Where the same light arrives once scattered, in [e/ms].
        exposure_ms, gain_db
            As set.
        bits
            8 gives uint8, 12 gives uint16 with 0..4095.
        frame_key
            What makes this frame's noise differ from others'.

        Notes
        -----
        .. math:: I = b + g (N + \sqrt{N + r^2} z), \qquad g = G (2^{bits} - 1) / F

        with N the charge, F the full well, r the read noise, G the gain factor, z standard normal: shot noise
        as a normal distribution, which above some 20 electrons it is.
        """
        charge = np.empty_like(rate_e_per_ms)
        highest = np.empty(len(charge), np.float32)
        capacity = _CAPACITY * self.full_well_e
        full_scale = 2**bits - 1
        out = np.empty(charge.shape, np.uint8 if bits == 8 else np.uint16)
        f32 = np.float32
        with kernels.LOCK:
            kernels.collect(
                *(rate_e_per_ms, veil_e_per_ms, f32(self.glare_share)),
                *(f32(self.dark_current_e_per_ms), f32(exposure_ms), charge, highest),
            )
            if highest.max() > capacity:
                kernels.bloom(charge, f32(capacity), f32(self.blooming_share))
            kernels.expose(
                *(charge, *_keys(self.seed, frame_key), kernels.NORMAL),
                f32(self.read_noise_e**2),
                f32(10 ** (gain_db / 20) * full_scale / self.full_well_e),
                *(f32(self.black_level_gray(bits)), f32(full_scale), out),
            )
        if self.hot_pixel_share:
            self._add_hot_pixels(out, full_scale)
        return out

    def _add_hot_pixels(
        self, picture: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"], full_scale: int
    ) -> None:
        random = np.random.default_rng(self.seed)
        where = random.integers(0, picture.size, round(self.hot_pixel_share * picture.size))
        picture.reshape(-1)[where] = full_scale


def _keys(seed: int, frame_key: int) -> tuple[np.uint32, np.uint32]:
    """Mix seed and frame into two independent 32-bit keys."""
    first, second = np.random.SeedSequence([seed, frame_key]).generate_state(2)
    return np.uint32(first), np.uint32(second)
