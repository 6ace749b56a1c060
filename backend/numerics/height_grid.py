"""A height map as a surface: a design from a file."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Shaped

from backend.numerics.errors import MirrorError


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights on a regular grid, its middle in the mirror's origin, cubic between its points."""

    spline: Any
    half_x_mm: float
    half_y_mm: float

    @classmethod
    def of(cls, heights_mm: Shaped[np.ndarray, "..."], pitch_mm: float) -> "HeightGrid":
        """Prepare a map whose rows go from the top (largest y) down.

        Raises
        ------
        MirrorError
            If it isn't a finite map of at least 4 x 4 points.
        """
        if heights_mm.ndim != 2 or min(heights_mm.shape) < 4:
            raise MirrorError(
                f"a height map of shape {heights_mm.shape} is no surface: give at least 4 x 4 heights"
            )
        if not np.isfinite(heights_mm).all():
            bad = int(np.count_nonzero(~np.isfinite(heights_mm)))
            raise MirrorError(f"the height map holds {bad} heights that aren't finite: fill them")
        # scipy.interpolate costs 0.1 s to import: only designs from files pay.
        from scipy.interpolate import RectBivariateSpline

        height, width = heights_mm.shape
        y = (np.arange(height) - (height - 1) / 2) * pitch_mm
        x = (np.arange(width) - (width - 1) / 2) * pitch_mm
        upwards = heights_mm[::-1].astype(np.float64)
        return cls(RectBivariateSpline(y, x, upwards), float(x[-1]), float(y[-1]))

    def slopes(
        self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n 2"]:
        """Return dz/dx and dz/dy; NaN outside of the map."""
        found = np.stack([self.spline.ev(y, x, dy=1), self.spline.ev(y, x, dx=1)], axis=1)
        return np.asarray(np.where(self._inside(x, y)[:, None], found, np.nan))

    def heights(
        self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n"]:
        """Return z in [mm]; NaN outside of the map."""
        return np.asarray(np.where(self._inside(x, y), self.spline.ev(y, x), np.nan))

    def _inside(self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> Any:
        return (np.abs(x) <= self.half_x_mm) & (np.abs(y) <= self.half_y_mm)
