"""The shape of a screen: from a position in the pattern to a point in space."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from backend.numerics.errors import ScreenError

_FLAT_SHARE = 1e-6
"""A screen that departs from an affine map by less than this part of its size is flat and even."""

_MARGIN_SHARE = 0.01
"""How far beyond its known points an even screen is continued."""


@dataclass(frozen=True, eq=False)
class ScreenSurface:
    """A prepared screen; `screen_surface` makes it."""

    affine: Float64[np.ndarray, "3 3"] | None
    """Point in mm = (x, y, 1) @ affine, for screens that are flat and even; else None."""
    low: Float64[np.ndarray, "2"]
    high: Float64[np.ndarray, "2"]
    """Positions between which the screen is known."""
    interpolate: Any
    """Linear interpolation on a triangulation of the known points; None for even screens."""

    def points(self, shares: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Return the points in [mm] of positions in the pattern; NaN beyond the known part and for NaN."""
        if self.affine is None:
            return np.asarray(self.interpolate(shares), np.float64)
        points = shares @ self.affine[:2] + self.affine[2]
        known = (shares >= self.low - _MARGIN_SHARE) & (shares <= self.high + _MARGIN_SHARE)
        points[~known.all(axis=1)] = np.nan
        return np.asarray(points, np.float64)

    @property
    def middle_mm(self) -> Float64[np.ndarray, "3"]:
        """The point in the middle of the known part."""
        return np.asarray(self.points(((self.low + self.high) / 2)[None, :])[0])


def screen_surface(
    shares: Float[np.ndarray, "n 2"], points_mm: Float[np.ndarray, "n 3"]
) -> ScreenSurface:
    """Prepare a screen from measured points.

    Parameters
    ----------
    shares
        Positions in the pattern, x and y in [0, 1]: a regular grid or not; four corners do for a flat screen.
    points_mm
        The same points in space in [mm], in the screen's frame.

    Raises
    ------
    ScreenError
        If there are fewer than three points, one isn't finite, or all lie on one line.

    Notes
    -----
    A screen that an affine map describes to a millionth of its size is that map; any other is
    interpolated linearly in the triangles of a Delaunay triangulation of the positions.
    """
    _check(shares, points_mm)
    design = np.column_stack([shares, np.ones(len(shares))])
    affine = np.linalg.lstsq(design, points_mm, rcond=None)[0]
    size_mm = float(np.ptp(points_mm, axis=0).max())
    low, high = shares.min(axis=0), shares.max(axis=0)
    if np.abs(design @ affine - points_mm).max() <= _FLAT_SHARE * size_mm:
        return ScreenSurface(np.asarray(affine, np.float64), low, high, None)
    # scipy.interpolate costs 0.1 s to import: only measured screens pay.
    from scipy.interpolate import LinearNDInterpolator

    return ScreenSurface(None, low, high, LinearNDInterpolator(shares, points_mm))


def _check(shares: Float[np.ndarray, "n 2"], points_mm: Float[np.ndarray, "n 3"]) -> None:
    if len(shares) < 3:
        raise ScreenError(
            f"a screen of {len(shares)} points has no shape: give its four corners or a measured grid"
        )
    bad = ~(np.isfinite(shares).all(axis=1) & np.isfinite(points_mm).all(axis=1))
    if bad.any():
        raise ScreenError(
            f"the screen's grid holds {np.count_nonzero(bad)} of {len(bad)} points that aren't finite "
            f"(the first is number {int(np.argmax(bad))}): measure them again or take them out"
        )
    spread = np.linalg.svd(shares - shares.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-9 * max(1.0, spread[0]):
        raise ScreenError(
            f"the {len(shares)} points of the screen lie on one line of the pattern: give points apart in x and y"
        )
