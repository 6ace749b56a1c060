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
    rows, columns = (max(1, n // CELL_PX) for n in deviation.shape)
    # Every fourth pixel each way is enough for a median, and a sixteenth of the work.
    cells = deviation[: rows * CELL_PX : _EVERY_PX, : columns * CELL_PX : _EVERY_PX]
    side = CELL_PX // _EVERY_PX
    if cells.shape != (rows * side, columns * side):
        return np.empty(0), np.empty(0), np.empty(0)
    split = cells.reshape(rows, side, columns, side).transpose(0, 2, 1, 3)
    blocks = split.reshape(rows * columns, side * side)
    count = np.isfinite(blocks).sum(axis=1)
    known = np.flatnonzero(count >= _LEAST_SHARE * side * side)
    ordered, count = np.sort(blocks[known], axis=1), count[known]  # NaN last
    cell = np.arange(known.size)
    medians = (ordered[cell, (count - 1) // 2] + ordered[cell, count // 2]) / 2.0
    middle = CELL_PX / 2
    return known % columns * CELL_PX + middle, known // columns * CELL_PX + middle, medians


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
