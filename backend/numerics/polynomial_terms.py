"""Surfaces as sums of terms: powers of x and y, and Zernike polynomials."""

from math import factorial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64


def powers(order: int) -> tuple[tuple[int, int], ...]:
    """List the exponents (of x, of y) of all terms up to an order: 1 x x^2 y xy y^2 for order 2.

    Examples
    --------
    >>> powers(2)
    ((0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2))
    """
    return tuple((i, j) for j in range(order + 1) for i in range(order + 1 - j))


def order_of(terms: int) -> int:
    """Return the order whose polynomials have so many terms: 6 terms are order 2."""
    return round((float(np.sqrt(8 * terms + 1)) - 3) / 2)


def height_terms(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], order: int
) -> Float64[np.ndarray, "n terms"]:
    """Evaluate every term at every point, in the order of `powers`."""
    x_powers, y_powers = _power_table(x, order), _power_table(y, order)
    return np.stack([x_powers[i] * y_powers[j] for i, j in powers(order)], axis=1)


def slope_terms(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], order: int
) -> tuple[Float64[np.ndarray, "n terms"], Float64[np.ndarray, "n terms"]]:
    """Evaluate the derivatives by x and by y of every term at every point."""
    x_powers, y_powers = _power_table(x, order), _power_table(y, order)
    by_x = [i * x_powers[max(i - 1, 0)] * y_powers[j] for i, j in powers(order)]
    by_y = [j * x_powers[i] * y_powers[max(j - 1, 0)] for i, j in powers(order)]
    return np.stack(by_x, axis=1), np.stack(by_y, axis=1)


def _power_table(values: Float[np.ndarray, "n"], order: int) -> list[Float64[np.ndarray, "n"]]:
    table = [np.ones(values.shape, np.float64)]
    for _ in range(order):
        table.append(table[-1] * values)
    return table


def evaluate(
    coefficients: Float[np.ndarray, "terms"], x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]
) -> Float64[np.ndarray, "n"]:
    """Sum up a polynomial at every point, by Horner's scheme: no table of terms.

    Examples
    --------
    >>> evaluate(np.array([1.0, 0.0, 3.0, 0.0, 0.0, 0.5]), np.array([2.0]), np.array([4.0])).tolist()
    [21.0]
    """
    order = order_of(coefficients.size)
    ends = np.cumsum([order + 1 - j for j in range(order + 1)])
    total = np.zeros(x.shape)
    for j in reversed(range(order + 1)):
        row = coefficients[ends[j] - (order + 1 - j) : ends[j]]
        along = np.full(x.shape, row[-1])
        for coefficient in row[-2::-1]:
            along *= x
            along += coefficient
        total *= y
        total += along
    return total


def derivatives(
    coefficients: Float[np.ndarray, "terms"],
) -> tuple[Float64[np.ndarray, "fewer"], Float64[np.ndarray, "fewer"]]:
    """Return the coefficients of the derivatives by x and by y, one order lower.

    Examples
    --------
    >>> by_x, by_y = derivatives(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    >>> by_x.tolist(), by_y.tolist()
    ([2.0, 6.0, 5.0], [4.0, 5.0, 12.0])
    """
    order = order_of(coefficients.size)
    known = dict(zip(powers(order), coefficients.tolist(), strict=True))
    lower = powers(order - 1)
    by_x = [(i + 1) * known[i + 1, j] for i, j in lower]
    by_y = [(j + 1) * known[i, j + 1] for i, j in lower]
    return np.array(by_x), np.array(by_y)


class ZernikeTerm(NamedTuple):
    """One Zernike polynomial, as OSA and ANSI number them."""

    number: int
    n: int
    m: int
    name: str


_NAMES = {
    (0, 0): "piston", (1, -1): "tilt y", (1, 1): "tilt x", (2, -2): "astigmatism 45 deg", (2, 0): "defocus",
    (2, 2): "astigmatism 0 deg", (3, -3): "trefoil y", (3, -1): "coma y", (3, 1): "coma x", (3, 3): "trefoil x",
    (4, -4): "quadrafoil y", (4, -2): "secondary astigmatism 45 deg", (4, 0): "spherical",
    (4, 2): "secondary astigmatism 0 deg", (4, 4): "quadrafoil x",
}  # fmt: skip


def zernike_list(order: int) -> tuple[ZernikeTerm, ...]:
    """List the Zernike polynomials up to a radial order."""
    pairs = [(n, m) for n in range(order + 1) for m in range(-n, n + 1, 2)]
    return tuple(
        ZernikeTerm(number, n, m, _NAMES.get((n, m), "")) for number, (n, m) in enumerate(pairs)
    )


def zernike_terms(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], order: int
) -> Float64[np.ndarray, "n terms"]:
    r"""Evaluate Zernike polynomials on the unit disc, each of rms 1 over it.

    Notes
    -----
    :math:`Z_n^m = N_n^m R_n^{|m|}(\rho) \cos m\theta` (sine for m < 0) with
    :math:`N = \sqrt{n + 1}` for m = 0 and :math:`\sqrt{2 (n + 1)}` otherwise.

    References
    ----------
    .. [1] ANSI Z80.28, "Methods of reporting optical aberrations of eyes" (2017).
    """
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    columns = []
    for term in zernike_list(order):
        size = abs(term.m)
        scale = np.sqrt((term.n + 1) * (1 if term.m == 0 else 2))
        turn = np.sin(size * angle) if term.m < 0 else np.cos(size * angle)
        columns.append(scale * _radial(term.n, size, radius) * turn)
    return np.stack(columns, axis=1)


def _radial(n: int, m: int, radius: Float[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    total = np.zeros(radius.shape, np.float64)
    for k in range((n - m) // 2 + 1):
        weight = (-1) ** k * factorial(n - k)
        weight //= factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        total += weight * radius ** (n - 2 * k)
    return total


def fit_terms(
    terms: Float[np.ndarray, "n terms"], values: Float[np.ndarray, "n"]
) -> Float64[np.ndarray, "terms"]:
    """Fit values by a sum of terms, least squares; terms that the points can't tell apart share their part."""
    scale = np.sqrt((terms**2).mean(axis=0)) + 1e-300
    scaled = terms / scale
    # A QR of n x terms costs memory for millions of points; the terms are scaled, 15 digits do.
    normal = scaled.T @ scaled
    found = np.linalg.lstsq(normal, scaled.T @ values, rcond=1e-13)[0]
    return np.asarray(found / scale)
