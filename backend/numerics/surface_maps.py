"""Maps of a mirror's surface: curvature from its slopes, and what differs from the surroundings."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64


class Curvature(NamedTuple):
    """Curvature of a surface in 1/mm; 1/(2 f) for a mirror of focal length f."""

    mean: Float64[np.ndarray, "_h _w"]
    """Half the sum of the second derivatives by x and y; NaN where unknown."""
    twist: Float64[np.ndarray, "_h _w"]
    """The mixed derivative."""


def curvature(
    x_mm: Float[np.ndarray, "h w"],
    y_mm: Float[np.ndarray, "h w"],
    slope_x: Float[np.ndarray, "h w"],
    slope_y: Float[np.ndarray, "h w"],
    *,
    sigma_px: float = 2.0,
) -> Curvature:
    r"""Differentiate slopes, smoothed by a Gaussian.

    Parameters
    ----------
    x_mm, y_mm
        Where each pixel lies on the surface.
    slope_x, slope_y
        dz/dx and dz/dy there; NaN where unknown.
    sigma_px
        Standard deviation of the Gaussian in [px], > 0.

    Notes
    -----
    Per pixel a weighted least-squares plane is fitted to each map over pixels; from those of x and y follows
    :math:`J = \partial (x, y) / \partial (u, v)`, and the second derivatives are
    :math:`\partial s / \partial (u, v) \; J^{-1}`. Noise of the slopes :math:`\sigma_s` becomes about
    :math:`0.2\, \sigma_s / (\mathrm{sigma}^2 d)` for pixels d mm apart.
    """
    valid = np.isfinite(x_mm) & np.isfinite(y_mm) & np.isfinite(slope_x) & np.isfinite(slope_y)
    planes = _Planes(valid, sigma_px)
    (x_u, x_v), (y_u, y_v) = planes.gradient(x_mm), planes.gradient(y_mm)
    (sx_u, sx_v), (sy_u, sy_v) = planes.gradient(slope_x), planes.gradient(slope_y)
    with np.errstate(divide="ignore", invalid="ignore"):
        area = x_u * y_v - x_v * y_u
        xx = (sx_u * y_v - sx_v * y_u) / area
        xy = (sx_v * x_u - sx_u * x_v) / area
        yx = (sy_u * y_v - sy_v * y_u) / area
        yy = (sy_v * x_u - sy_u * x_v) / area
    missing = ~valid | ~np.isfinite(area)
    mean, twist = 0.5 * (xx + yy), 0.5 * (xy + yx)
    mean[missing] = np.nan
    twist[missing] = np.nan
    return Curvature(mean, twist)


def smoothed(values: Float[np.ndarray, "h w"], *, sigma_px: float) -> Float64[np.ndarray, "h w"]:
    """Smooth a map by planes fitted to each pixel's surroundings, without bending it at the mask's edges."""
    return _Planes(np.isfinite(values), sigma_px).smooth(values.astype(np.float64))


class _Planes:
    """Weighted planes through the neighbourhood of every pixel of a mask."""

    def __init__(self, valid: Bool[np.ndarray, "h w"], sigma_px: float) -> None:
        radius = max(1, int(np.ceil(2.5 * sigma_px)))
        offset = np.arange(-radius, radius + 1, dtype=np.float64)
        weight = np.exp(-0.5 * (offset / sigma_px) ** 2)
        weight /= weight.sum()
        self._kernels = (weight, weight * offset, weight * offset**2)
        self._valid = valid
        ones = valid.astype(np.float64)
        self._n = self._sum(ones, 0, 0)
        self._u, self._v = self._sum(ones, 1, 0), self._sum(ones, 0, 1)
        self._uu, self._uv = self._sum(ones, 2, 0), self._sum(ones, 1, 1)
        self._vv = self._sum(ones, 0, 2)

    def gradient(
        self, values: Float[np.ndarray, "h w"]
    ) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """Return the planes' slopes along columns u and rows v."""
        filled = np.where(self._valid, values, 0.0)
        z = self._sum(filled, 0, 0)
        zu, zv = self._sum(filled, 1, 0), self._sum(filled, 0, 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            uu = self._uu - self._u * self._u / self._n
            uv = self._uv - self._u * self._v / self._n
            vv = self._vv - self._v * self._v / self._n
            zu, zv = zu - z * self._u / self._n, zv - z * self._v / self._n
            scale = uu * vv - uv * uv
            thin = ~(scale > 1e-3 * self._n**2)
            by_u, by_v = (zu * vv - zv * uv) / scale, (zv * uu - zu * uv) / scale
        by_u[thin] = np.nan
        by_v[thin] = np.nan
        return by_u, by_v

    def smooth(self, values: Float[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
        """Return the planes' values in their middle."""
        by_u, by_v = self.gradient(values)
        mean = self._sum(np.where(self._valid, values, 0.0), 0, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = (mean - by_u * self._u - by_v * self._v) / self._n
        found[~self._valid] = np.nan
        return np.asarray(found)

    def _sum(
        self, values: Float64[np.ndarray, "h w"], power_u: int, power_v: int
    ) -> Float64[np.ndarray, "h w"]:
        return np.asarray(
            cv2.sepFilter2D(
                values,
                cv2.CV_64F,
                self._kernels[power_u],
                self._kernels[power_v],
                borderType=cv2.BORDER_CONSTANT,
            )
        )


def against_surroundings(
    values: Float[np.ndarray, "h w"], *, radius_px: float
) -> Float32[np.ndarray, "h w"]:
    """Divide each value by the mean of its surroundings, less one: what differs shows, shading doesn't.

    Parameters
    ----------
    values
        A positive map; NaN where unknown.
    radius_px
        Standard deviation of the Gaussian that says what surroundings are, in [px].

    Returns
    -------
    Share by which a pixel departs from its surroundings, 0 for none; NaN where unknown.
    """
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0).astype(np.float32)
    # A wide Gaussian on the full picture costs seconds; it is smooth, so a small picture does.
    shrink = max(1, int(radius_px // 4))
    size = (max(1, values.shape[1] // shrink), max(1, values.shape[0] // shrink))
    parts = []
    for part in (filled, known.astype(np.float32)):
        small = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(small, (0, 0), radius_px / shrink)
        parts.append(cv2.resize(smooth, values.shape[::-1], interpolation=cv2.INTER_LINEAR))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = filled * parts[1] / parts[0] - 1.0
    share[~known] = np.nan
    return np.asarray(share, np.float32)
