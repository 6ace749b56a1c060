"""The slow part of a map of deviations: what an imperfect calibration adds, not what single pixels do."""

from typing import Any

import numba
import numpy as np
from jaxtyping import Float, Float32

from backend.numerics.kernels import kernel, row_loop

CELL_PX = 32
_EVERY_PX = 4
_LEAST_SHARE = 0.25
"""Share of a cell's pixels that have to be known for its median to count."""
_LEAST_CELLS = 12
_ROUNDS = 10


def take_off_drift(deviation: Float32[np.ndarray, "h w"]) -> Float[np.ndarray, "6"]:
    r"""Fit a quadratic surface to a map of deviations, robustly, and subtract it in place.

    Parameters
    ----------
    deviation
        Map of any unit, NaN unknown; changed in place.

    Returns
    -------
    Coefficients of 1, x, y, x^2, x y, y^2 in the unit of the map, with x and y in widths and heights of the map; all
    0 if fewer than 12 cells of 32x32 px are known.

    Notes
    -----
    Medians of cells are fitted by least squares with Cauchy weights, whose scale is the median absolute residual:
    a part that is wrong as a whole (an inter-reflection) has no say as long as it covers fewer than half of the cells.
    """
    height, width = deviation.shape
    x, y, values = _cell_medians(deviation)
    if values.size < _LEAST_CELLS:
        return np.zeros(6)
    coefficients = _robust_fit(_terms(x / width, y / height), values)
    _subtract_rows(deviation, coefficients)
    return coefficients


@row_loop
def _subtract_row(row: Any, constant: Any, slope: Any, curvature: Any) -> Any:
    for i in range(row.size):
        x = np.float32(i)
        row[i] -= constant + x * (slope + x * curvature)


@kernel
def _subtract_rows(deviation: Any, c: Any) -> None:
    height, width = deviation.shape
    for row in numba.prange(height):
        y = row / height
        _subtract_row(
            deviation[row],
            np.float32(c[0] + y * (c[2] + y * c[5])),
            np.float32((c[1] + y * c[4]) / width),
            np.float32(c[3] / width / width),
        )


def _cell_medians(
    deviation: Float32[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    rows, columns = (n // CELL_PX for n in deviation.shape)
    medians = np.empty((rows, columns), np.float32)
    _median_rows(deviation, medians)
    y, x = np.nonzero(np.isfinite(medians))
    middle = CELL_PX / 2
    return x * CELL_PX + middle, y * CELL_PX + middle, medians[y, x].astype(np.float64)


@row_loop
def _median_of_cell(values: Any, y: Any, x: Any, found: Any) -> Any:
    """Return the median of every fourth pixel each way, a sixteenth of the work; NaN if too few are known."""
    count = 0
    for j in range(y, y + CELL_PX, _EVERY_PX):
        for i in range(x, x + CELL_PX, _EVERY_PX):
            value = values[j, i]
            if value == value:  # NaN doesn't equal itself
                found[count] = value
                count += 1
    if count < _LEAST_SHARE * found.size:
        return np.float32(np.nan)
    return np.float32(np.median(found[:count]))


@kernel
def _median_rows(values: Any, medians: Any) -> None:
    for row in numba.prange(medians.shape[0]):
        found = np.empty((CELL_PX // _EVERY_PX) ** 2, np.float32)
        for column in range(medians.shape[1]):
            medians[row, column] = _median_of_cell(values, row * CELL_PX, column * CELL_PX, found)


def _terms(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 6"]:
    return np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), axis=1)


def _robust_fit(
    terms: Float[np.ndarray, "n 6"], values: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "6"]:
    coefficients = np.zeros(6)
    coefficients[0] = np.median(values)
    for _ in range(_ROUNDS):
        residuals = values - terms @ coefficients
        scale = max(1.4826 * float(np.median(np.abs(residuals))), 1e-9)
        weights = 1.0 / (1.0 + (residuals / (2.0 * scale)) ** 2)
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0]
    return coefficients
