"""From a pattern as data to the picture that the projector shows."""

from functools import singledispatch

import numpy as np
from jaxtyping import Float, UInt8

from backend.domain.errors import StageFailedError
from backend.domain.patterns import Gray, Pattern, Sine, StaticPicture, Stripe, Uniform
from backend.numerics.errors import NumericsError
from backend.numerics.patterns import (
    gray_code_pattern,
    sine_pattern,
    stripe_pattern,
    uniform_pattern,
)


def render(
    pattern: Pattern,
    *,
    width_px: int,
    height_px: int,
    gamma: float = 1.0,
    mask: Float[np.ndarray, "mask_h mask_w"] | None = None,
) -> UInt8[np.ndarray, "h w"]:
    """Render a pattern for a projector.

    Parameters
    ----------
    pattern
        What to show.
    width_px, height_px
        The projector's size.
    gamma
        The projector's light is proportional to (code/255)**gamma; fringes and masks are meant in light.
    mask
        Factor of the light per projector pixel, in [0, 1].

    Raises
    ------
    StageFailedError
        If the pattern can't be rendered or the mask doesn't fit the projector.
    """
    try:
        picture: UInt8[np.ndarray, "h w"] = _render(pattern, width_px, height_px, gamma)
    except NumericsError as error:
        raise StageFailedError(str(error)) from error
    return picture if mask is None else _dim(picture, mask, gamma)


def _dim(
    picture: UInt8[np.ndarray, "h w"], mask: Float[np.ndarray, "mask_h mask_w"], gamma: float
) -> UInt8[np.ndarray, "h w"]:
    if mask.shape != picture.shape:
        raise StageFailedError(
            f"The intensity mask is {mask.shape[1]} x {mask.shape[0]} px, the projector "
            f"{picture.shape[1]} x {picture.shape[0]}: make it anew for this projector."
        )
    factor = np.clip(mask, 0.0, 1.0) ** (1.0 / gamma)
    dimmed: UInt8[np.ndarray, "h w"] = np.rint(picture * factor).astype(np.uint8)
    return dimmed


@singledispatch
def _render(
    pattern: object, width_px: int, height_px: int, gamma: float
) -> UInt8[np.ndarray, "h w"]:
    raise StageFailedError(f"A projector can't show {pattern!r}: nothing renders that kind.")


@_render.register
def _sine(pattern: Sine, width_px: int, height_px: int, gamma: float) -> UInt8[np.ndarray, "h w"]:
    return sine_pattern(
        width_px=width_px,
        height_px=height_px,
        axis=pattern.axis,
        periods=pattern.periods,
        shift_rad=pattern.shift_rad,
        offset_rad=pattern.offset_rad,
        low_gray=pattern.low_gray,
        high_gray=pattern.high_gray,
        gamma=gamma,
        codes=None if pattern.codes is None else np.array(pattern.codes),
    )


@_render.register
def _gray(pattern: Gray, width_px: int, height_px: int, gamma: float) -> UInt8[np.ndarray, "h w"]:
    return gray_code_pattern(
        width_px=width_px,
        height_px=height_px,
        axis=pattern.axis,
        bit=pattern.bit,
        bits=pattern.bits,
        codes=pattern.codes,
        inverse=pattern.inverse,
    )


@_render.register
def _stripe(
    pattern: Stripe, width_px: int, height_px: int, gamma: float
) -> UInt8[np.ndarray, "h w"]:
    return stripe_pattern(
        width_px=width_px,
        height_px=height_px,
        axis=pattern.axis,
        periods=pattern.periods,
        shift_periods=pattern.shift_periods,
        inverse=pattern.inverse,
    )


@_render.register
def _uniform(
    pattern: Uniform, width_px: int, height_px: int, gamma: float
) -> UInt8[np.ndarray, "h w"]:
    return uniform_pattern(width_px=width_px, height_px=height_px, gray=round(pattern.gray))


@_render.register
def _nothing(
    pattern: StaticPicture, width_px: int, height_px: int, gamma: float
) -> UInt8[np.ndarray, "h w"]:
    return uniform_pattern(width_px=width_px, height_px=height_px, gray=0)
