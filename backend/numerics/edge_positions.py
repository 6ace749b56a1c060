"""Where each border between projector columns lies in each row of the camera (or rows in its columns), by equation 11."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, Shaped

from backend.numerics.errors import FrameError
from backend.numerics.kernels import (
    frame_stack,
    kernel,
    kernel_input,
    narrow_part,
    row_loop,
    wide_part,
)
from backend.numerics.line_shift import Stripes


class EdgePositions(NamedTuple):
    """Edges of shifted stripes in a camera's picture; column k belongs to the border u = k - 1/2."""

    position_px: Float32[np.ndarray, "h borders"]
    """Camera x of each border in each row; NaN where it isn't seen."""
    slope_gray_per_px: Float32[np.ndarray, "h borders"]
    """Steepness of pattern - inverse there, > 0; NaN likewise."""


def edge_positions(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    inverses: Sequence[Shaped[np.ndarray, "h w"]],
    stripes: Stripes,
    projector_px: Float32[np.ndarray, "h w"],
    *,
    size_px: int,
) -> EdgePositions:
    r"""Intersect pattern and inverse along each row of the camera.

    Parameters
    ----------
    patterns, inverses
        Pictures of the stripes at each shift, uint8 or uint16.
    stripes
        Where their edges are.
    projector_px
        Coordinate of each pixel as `decode_line_shift` finds it, NaN invalid: it says which border lies between
        two pixels, so each edge knows its absolute number.
    size_px
        Projector's width in [px]; there are size_px + 1 borders.

    Raises
    ------
    FrameError
        If pictures don't fit together.

    Notes
    -----
    Only between neighbours that both have a coordinate, at most half a period apart, so never across a jump.
    Where a row meets a border twice (a fold), the steeper edge counts. Standard deviation of a position:
    :math:`\sqrt{2} \sigma_I / |D'|` or less, see `interpolated_edge`.
    """
    stack = frame_stack([*patterns, *inverses])
    if projector_px.shape != stack.shape:
        raise FrameError(
            f"the coordinate is a map of {projector_px.shape}, the pictures are {stack.shape}: use both of one camera"
        )
    out = EdgePositions(
        *(np.full((stack.shape[0], size_px + 1), np.nan, np.float32) for _ in range(2))
    )
    _edge_rows(
        stack.addresses,
        stack.wide,
        stripes.shifts,
        float(stripes.first_edge_px),
        float(stripes.step_px),
        kernel_input(projector_px),
        *out,
    )
    return out


@row_loop
def _add_difference(pattern: Any, inverse: Any, out: Any) -> None:
    for i in range(out.size):
        out[i] = np.float32(pattern[i]) - np.float32(inverse[i])


@row_loop
def _edge_between(
    difference: Any, low: Any, high: Any, x: Any, first: Any, step: Any, position: Any, slope: Any
) -> None:
    """Place the borders between pixels x and x + 1, whose coordinates are low < high (or the other way round)."""
    shifts = difference.shape[0]
    begin = int(np.ceil((min(low, high) + 0.5 - first) / step))
    end = int(np.floor((max(low, high) + 0.5 - first) / step))
    for number in range(begin, end + 1):
        border = int(first + number * step)
        if border < 0 or border >= position.size:
            continue
        place = number % shifts
        # Near a pixel's centre the crossing may lie on its other side.
        for i in range(max(x - 1, 0), min(x + 2, difference.shape[1] - 1)):
            left, right = difference[place, i], difference[place, i + 1]
            if left * right < 0.0 or left == 0.0:
                steepness = abs(right - left)
                if not slope[border] >= steepness:
                    position[border] = i + left / (left - right)
                    slope[border] = steepness


@kernel
def _edge_rows(
    addresses: Any,
    wide: Any,
    shifts: Any,
    first: Any,
    step: Any,
    projector: Any,
    position: Any,
    slope: Any,
) -> None:
    height, width = projector.shape
    for row in numba.prange(height):
        difference = np.empty((shifts, width), np.float32)
        for m in range(shifts):
            p, q, start = addresses[m], addresses[shifts + m], row * width
            if wide:
                _add_difference(
                    wide_part(p, start, width), wide_part(q, start, width), difference[m]
                )
            else:
                _add_difference(
                    narrow_part(p, start, width), narrow_part(q, start, width), difference[m]
                )
        for x in range(width - 1):
            low, high = np.float64(projector[row, x]), np.float64(projector[row, x + 1])
            if abs(high - low) <= shifts * step:  # False with NaN
                _edge_between(difference, low, high, x, first, step, position[row], slope[row])


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    frames, place = [np.zeros((1, 2), np.uint8)] * 4, np.zeros((1, 2), np.float32)
    edge_positions(frames, frames, Stripes(0.0, 1.0, 4), place, size_px=8)
