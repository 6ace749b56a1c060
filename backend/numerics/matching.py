"""Partners in two cameras: equal projector coordinate on the epipolar line, sub-pixel, checked both ways."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt16

from backend.numerics.errors import MatchingError
from backend.numerics.kernels import kernel_input
from backend.numerics.lattice import Lattice
from backend.numerics.matching_index import SPARE_CELLS, index_rows
from backend.numerics.matching_kernels import (
    CHECKED_ROWS,
    Index,
    Limits,
    match_rows,
    sample_rows,
)
from backend.numerics.rectification import Canvas, Rectification


class MatchSettings(NamedTuple):
    """When two pixels are partners."""

    jump_px: float | None = None
    """Neighbouring pixels whose coordinate differs by more are not one surface. None: 5 times the median step."""
    agreement_px: float = 2.0
    """A partner has to lead back to within this distance, in [px] of the rectified plane."""


class Matches(NamedTuple):
    """Where each pixel of the reference camera is seen by the other; NaN where it isn't."""

    x_other_px: Float32[np.ndarray, "h w"]
    """Rectified x of the partner."""
    sigma_disparity_px: Float32[np.ndarray, "h w"]
    """Standard deviation of the difference of both rectified x, from the noise of both coordinates."""
    reasons: UInt16[np.ndarray, "h w"]
    """Why a pixel with a coordinate has no partner: `Reason` bits; 0 where the coordinate itself is missing."""


_DEFAULTS = MatchSettings()
_JUMP_STEPS = 5.0
_CELLS_MAX = 4


def match(
    reference_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h2 w2"],
    rectification: Rectification,
    *,
    sigma_reference_px: Float32[np.ndarray, "h w"] | None = None,
    sigma_other_px: Float32[np.ndarray, "h2 w2"] | None = None,
    settings: MatchSettings = _DEFAULTS,
) -> Matches:
    r"""Find each reference pixel's partner on its epipolar line.

    Parameters
    ----------
    reference_px, other_px
        Projector coordinate of each camera's pixels in [px] (or any unit that both share),
        float32, NaN invalid. The coded direction has to change along the line between the cameras.
    rectification
        Geometry of the pair.
    sigma_reference_px, sigma_other_px
        Standard deviation of the coordinates in their unit. None means not known: sigma is NaN.
    settings
        What counts as a jump and as agreement.

    Returns
    -------
    Rectified x of the partner, its uncertainty and reasons, float32 and uint16.

    Raises
    ------
    MatchingError
        If a map doesn't have its camera's size, holds no valid pixel, or the coordinate doesn't
        change along epipolar lines.

    Notes
    -----
    An index per row of the rectified plane says at which x the other camera's coordinate crosses each of a series
    of values; it is filled from the nearest pixels, each at its true place, and serves as a start only: 97 of 100
    starts lie among the four pixels of their solution. From there Newton's
    method runs along the exact epipolar line on the *original* map of the other camera, bilinear inside
    one valid 2x2 neighbourhood without a jump. So the reference isn't resampled, the other is interpolated
    once, and neither rectified size nor rotation touches the accuracy. With the weights w of the four pixels, and
    the nearest one's noise standing for all four,

    .. math:: \sigma_d^2 = \frac{\sigma_{ref}^2 + \sigma_{other}^2 \sum_i w_i^2}{(\partial u / \partial x)^2}

    The first step is taken for a tile of pixels at a time, in plain loops; what then lies among other four pixels
    goes on one by one.

    A coordinate that crosses at two places of the row is ambiguous; a partner whose own index entry leads
    to another pixel of the reference fails the left-right check. No disparity range is needed.
    Memory: two indices of rows times projector columns, one map of the other canvas.
    """
    _check(reference_px, other_px, rectification)
    reference_px, other_px = kernel_input(reference_px), kernel_input(other_px)
    step = _median_step(reference_px, other_px)
    jump = settings.jump_px if settings.jump_px is not None else _JUMP_STEPS * step
    grid = _grid(other_px, step, rectification.other.width_px)
    pixel_of_other = rectification.pixel_of_other.map()
    index = Index(
        _index(
            reference_px,
            rectification.pixel_of_reference,
            rectification.reference,
            grid,
            jump,
            CHECKED_ROWS,
        ),
        _index(other_px, rectification.pixel_of_other, rectification.other, grid, jump, 1),
    )
    out = Matches(
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.float32),
        np.empty(reference_px.shape, np.uint16),
    )
    unknown = np.full((1, reference_px.shape[1]), np.nan, np.float32)
    match_rows(
        reference_px,
        other_px,
        unknown if sigma_reference_px is None else kernel_input(sigma_reference_px),
        unknown if sigma_other_px is None else kernel_input(sigma_other_px),
        rectification.rectified_of_reference.nodes,
        pixel_of_other,
        index,
        Limits(
            np.float32(rectification.other.x0_px),
            np.float32(rectification.other.y0_px),
            np.float32(grid.low),
            np.float32(1.0 / grid.step),
            np.float32(jump),
            np.float32(settings.agreement_px),
        ),
        *out,
    )
    return out


