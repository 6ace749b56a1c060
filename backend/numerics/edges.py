"""Where a stripe's edge lies: black or white against the inverse, and the edge's place between two pixels.

Equations are those of the "robust surface coding" paper (Zhang, Xu, Xi, Zhao, Shi, IEEE Transactions on Automation
Science and Engineering 11(3), 2014, doi:10.1109/TASE.2013.2293576); it calls the stripes' picture *pattern* and
that of the stripes with black and white exchanged *inverse*.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped, UInt8

from backend.numerics.errors import CodeError, FrameError
from backend.numerics.gray_code import GrayCode, decode_gray_code
from backend.numerics.kernels import kernel, kernel_input, row_loop

Axis = Literal["x", "y"]

LONGEST_GAP_PX = 24
"""Saturated gaps up to this are bridged: with 10 % image noise the error of the bridge stays within 1 px."""


def interpolated_edge(
    left_px: Float[np.ndarray, "*n"],
    pattern_left_gray: Float[np.ndarray, "*n"],
    pattern_right_gray: Float[np.ndarray, "*n"],
    inverse_left_gray: Float[np.ndarray, "*n"],
    inverse_right_gray: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    r"""Intersect pattern and inverse between two neighbouring pixels (equation 11).

    Parameters
    ----------
    left_px
        Position of the left pixel; the right one is 1 px further on.
    pattern_left_gray, pattern_right_gray, inverse_left_gray, inverse_right_gray
        What the two pixels read.

    Returns
    -------
    Position of the edge in [px], within the two pixels if the curves cross there.

    Notes
    -----
    With D = I - I', :math:`x = x_0 + D_0 / (D_0 - D_1)`: gain and offset of the camera cancel. For noise
    of standard deviation :math:`\sigma_I` in every sample and slope :math:`D' = D_1 - D_0`, with t = x - x_0,
    :math:`\sigma_x = \sqrt{2} \, \sigma_I \sqrt{(1-t)^2 + t^2} / |D'|`. A blurred edge isn't straight: for
    a Gaussian blur of 1.1 px the two lines miss it by 0.013 px at most.

    Examples
    --------
    The paper's figure 18: 80 and 25 against 28 and 62.

    >>> interpolated_edge(*np.array([[899.0], [80], [25], [28], [62]])).round(1)
    array([899.6])
    """
    left = pattern_left_gray - inverse_left_gray
    right = pattern_right_gray - inverse_right_gray
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(left_px + left / (left - right))


def extrapolated_edge(
    rising_px: Float[np.ndarray, "*n"],
    rising_gray: Float[np.ndarray, "*n"],
    risen_gray: Float[np.ndarray, "*n"],
    falling_px: Float[np.ndarray, "*n"],
    falling_gray: Float[np.ndarray, "*n"],
    fallen_gray: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Extend a rising and a falling line over a saturated gap until they meet (equation 12).

    Parameters
    ----------
    rising_px
        Last pixel before the gap; the rising curve reads `rising_gray` there, `risen_gray` one pixel on.
    falling_px
        Last pixel of the gap; the falling curve reads `falling_gray` there, `fallen_gray` one pixel on.

    Returns
    -------
    Position where both lines meet, in [px]; not finite if they run in parallel.

    Notes
    -----
    For knowing roughly where an edge is while the picture is too bright, never for a measurement: a
    noise of 10 % of the full scale moves the result of a gap of 24 px by 1 px, see `edge_tolerance`.

    Examples
    --------
    The paper's figure 17: the inverse rises from 226 at 1292 to 255, the pattern falls from 255 at 1294 to 155.

    >>> extrapolated_edge(*np.array([[1292.0], [226], [255], [1294], [255], [155]])).round(3)
    array([1293.775])
    """
    rise, fall = risen_gray - rising_gray, fallen_gray - falling_gray
    with np.errstate(divide="ignore", invalid="ignore"):
        met = (falling_gray - rising_gray + rise * rising_px - fall * falling_px) / (rise - fall)
    return np.asarray(met)


class Bridged(NamedTuple):
    """Pattern and inverse whose saturated gaps are filled by extrapolation."""

    pattern: UInt8[np.ndarray, "h w"]
    """1 where the pixel is white in the pattern, 0 where black or not known."""
    inverse: UInt8[np.ndarray, "h w"]
    """1 where the pixel is black in the pattern, 0 where white or not known."""
    extrapolated: Bool[np.ndarray, "h w"]
    """The pixel lies in a gap that was filled."""

    @property
    def known(self) -> Bool[np.ndarray, "h w"]:
        """The pixel is black or white."""
        return np.asarray(self.pattern != self.inverse)


