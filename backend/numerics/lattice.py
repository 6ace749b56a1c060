"""Smooth two-valued maps kept on a coarse lattice: rays and rectifying maps without their memory."""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Float32

from backend.numerics.kernels import kernel, row_loop

LATTICE_STEP = 16
"""Pixels between nodes: a lens of 1 % distortion is interpolated to 1e-6 px."""


class Lattice(NamedTuple):
    """A smooth map from pixels to two values, sampled every `LATTICE_STEP` pixels."""

    nodes: Float[np.ndarray, "2 node_rows node_columns"]
    """Values at the nodes, float64; the last nodes lie at or beyond the last pixels."""
    width_px: int
    height_px: int

    def map(self) -> Float32[np.ndarray, "2 h w"]:
        """Interpolate all pixels, float32."""
        out = np.empty((2, self.height_px, self.width_px), np.float32)
        _fill(self.nodes, out)
        return out


def lattice_positions(
    width_px: int, height_px: int
) -> tuple[Float[np.ndarray, "node_columns"], Float[np.ndarray, "node_rows"]]:
    """Return the nodes' x and y in [px]: at least four each, so that a cubic fits."""
    columns = max(int(np.ceil((width_px - 1) / LATTICE_STEP)) + 1, 4)
    rows = max(int(np.ceil((height_px - 1) / LATTICE_STEP)) + 1, 4)
    return np.arange(columns) * float(LATTICE_STEP), np.arange(rows) * float(LATTICE_STEP)


@row_loop
def _lagrange(position: Any, number: Any) -> Any:
    """Return the first of four nodes and the weights of the cubic through them."""
    first = min(max(int(position) - 1, 0), number - 4)
    t = position - first
    w0 = -(t - 1.0) * (t - 2.0) * (t - 3.0) / 6.0
    w1 = t * (t - 2.0) * (t - 3.0) / 2.0
    w2 = -t * (t - 1.0) * (t - 3.0) / 2.0
    w3 = t * (t - 1.0) * (t - 2.0) / 6.0
    return first, w0, w1, w2, w3


@row_loop
def _across(nodes: Any, y: Any, out: Any) -> Any:
    """Interpolate the nodes of one row of pixels."""
    first, w0, w1, w2, w3 = _lagrange(y / LATTICE_STEP, nodes.shape[0])
    for column in range(nodes.shape[1]):
        out[column] = (
            w0 * nodes[first, column]
            + w1 * nodes[first + 1, column]
            + w2 * nodes[first + 2, column]
            + w3 * nodes[first + 3, column]
        )


@row_loop
def _span(c0: Any, c1: Any, c2: Any, c3: Any, start: Any, out: Any) -> Any:
    """Evaluate one cubic on the pixels of one lattice cell."""
    for i in range(out.size):
        t = (start + i) * (1.0 / LATTICE_STEP)
        out[i] = c0 + t * (c1 + t * (c2 + t * c3))


@row_loop
def lattice_row(nodes: Any, y: Any, work: Any, out: Any) -> Any:
    """Interpolate row y of one map into `out`; `work` holds one value per node column."""
    _across(nodes, y, work)
    width = out.size
    number = nodes.shape[1]
    for cell in range((width + LATTICE_STEP - 1) // LATTICE_STEP):
        first = min(max(cell - 1, 0), number - 4)
        a, b, c, d = work[first], work[first + 1], work[first + 2], work[first + 3]
        # the cubic through (0, a) (1, b) (2, c) (3, d) in powers of t
        c1 = (-11.0 * a + 18.0 * b - 9.0 * c + 2.0 * d) / 6.0
        c2 = (2.0 * a - 5.0 * b + 4.0 * c - d) / 2.0
        c3 = (-a + 3.0 * b - 3.0 * c + d) / 6.0
        begin = cell * LATTICE_STEP
        end = min(begin + LATTICE_STEP, width)
        _span(a, c1, c2, c3, begin - first * LATTICE_STEP, out[begin:end])


@row_loop
def lattice_point(nodes: Any, x: Any, y: Any) -> Any:
    """Interpolate one map at one position, for positions that don't follow a row."""
    row, v0, v1, v2, v3 = _lagrange(y / LATTICE_STEP, nodes.shape[0])
    column, w0, w1, w2, w3 = _lagrange(x / LATTICE_STEP, nodes.shape[1])
    total = 0.0
    for k, weight in enumerate((v0, v1, v2, v3)):
        total += weight * (
            w0 * nodes[row + k, column]
            + w1 * nodes[row + k, column + 1]
            + w2 * nodes[row + k, column + 2]
            + w3 * nodes[row + k, column + 3]
        )
    return total


@kernel
def _fill(nodes: Any, out: Any) -> None:
    for y in numba.prange(out.shape[1]):
        work = np.empty(nodes.shape[2], np.float64)
        lattice_row(nodes[0], y, work, out[0, y])
        lattice_row(nodes[1], y, work, out[1, y])
