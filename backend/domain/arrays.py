"""Arrays that an operator hands over, e.g. a painted mask: a setting holds their hash, a stage loads them."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import BaseModel, Field

ARRAY_FORMAT = "array-hash"
"""Format of such a setting in a JSON schema."""

ArrayHash = Annotated[
    str, Field(pattern=r"^[0-9a-f]{64}$", json_schema_extra={"format": ARRAY_FORMAT})
]
"""Type of a setting that refers to a stored array by the hash of its content."""


@runtime_checkable
class LoadArray(Protocol):
    """Loads an array that a setting refers to. A stage that has a parameter of this type may do so."""

    def __call__(self, array_hash: str, /) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return the array, read only; raises `NotFoundError` if there is none of this hash."""
        ...


def array_hashes(params: BaseModel) -> Iterator[tuple[str, str]]:
    """Return the arrays that settings refer to, as (name of the setting, hash); nested ones, too."""
    schema = type(params).model_json_schema()
    definitions = schema.get("$defs", {})
    values = params.model_dump(mode="json")
    for name, described in schema.get("properties", {}).items():
        for found in dict.fromkeys(_hashes_in(values.get(name), described, definitions)):
            yield name, found


Schema = Mapping[str, Any]


def _hashes_in(value: Any, schema: Schema, definitions: Schema) -> Iterator[str]:
    if schema.get("format") == ARRAY_FORMAT and isinstance(value, str):
        yield value
    if "$ref" in schema:
        yield from _hashes_in(value, definitions[schema["$ref"].rpartition("/")[2]], definitions)
    for one in schema.get("anyOf", ()):
        yield from _hashes_in(value, one, definitions)
    for element, described in _parts(value, schema):
        if isinstance(described, Mapping):
            yield from _hashes_in(element, described, definitions)


def _parts(value: Any, schema: Schema) -> Iterator[tuple[Any, Any]]:
    """Return the elements of a list or mapping, each with its own schema."""
    if isinstance(value, list):
        first = schema.get("prefixItems", ())
        for n, element in enumerate(value):
            yield element, first[n] if n < len(first) else schema.get("items")
    elif isinstance(value, Mapping):
        named, rest = schema.get("properties", {}), schema.get("additionalProperties")
        for key, element in value.items():
            yield element, named.get(key, rest)
