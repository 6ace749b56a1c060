"""What the options of all simulated rigs have in common: sizes, ranges, and one sentence per refusal."""

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from backend.devices.errors import RigConfigError

Size = tuple[int, int]

Options = TypeVar("Options", bound="RigOptions")
"""Not `Self`: the shape checks of the tests can't execute that on single methods."""


class RigOptions(BaseModel):
    """Options of a simulated rig, checked."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("size", "projector_size", "screen_size", mode="before", check_fields=False)
    @classmethod
    def _size_from_text(cls, value: object) -> object:
        if isinstance(value, str) and value.lower().count("x") == 1:
            return tuple(part.strip() for part in value.lower().split("x"))
        return value

    @field_validator("size", "projector_size", "screen_size", check_fields=False)
    @classmethod
    def _size_in_range(cls, value: Size) -> Size:
        width, height = value
        if not (64 <= width <= 8192 and 48 <= height <= 8192):
            raise ValueError(f"{width}x{height} is not within 64x48 to 8192x8192")
        return value

    @field_validator("bit_depth", check_fields=False)
    @classmethod
    def _has_pixel_format(cls, value: int) -> int:
        if value not in (8, 12):
            raise ValueError(f"{value} is not one of 8, 12")
        return value

    @field_validator("exposure_max_ms", check_fields=False)
    @classmethod
    def _longer_than_min(cls, value: float, info: Any) -> float:
        shortest = info.data.get("exposure_min_ms", 0.0)
        if value <= shortest:
            raise ValueError(f"{value:g} is not above exposure_min_ms {shortest:g}")
        return value

    @classmethod
    def from_options(cls: type[Options], options: Mapping[str, object]) -> Options:
        """Read a mapping, e.g. from the command line, where every value may be text.

        Raises
        ------
        RigConfigError
            If a key is unknown or a value can't be used; one sentence names the first of them.
        """
        try:
            return cls.model_validate(dict(options))
        except ValidationError as error:
            raise RigConfigError(_sentence(cls, error)) from None


def _sentence(model: type[RigOptions], error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    option = str(first["loc"][0]) if first["loc"] else "options"
    if first["type"] == "extra_forbidden":
        names = ", ".join(model.model_fields)
        return f"simulated rig: there is no option {option!r}; the options are {names}"
    problem = first["msg"].removeprefix("Value error, ")
    return f"simulated rig: option {option} can't be {first['input']!r}: {problem[0].lower() + problem[1:]}"
