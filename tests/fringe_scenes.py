"""Noisy fringe frames of a known scene, for the tests of decoding."""

from dataclasses import dataclass

import numpy as np

from backend.numerics.sine_code import SineCode


@dataclass(frozen=True)
class Scene:
    """Position in [0, 1), modulation and mean of each pixel, at an exposure of 1 ms."""

    x: np.ndarray
    modulation_gray: np.ndarray | float = 70.0
    mean_gray: np.ndarray | float = 100.0

    def frames(
        self,
        code: SineCode,
        *,
        exposure_ms: float = 1.0,
        sigma_gray: float = 0.0,
        gray_per_e: float = 0.0,
        black_gray: float = 0.0,
        seed: int = 0,
        dtype: type = np.uint8,
        full_scale_gray: int = 255,
    ) -> list[np.ndarray]:
        """Take pictures with read and photon noise, rounded and clipped."""
        rng = np.random.default_rng(seed)
        frames: list[np.ndarray] = []
        for periods, shifts_rad in zip(code.periods, code.shifts_rad, strict=True):
            for shift_rad in shifts_rad:
                light = exposure_ms * (
                    self.mean_gray
                    + self.modulation_gray * np.cos(2 * np.pi * periods * self.x + shift_rad)
                )
                sigma = np.sqrt(sigma_gray**2 + gray_per_e * np.maximum(light, 0))
                gray = black_gray + light + sigma * rng.standard_normal(self.x.shape)
                frames.append(np.clip(np.rint(gray), 0, full_scale_gray).astype(dtype))
        return frames


def ramp(height: int = 40, width: int = 2500, low: float = 0.01, high: float = 0.99) -> np.ndarray:
    """Positions that go from left to right, a little different in every row."""
    rows = np.linspace(0, 1, height)[:, np.newaxis] / width
    return np.clip(np.linspace(low, high, width)[np.newaxis, :] + (high - low) * rows, low, high)
