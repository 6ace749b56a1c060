"""Arrays that an operator hands over, e.g. a painted mask: a setting holds their hash, a stage loads them."""

from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import Field

ArrayHash = Annotated[
    str, Field(pattern=r"^[0-9a-f]{64}$", json_schema_extra={"format": "array-hash"})
]
"""Type of a setting that refers to a stored array by the hash of its content."""


@runtime_checkable
class LoadArray(Protocol):
    """Loads an array that a setting refers to. A stage that has a parameter of this type may do so."""

    def __call__(self, array_hash: str) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return the array, read only; raises `NotFoundError` if there is none of this hash."""
        ...
