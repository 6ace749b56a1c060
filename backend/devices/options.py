"""Options of a driver as a pydantic model, refused in one sentence."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from backend.devices.errors import RigConfigError


def _size_from_text(value: object) -> object:
    if isinstance(value, str) and value.lower().count("x") == 1:
        return tuple(part.strip() for part in value.lower().split("x"))
    return value


_Pixels = Annotated[int, Field(ge=16, le=16384)]
DisplaySize = Annotated[tuple[_Pixels, _Pixels], BeforeValidator(_size_from_text)]
"""Width and height in [px]; `1280x800` is understood too."""


class DriverOptions(BaseModel):
    """Base of the options that a driver takes."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


AnyOptions = TypeVar("AnyOptions", bound=DriverOptions)


def read_options(model: type[AnyOptions], device: str, options: Mapping[str, Any]) -> AnyOptions:
    """Check a device's options.

    Raises
    ------
    RigConfigError
        If one is unknown, missing or can't be used; the sentence names the first.
    """
    try:
        return model.model_validate(dict(options))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        option = str(first["loc"][0]) if first["loc"] else "options"
        if first["type"] == "extra_forbidden":
            names = ", ".join(model.model_fields)
            raise RigConfigError(
                f"{device}: there is no option {option!r}; the options are {names}"
            ) from None
        problem = first["msg"].removeprefix("Value error, ")
        raise RigConfigError(
            f"{device}: option {option} can't be used: {problem[0].lower() + problem[1:]}; mend it in the rig's file"
        ) from None
