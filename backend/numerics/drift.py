"""The slow part of a map of deviations: what an imperfect calibration adds, not what single pixels do."""

import numpy as np
from jaxtyping import Float, Float32

CELL_PX = 32
_LEAST_SHARE = 0.25
"""Share of a cell's pixels that have to be known for its median to count."""
_LEAST_CELLS = 12
_ROUNDS = 10


def smooth_drift(deviation: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    r"""Fit a quadratic surface to a map of deviations, robustly.

    Parameters
    ----------
    deviation
        Map of any unit, NaN unknown.

    Returns
    -------
    The surface at every pixel, float32, in the unit of the map; 0 everywhere if fewer than 12 cells
    of 32x32 px are known.

    Notes
    -----
    Medians of cells are fitted by least squares with Cauchy weights, whose scale is the median absolute residual:
    a part that is wrong as a whole (an inter-reflection) has no say as long as it covers fewer than half of the cells.
    """
    height, width = deviation.shape
    x, y, values = _cell_medians(deviation)
    if values.size < _LEAST_CELLS:
        return np.zeros((height, width), np.float32)
    terms = _terms(x / width, y / height)
    coefficients = _robust_fit(terms, values)
    return _surface(coefficients, height, width)


def _surface(
    coefficients: Float[np.ndarray, "6"], height: int, width: int
) -> Float32[np.ndarray, "h w"]:
    """Evaluate 1, x, y, x^2, x y, y^2 at every pixel: a term per column, a term per row, one product."""
    c = coefficients
    x = np.arange(width) / width
    y = np.arange(height) / height
    per_column = (c[0] + c[1] * x + c[3] * x * x).astype(np.float32)
    per_row = (c[2] * y + c[5] * y * y).astype(np.float32)
    surface = np.multiply.outer((c[4] * y).astype(np.float32), x.astype(np.float32))
    surface += per_column
    surface += per_row[:, None]
    return np.asarray(surface)


def _cell_medians(
    deviation: Float32[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    rows, columns = (max(1, n // CELL_PX) for n in deviation.shape)
    # Every second pixel each way is enough for a median, and a quarter of the work.
    cells = deviation[: rows * CELL_PX : 2, : columns * CELL_PX : 2]
    side = CELL_PX // 2
    if cells.shape != (rows * side, columns * side):
        return np.empty(0), np.empty(0), np.empty(0)
    split = cells.reshape(rows, side, columns, side).transpose(0, 2, 1, 3)
    blocks = split.reshape(rows * columns, side * side)
    known = np.flatnonzero(np.isfinite(blocks).mean(axis=1) >= _LEAST_SHARE)
    medians = np.nanmedian(blocks[known], axis=1).astype(np.float64)
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