def sample_partner(
    values: Float32[np.ndarray, "h2 w2"], matches: Matches, rectification: Rectification
) -> Float32[np.ndarray, "h w"]:
    """Return what the other camera has at each partner (nearest pixel).

    Parameters
    ----------
    values
        Map of the other camera: modulation, residual, gray.
    matches
        Partners.
    rectification
        Geometry of the pair.

    Returns
    -------
    Values on the reference camera's pixels, float32; NaN where there is no partner.
    """
    out = np.empty(matches.x_other_px.shape, np.float32)
    sample_rows(
        kernel_input(values),
        matches.x_other_px,
        rectification.rectified_of_reference.nodes,
        rectification.pixel_of_other.map(),
        np.array(rectification.other, np.int64),
        out,
    )
    return out


# ---------------------------------------------------------------- preparation


def _check(
    reference_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h2 w2"],
    rectification: Rectification,
) -> None:
    reference = rectification.rectified_of_reference
    sizes = ((reference.width_px, reference.height_px), rectification.other_size_px)
    for name, values, (width, height) in zip(
        ("reference", "other"), (reference_px, other_px), sizes, strict=True
    ):
        if values.shape != (height, width):
            raise MatchingError(
                f"the {name} camera's map is {values.shape[1]}x{values.shape[0]} px but its calibration"
                f" is for {width}x{height} px; use the calibration of this size"
            )
        if not np.isfinite(values[::7, ::7]).any() and not np.isfinite(values).any():
            raise MatchingError(
                f"no pixel of the {name} camera has a coordinate; see the reasons map of the stage before"
            )


def _median_step(
    reference_px: Float32[np.ndarray, "h w"], other_px: Float32[np.ndarray, "h2 w2"]
) -> float:
    """Return the median change of the coordinate between neighbours of both cameras."""
    steps = [_steps_of(values) for values in (reference_px, other_px)]
    median = float(np.median(np.concatenate(steps)))
    if not median > 0:
        raise MatchingError(
            "the projector coordinate doesn't change from pixel to pixel; check the capture and the"
            " fringe direction"
        )
    return median


def _steps_of(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "n"]:
    rows = values[:: max(values.shape[0] // 24, 1)]
    columns = values[:, :: max(values.shape[1] // 16, 1)]
    across, down = np.abs(np.diff(rows, axis=1)), np.abs(np.diff(columns, axis=0))
    across, down = across[np.isfinite(across)], down[np.isfinite(down)]
    # The coded direction is the one that changes; cameras may be mounted on their side.
    if across.size == 0 or (down.size and np.median(down) > np.median(across)):
        return down
    return across


class _Grid(NamedTuple):
    """Values of the coordinate at which an index notes the place: low + k step."""

    low: float
    step: float
    cells: int


def _grid(other_px: Float32[np.ndarray, "h2 w2"], step: float, width_px: int) -> _Grid:
    """Lay about one value on each pixel of the other camera."""
    low, high = float(np.nanmin(other_px)), float(np.nanmax(other_px))
    step = max(step, (high - low) / (_CELLS_MAX * width_px))
    # one below, for a coordinate a hair under the lowest
    return _Grid(low - step, step, int((high - low) / step) + 4)


def _index(
    values: Float32[np.ndarray, "h w"],
    pixel_of_canvas: Lattice,
    canvas: Canvas,
    grid: _Grid,
    jump: float,
    every: int,
) -> Float32[np.ndarray, "rows _cells"]:
    """Note where every n-th row of a canvas crosses the grid's values; the last cells take what isn't wanted."""
    index = np.empty((-(-canvas.height_px // every), grid.cells + SPARE_CELLS), np.float32)
    index_rows(
        values,
        pixel_of_canvas.nodes,
        canvas.width_px,
        every,
        np.array([canvas.x0_px, grid.low, 1.0 / grid.step, jump / grid.step], np.float32),
        index,
    )
    return index
