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
    across = np.arange(width) / width
    along = np.arange(height)[:, None] / height
    surface = sum(c * t for c, t in zip(coefficients, _terms_list(across, along), strict=True))
    return np.broadcast_to(np.asarray(surface, np.float32), (height, width)).copy()


def _cell_medians(
    deviation: Float32[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    rows, columns = (max(1, n // CELL_PX) for n in deviation.shape)
    cells = deviation[: rows * CELL_PX, : columns * CELL_PX]
    if cells.shape != (rows * CELL_PX, columns * CELL_PX):
        return np.empty(0), np.empty(0), np.empty(0)
    split = cells.reshape(rows, CELL_PX, columns, CELL_PX).transpose(0, 2, 1, 3)
    blocks = split.reshape(rows * columns, CELL_PX * CELL_PX)
    known = np.flatnonzero(np.isfinite(blocks).mean(axis=1) >= _LEAST_SHARE)
    medians = np.nanmedian(blocks[known], axis=1).astype(np.float64)
    middle = CELL_PX / 2
    return known % columns * CELL_PX + middle, known // columns * CELL_PX + middle, medians


def _terms_list(
    x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
) -> tuple[Float[np.ndarray, "..."], ...]:
    return (np.ones_like(x), x, y, x * x, x * y, y * y)


def _terms(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 6"]:
    return np.stack(_terms_list(x, y), axis=1)


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
