"""Options of rigs and drivers as pydantic models, refused in one sentence."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from backend.devices.errors import RigConfigError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


def _size_from_text(value: object) -> object:
    if isinstance(value, str) and value.lower().count("x") == 1:
        return tuple(part.strip() for part in value.lower().split("x"))
    return value


Size = Annotated[tuple[int, int], BeforeValidator(_size_from_text)]
"""Width and height in [px]; `1280x800` is understood too."""
_Pixels = Annotated[int, Field(ge=16, le=16384)]
DisplaySize = Annotated[tuple[_Pixels, _Pixels], BeforeValidator(_size_from_text)]
"""The same of a real display."""
SerialNumber = Annotated[str, Field(coerce_numbers_to_str=True)]
"""YAML reads one that consists of digits as a number."""
_LONGEST_VALUE = 80
"""Of a value, in a sentence."""
_EVERYBODY = IPv4Address("255.255.255.255")


def is_single_address(address: str) -> bool:
    """Tell whether a text is the IPv4 address of one device: neither a name nor everybody's."""
    try:
        parsed = IPv4Address(address)
    except AddressValueError:
        return False
    return not (parsed.is_multicast or parsed.is_unspecified or parsed == _EVERYBODY)


def _of_one_device(address: str) -> str:
    if address and not is_single_address(address):
        raise ValueError("write the four numbers of its IPv4 address, e.g. 192.168.10.2")
    return address


SingleAddress = Annotated[str, AfterValidator(_of_one_device)]
"""IPv4 address of one device, or empty. Libraries look for whatever else stands there by broadcast."""


class DeviceOptions(BaseModel):
    """Base of the options that a rig or driver takes; the sentence under a field is shown to operators."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )


AnyOptions = TypeVar("AnyOptions", bound=DeviceOptions)
AnyFactory = TypeVar("AnyFactory", bound=Callable[..., object])


def takes(
    model: type[DeviceOptions], *, library: Callable[[], object] | None = None
) -> Callable[[AnyFactory], AnyFactory]:
    """Declare the options of a factory of cameras, projectors or rigs: lists and forms show them.

    `library` raises a sentence with the install command where the library that the devices need isn't there.
    """

    def declared(factory: AnyFactory) -> AnyFactory:
        factory.options_model = model  # type: ignore[attr-defined]  # read by loading.schema_of
        factory.library = library  # type: ignore[attr-defined]  # read by driver_loading.missing_library
        return factory

    return declared


def read_options(model: type[AnyOptions], device: str, options: Mapping[str, Any]) -> AnyOptions:
    """Check the options of a rig or device, where every value may be text.

    Raises
    ------
    RigConfigError
        If one is unknown, missing or can't be used; the sentence names the first.
    """
    try:
        return model.model_validate(dict(options))
    except ValidationError as error:
        raise RigConfigError(f"{device}: {_problem(model, options, error)}") from None


def meant(name: str, known: Iterable[str]) -> str:
    """Ask for the known name that looks like one that isn't: the end of a sentence, empty if none does.

    Examples
    --------
    >>> meant("adress", ("address", "serial"))
    "; did you mean 'address'?"
    >>> meant("colour", ("address", "serial"))
    ''
    """
    near = get_close_matches(name.lower(), list(known), n=1, cutoff=0.7)
    return f"; did you mean {near[0]!r}?" if near else ""


def telling(found: "Sequence[ErrorDetails]") -> "ErrorDetails":
    """Return what is worth a sentence: an unknown name before a missing one, which it may stand for."""
    unknown = [one for one in found if one["type"] == "extra_forbidden"]
    return (unknown or found)[0]


def shortened(text: str) -> str:
    """Cut what a file brings down to what a sentence can hold."""
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"


def _problem(model: type[DeviceOptions], options: Mapping[str, Any], error: ValidationError) -> str:
    first = telling(error.errors(include_url=False))
    message = first["msg"].removeprefix("Value error, ")
    problem = message[0].lower() + message[1:]
    if not first["loc"]:
        return problem
    option = str(first["loc"][0])
    if first["type"] == "missing":
        return f"option {option} is missing; add it"
    if first["type"] == "extra_forbidden":
        # A driver's own options go before those that it shares with others.
        names = sorted(model.model_fields, key=lambda name: name not in model.__annotations__)
        unknown = shortened(repr(option))
        return f"there is no option {unknown}; the options are {', '.join(names)}{meant(option, names)}"
    value = shortened(repr(options.get(option, first["input"])))
    return f"option {option} can't be {value}: {problem}"
