"""Patterns that the projector shows, one uint8 picture each.

Coordinates as everywhere here: projector pixel u of W stands at x = (u + 1/2)/W of the pattern.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, UInt8

from backend.numerics.errors import PatternError

Axis = Literal["x", "y"]

WHITE = 255
"""Gray level of a bright stripe."""

_TIE = 1e-9
"""Positions nearer than this to a stripe's edge count as on it, so rounding can't move the edge."""


def pattern_coordinate(width_px: int, height_px: int, axis: str) -> Float64[np.ndarray, "n"]:
    """Give each projector column (axis x) or row (axis y) its place in the pattern, in (0, 1).

    Examples
    --------
    >>> pattern_coordinate(4, 2, "x")
    array([0.125, 0.375, 0.625, 0.875])
    """
    if axis not in ("x", "y"):
        raise PatternError(f"patterns vary along x or y, not along {axis!r}: give one of the two")
    if width_px < 1 or height_px < 1:
        raise PatternError(f"a pattern of {width_px} x {height_px} px is empty: give sizes >= 1")
    n_px = width_px if axis == "x" else height_px
    return (np.arange(n_px) + 0.5) / n_px


def _spread(
    profile_gray: UInt8[np.ndarray, "n"], width_px: int, height_px: int, axis: str
) -> UInt8[np.ndarray, "h w"]:
    """Repeat one line over the picture."""
    line = profile_gray[np.newaxis, :] if axis == "x" else profile_gray[:, np.newaxis]
    return np.ascontiguousarray(np.broadcast_to(line, (height_px, width_px)))


def sine_pattern(
    *,
    width_px: int,
    height_px: int,
    axis: Axis = "x",
    periods: float,
    shift_rad: float,
    offset_rad: float = 0.0,
    low_gray: float = 40.0,
    high_gray: float = 220.0,
    gamma: float = 1.0,
    codes: Float[np.ndarray, "n_codes"] | None = None,
) -> UInt8[np.ndarray, "h w"]:
    r"""Render fringes, calculated in float and rounded once.

    Parameters
    ----------
    width_px, height_px
        Size of the projector.
    axis
        "x": the gray level changes from column to column; "y": from row to row.
    periods
        Periods over the projector's width (or height), > 0, not necessarily a whole number.
    shift_rad, offset_rad
        Shift of this step and offset of all steps, in [rad]; only their sum matters.
    low_gray, high_gray
        Darkest and brightest gray level, 0 <= low < high <= 255.
    gamma
        The projector's light is proportional to (gray/255)**gamma. 1 means linear; otherwise the
        gray levels are bent so that the light is a sinusoid between the light of low and high.
    codes
        Gray level shown for equidistant gray levels from 0 to 255, straight between them; replaces `gamma`. None: no table.

    Raises
    ------
    PatternError
        If a value is out of range.

    Notes
    -----
    :math:`g(u) = \bar g + \hat g \cos(2 \pi f (u + 1/2)/W + \delta)`; error <= 1/2 gray (rounding).

    Examples
    --------
    >>> sine_pattern(width_px=4, height_px=1, periods=1, shift_rad=-np.pi / 4)
    array([[220, 130,  40, 130]], dtype=uint8)
    """
    if not 0 <= low_gray < high_gray <= WHITE:
        raise PatternError(
            f"fringes between gray {low_gray:g} and {high_gray:g} can't be shown: give 0 <= low < high <= 255"
        )
    if not (np.isfinite(periods) and periods > 0):
        raise PatternError(f"fringes need periods > 0, got {periods}: give a positive number")
    if not (np.isfinite(gamma) and gamma > 0):
        raise PatternError(f"a gamma of {gamma} has no inverse: give a number > 0, 1 for linear")
    x = pattern_coordinate(width_px, height_px, axis)
    if codes is not None:
        gamma = 1.0
    low_light, high_light = (low_gray / WHITE) ** gamma, (high_gray / WHITE) ** gamma
    cosine = np.cos(2 * np.pi * periods * x + offset_rad + shift_rad)
    light = low_light + (high_light - low_light) * (0.5 + 0.5 * cosine)
    # Rounding may leave the light a hair below 0, where the root isn't real.
    shown = WHITE * np.maximum(light, 0.0) ** (1 / gamma)
    if codes is not None:
        shown = np.clip(np.interp(shown, np.linspace(0, WHITE, codes.size), codes), 0, WHITE)
    profile = np.rint(shown).astype(np.uint8)
    return _spread(profile, width_px, height_px, axis)


def gray_code_pattern(
    *,
    width_px: int,
    height_px: int,
    axis: Axis = "x",
    bit: int,
    bits: int,
    codes: int,
    inverse: bool = False,
) -> UInt8[np.ndarray, "h w"]:
    """Render one bit of the reflected Gray code of floor(x codes); white is 1.

    Parameters
    ----------
    width_px, height_px, axis
        Size of the projector and the direction that is coded.
    bit
        Which bit, 0 is the finest.
    bits
        Number of bits of the whole code.
    codes
        Number of codes over the width, at most 2**bits: for example the projector's columns.
    inverse
        Show black where the bit is 1.

    Raises
    ------
    PatternError
        If the bit isn't one of the bits, or the codes need more bits.

    References
    ----------
    .. [1] F. Gray, "Pulse code communication", US patent 2632058 (1953).

    Examples
    --------
    >>> gray_code_pattern(width_px=4, height_px=1, bit=0, bits=2, codes=4)
    array([[  0, 255, 255,   0]], dtype=uint8)
    """
    if not 0 <= bit < bits:
        raise PatternError(
            f"bit {bit} isn't one of {bits} bits: give a bit from 0 (finest) to {bits - 1}"
        )
    if not 1 <= codes <= 2**bits:
        raise PatternError(
            f"{codes} codes don't fit into {bits} bits: give 1 to {2**bits} codes or more bits"
        )
    x = pattern_coordinate(width_px, height_px, axis)
    code = np.floor(x * codes + _TIE).astype(np.int64)
    white = ((code ^ (code >> 1)) >> bit) & 1 == 1
    return _spread(_black_and_white(white != inverse), width_px, height_px, axis)


def stripe_pattern(
    *,
    width_px: int,
    height_px: int,
    axis: Axis = "x",
    periods: float,
    shift_periods: float = 0.0,
    inverse: bool = False,
) -> UInt8[np.ndarray, "h w"]:
    """Render binary stripes, white where frac(periods x - shift_periods) < 1/2.

    Examples
    --------
    >>> stripe_pattern(width_px=4, height_px=1, periods=2)
    array([[255,   0, 255,   0]], dtype=uint8)
    """
    if not (np.isfinite(periods) and periods > 0):
        raise PatternError(f"stripes need periods > 0, got {periods}: give a positive number")
    position = periods * pattern_coordinate(width_px, height_px, axis) - shift_periods + _TIE
    white = position - np.floor(position) < 0.5
    return _spread(_black_and_white(white != inverse), width_px, height_px, axis)


def uniform_pattern(*, width_px: int, height_px: int, gray: int) -> UInt8[np.ndarray, "h w"]:
    """Render one gray level over the whole picture.

    Examples
    --------
    >>> uniform_pattern(width_px=2, height_px=1, gray=7)
    array([[7, 7]], dtype=uint8)
    """
    if not 0 <= gray <= WHITE:
        raise PatternError(f"gray {gray} can't be shown: give 0 to 255")
    pattern_coordinate(width_px, height_px, "x")
    return np.full((height_px, width_px), gray, dtype=np.uint8)


def _black_and_white(white: np.ndarray) -> UInt8[np.ndarray, "n"]:
    return np.where(white, WHITE, 0).astype(np.uint8)
