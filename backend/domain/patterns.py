"""What is projected, as data. The same words stand in `capture.json` and in the frame journal."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Axis = Literal["x", "y"]
Codes = Annotated[
    tuple[Annotated[float, Field(ge=0, le=255)], ...], Field(min_length=2, max_length=1024)
]
"""A display's table."""


class _Pattern(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Sine(_Pattern):
    """A fringe: gray = A + B cos(2 pi periods x + offset + shift), x in [0, 1) across the pattern along the axis."""

    kind: Literal["sine"] = "sine"
    axis: Axis = "x"
    periods: float = Field(gt=0)
    offset_rad: float = 0.0
    shift_rad: float = 0.0
    low_gray: float = Field(0.0, ge=0, le=255, exclude_if=lambda v: v == 0.0)
    """A - B, the darkest code projected."""
    high_gray: float = Field(255.0, ge=0, le=255, exclude_if=lambda v: v == 255.0)
    """A + B, the brightest code projected."""
    codes: Codes | None = Field(None, exclude_if=lambda v: v is None)
    """Code shown for equidistant codes asked for, from 0 to 255: bends a fringe the other way round before a screen
    that isn't linear does. None: shown as asked for."""


class Gray(_Pattern):
    """One bit of the reflected Gray code of floor(x codes); white = 1, `inverse` swaps."""

    kind: Literal["gray"] = "gray"
    axis: Axis = "x"
    bit: int = Field(ge=0)
    bits: int = Field(gt=0)
    codes: int = Field(gt=0)
    inverse: bool = False


def gray_code(axis: Axis, codes: int) -> tuple[Gray, ...]:
    """List the Gray code of so many codes, coarsest bit first, each bit beside its inverse."""
    bits = max(1, (codes - 1).bit_length())
    return tuple(
        Gray(axis=axis, bit=bit, bits=bits, codes=codes, inverse=inverse)
        for bit in reversed(range(bits))
        for inverse in (False, True)
    )


class Stripe(_Pattern):
    """Black and white stripes: white where frac(periods x - shift) < 1/2, `inverse` swaps."""

    kind: Literal["stripe"] = "stripe"
    axis: Axis = "x"
    periods: float = Field(gt=0)
    shift_periods: float = 0.0
    inverse: bool = False


class Uniform(_Pattern):
    """The whole field at one code, 0 black .. 255 white."""

    kind: Literal["uniform"] = "uniform"
    gray: float = Field(ge=0, le=255)


class StaticPicture(_Pattern):
    """A picture of a static scene without a pattern: nothing is projected."""

    kind: Literal["picture"] = "picture"


Pattern = Annotated[Sine | Gray | Stripe | Uniform | StaticPicture, Field(discriminator="kind")]

WHITE = Uniform(gray=255)
BLACK = Uniform(gray=0)
