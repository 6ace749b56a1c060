"""From slopes to the mirror's surface: heights, their departure from the design, and the terms they consist of."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from backend.domain.checks import Check, at_most
from backend.domain.errors import StageFailedError
from backend.domain.hints import Picture, Table, Value
from backend.domain.params import Params, setting
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.deflectometry import Surface as Polynomial
from backend.numerics.polynomial_terms import (
    fit_terms,
    height_terms,
    powers,
    zernike_list,
    zernike_terms,
)
from backend.numerics.slope_integration import integrate_slopes
from backend.stages.slopes import Slopes

_FIT_POINTS = 50_000
_LEAST_POINTS = 100


class SurfaceParams(Params):
    """How the surface is described."""

    zernike_order: int = setting(4, title="Order of Zernike terms", ge=1, le=10)
    polynomial_order: int = setting(2, title="Order of the polynomial", ge=1, le=8)
    without_tilt: bool = setting(True, title="Errors without tilt")
    """Take the best plane off the height errors: how a mirror is mounted is no error of its shape."""


@dataclass(frozen=True)
class ZernikeRow:
    """One Zernike term over the circle around the mirror."""

    number: int
    """As OSA and ANSI count."""
    n: int
    m: int
    name: str
    rms_um: float
    """Coefficient of the polynomial of rms 1."""


@dataclass(frozen=True)
class PolynomialRow:
    """One term of the height in metres over x and y in metres."""

    term: str
    coefficient: float


@dataclass(frozen=True)
class Surface:
    """The mirror's surface, in its own frame."""

    height_mm: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Height", unit="mm", colormap="turbo"),
    ]
    """NaN where unknown; 0 in the mirror's origin."""
    error_um: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Height error", unit="um", colormap="turbo"),
    ]
    """Height less design, its mean (and plane, by a setting) taken off."""
    zernike: Annotated[tuple[ZernikeRow, ...], Table("Zernike terms")]
    polynomial: Annotated[tuple[PolynomialRow, ...], Table("Polynomial")]
    error_rms_um: Annotated[float, Value("Height error, rms", unit="um")]
    error_span_um: Annotated[float, Value("Height error, highest to lowest", unit="um")]
    misfit_um: Annotated[float, Value("Slopes contradict each other by", unit="um")]
    """Rms, from one pixel to the next: noise of the slopes."""
    aperture_mm: Annotated[float, Value("Circle around the mirror, diameter", unit="mm")]
    camera: str


def _consistent(result: Surface, params: SurfaceParams) -> Check:
    value = result.misfit_um if np.isfinite(result.misfit_um) else 0.0
    return at_most(
        "slopes agree", value, warning=10.0, failure=1e9, unit="um",
        sentence=f"from pixel to pixel slopes contradict one surface by {value:.3g} um",
    )  # fmt: skip


@stage(title="Surface", version=1, review=Review.ALWAYS, checks=(_consistent,))
def surface(slopes: Slopes, params: SurfaceParams, progress: Progress) -> Surface:
    """Integrate the slopes over the mirror, whatever its outline, by least squares."""
    name = slopes.camera
    points = slopes.points_mm[name].astype(np.float64)
    x, y = points[..., 0], points[..., 1]
    known = np.isfinite(x) & np.isfinite(slopes.slope_x_mrad[name])
    if np.count_nonzero(known) < _LEAST_POINTS:
        raise StageFailedError(
            f"{np.count_nonzero(known)} pixels have slopes, too few for a surface: look at why others are missing."
        )
    # What is left beside the fitted polynomial is small, and so are the trapezoid rule's and the solver's errors.
    base = Polynomial(slopes.coefficients)
    along = base.slopes(x[known], y[known])
    rest = integrate_slopes(
        x,
        y,
        _less(slopes.slope_x_mrad[name], known, along[:, 0]),
        _less(slopes.slope_y_mrad[name], known, along[:, 1]),
    )
    progress(0.7, "terms")
    height = rest.height_mm
    height[known] += base.heights(x[known], y[known])
    # Slopes don't tell heights: those at which the rays were met do.
    height += np.nanmedian(points[..., 2] - height)
    error = 1e3 * (height - slopes.design_mm[name])
    error = _levelled(error, x, y, params.without_tilt)
    finite = error[np.isfinite(error)]
    centre, radius = _circle(x[known], y[known])
    return Surface(
        height_mm={name: height.astype(np.float32)},
        error_um={name: error.astype(np.float32)},
        zernike=_zernike(height, x, y, centre, radius, params.zernike_order),
        polynomial=_polynomial(height, x, y, params.polynomial_order),
        error_rms_um=float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan"),
        error_span_um=float(np.ptp(finite)) if finite.size else float("nan"),
        misfit_um=1e3 * rest.misfit_mm,
        aperture_mm=2 * radius,
        camera=name,
    )


def _less(
    slope_mrad: Float32[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    base: Float64[np.ndarray, "n"],
) -> Float64[np.ndarray, "h w"]:
    left = np.full(known.shape, np.nan)
    left[known] = 1e-3 * slope_mrad[known].astype(np.float64) - base
    return left


def _levelled(
    error: Float64[np.ndarray, "h w"],
    x: Float64[np.ndarray, "h w"],
    y: Float64[np.ndarray, "h w"],
    tilt: bool,
) -> Float64[np.ndarray, "h w"]:
    """Take off the mean, and the best plane."""
    known = np.isfinite(error)
    if not known.any():
        return error
    terms = height_terms(x[known], y[known], 1 if tilt else 0)
    error[known] -= terms @ fit_terms(terms, error[known])
    return error


def _circle(
    x: Float64[np.ndarray, "n"], y: Float64[np.ndarray, "n"]
) -> tuple[tuple[float, float], float]:
    """Return a circle around all points: middle of their extent, and the farthest point."""
    centre = float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2
    return centre, float(np.hypot(x - centre[0], y - centre[1]).max())


def _sample(
    height: Float64[np.ndarray, "h w"],
    x: Float64[np.ndarray, "h w"],
    y: Float64[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    places = np.flatnonzero(np.isfinite(height))
    places = places[:: 1 + places.size // _FIT_POINTS]
    return x.ravel()[places], y.ravel()[places], height.ravel()[places]


def _zernike(
    height: Float64[np.ndarray, "h w"],
    x: Float64[np.ndarray, "h w"],
    y: Float64[np.ndarray, "h w"],
    centre: tuple[float, float],
    radius: float,
    order: int,
) -> tuple[ZernikeRow, ...]:
    at_x, at_y, z = _sample(height, x, y)
    terms = zernike_terms((at_x - centre[0]) / radius, (at_y - centre[1]) / radius, order)
    found = 1e3 * fit_terms(terms, z)
    return tuple(
        ZernikeRow(t.number, t.n, t.m, t.name, float(value))
        for t, value in zip(zernike_list(order), found, strict=True)
    )


def _polynomial(
    height: Float64[np.ndarray, "h w"],
    x: Float64[np.ndarray, "h w"],
    y: Float64[np.ndarray, "h w"],
    order: int,
) -> tuple[PolynomialRow, ...]:
    at_x, at_y, z = _sample(height, x, y)
    found = fit_terms(height_terms(1e-3 * at_x, 1e-3 * at_y, order), 1e-3 * z)
    return tuple(
        PolynomialRow(_term(i, j), float(value))
        for (i, j), value in zip(powers(order), found, strict=True)
    )


def _term(i: int, j: int) -> str:
    parts = [n if p == 1 else f"{n}^{p}" for n, p in (("x", i), ("y", j)) if p]
    return " ".join(parts) or "1"