def bridge_saturated(
    pattern: Integer[np.ndarray, "h w"],
    inverse: Integer[np.ndarray, "_h _w"],
    *,
    min_contrast_gray: float,
    saturation_gray: float,
    axis: Axis = "x",
    longest_gap_px: int = LONGEST_GAP_PX,
) -> Bridged:
    """Tell black from white, also where pattern and inverse are both saturated (equations 2 and 12).

    Parameters
    ----------
    pattern, inverse
        The two pictures, uint8 or uint16.
    min_contrast_gray
        1 where pattern - inverse is more than this, 0 where it is less than minus this, unknown between.
    saturation_gray
        A gap is a run of pixels in which both reach this gray level.
    axis
        Direction across the stripes: gaps are runs along the camera's rows ("x") or columns ("y").
    longest_gap_px
        Longer gaps stay unknown.

    Returns
    -------
    Black and white of every pixel. In a gap between a white and a black stripe the two curves are
    extended to where they meet; a gap within one stripe gets the stripe's colour.

    Raises
    ------
    FrameError
        If the two differ in size.

    Notes
    -----
    The extended lines go through the last unsaturated sample and the first saturated one, as in the paper's example.
    """
    if pattern.shape != inverse.shape:
        raise FrameError(
            f"the pattern is {pattern.shape} but its inverse {inverse.shape}: give pictures of one size"
        )
    pair = [np.asarray(p if axis == "x" else p.T, np.uint16) for p in (pattern, inverse)]
    out = Bridged(*(np.empty(pair[0].shape, kind) for kind in (np.uint8, np.uint8, np.bool_)))
    _bridge_rows(
        kernel_input(pair[0]),
        kernel_input(pair[1]),
        int(np.floor(min_contrast_gray)),
        int(min(np.ceil(saturation_gray), 2**30)),
        longest_gap_px,
        *out,
    )
    return out if axis == "x" else Bridged(*(np.ascontiguousarray(part.T) for part in out))


class BridgedCode(NamedTuple):
    """A Gray code read with extrapolated edges: to know roughly where light goes, not to measure."""

    gray: GrayCode
    extrapolated: Bool[np.ndarray, "h w"]
    """At least one bit comes from an extrapolated edge."""


def decode_bridged_gray_code(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    inverses: Sequence[Shaped[np.ndarray, "h w"]],
    *,
    codes: int,
    size_px: int,
    min_contrast_gray: float = 5.0,
    saturation_gray: float = 255.0,
    axis: Axis = "x",
    longest_gap_px: int = LONGEST_GAP_PX,
) -> BridgedCode:
    """Decode a Gray code where the picture is too bright: the point spread function at pixel accuracy.

    Parameters
    ----------
    patterns, inverses
        The frames from the coarsest bit to the finest, as `decode_gray_code` takes them.
    codes, size_px
        As there.
    min_contrast_gray, saturation_gray, axis, longest_gap_px
        As in `bridge_saturated`; bits across the camera's rows are bridged along its columns ("y").

    Returns
    -------
    The code and where it was extrapolated. Pixels that stay unknown have `Reason.CODE_MARGIN`.
    `contrast_gray` is 1 where the code is known: it can't be told where the picture is saturated.

    Raises
    ------
    CodeError
        If there are no frames, or not as many inverses as patterns.
    """
    if not patterns or len(patterns) != len(inverses):
        raise CodeError(
            f"{len(patterns)} patterns and {len(inverses)} inverses make no code: give both of every bit"
        )
    bridged = [
        bridge_saturated(
            p,
            q,
            min_contrast_gray=min_contrast_gray,
            saturation_gray=saturation_gray,
            axis=axis,
            longest_gap_px=longest_gap_px,
        )
        for p, q in zip(patterns, inverses, strict=True)
    ]
    gray = decode_gray_code(
        [b.pattern for b in bridged],
        [b.inverse for b in bridged],
        codes=codes,
        size_px=size_px,
        min_contrast_gray=0,
    )
    return BridgedCode(gray, np.logical_or.reduce([b.extrapolated for b in bridged]))


@row_loop
def _bridge_gap(
    p: Any, q: Any, first: Any, last: Any, contrast: Any, white: Any, black: Any, flag: Any
) -> None:
    """Fill the gap of saturated pixels first..last, both of whose neighbours exist."""
    before, after = first - 1, last + 1
    left, right = np.int64(p[before]) - q[before], np.int64(p[after]) - q[after]
    if abs(left) <= contrast or abs(right) <= contrast:
        return
    if (left > 0) == (right > 0):
        edge = np.float64(after)
    else:
        rising0, rising1 = (q[before], q[first]) if left > 0 else (p[before], p[first])
        falling0, falling1 = (p[last], p[after]) if left > 0 else (q[last], q[after])
        rise = np.float64(rising1) - np.float64(rising0)
        fall = np.float64(falling1) - np.float64(falling0)
        level = np.float64(falling0) - np.float64(rising0)
        edge = (level + rise * before - fall * last) / (rise - fall)
    for i in range(first, last + 1):
        is_white = (left > 0) if i <= edge else (right > 0)
        white[i] = 1 if is_white else 0
        black[i] = 0 if is_white else 1
        flag[i] = True


@row_loop
def _bridge_row(
    p: Any, q: Any, contrast: Any, saturation: Any, longest: Any, white: Any, black: Any, flag: Any
) -> None:
    for i in range(p.size):
        difference = np.int64(p[i]) - np.int64(q[i])
        white[i] = 1 if difference > contrast else 0
        black[i] = 1 if difference < -contrast else 0
        flag[i] = False
    i = 0
    while i < p.size:
        if min(p[i], q[i]) < saturation:
            i += 1
            continue
        first = i
        while i < p.size and min(p[i], q[i]) >= saturation:
            i += 1
        if first > 0 and i < p.size and i - first <= longest:
            _bridge_gap(p, q, first, i - 1, contrast, white, black, flag)


@kernel
def _bridge_rows(
    pattern: Any,
    inverse: Any,
    contrast: Any,
    saturation: Any,
    longest: Any,
    white: Any,
    black: Any,
    flag: Any,
) -> None:
    for row in numba.prange(pattern.shape[0]):
        _bridge_row(
            pattern[row], inverse[row], contrast, saturation, longest,
            white[row], black[row], flag[row],
        )  # fmt: skip


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    frame = np.zeros((1, 1), np.uint8)
    decode_bridged_gray_code([frame], [frame], codes=2, size_px=2)
