"""Captured pictures: pixels that are loaded when looked at, and how they were taken."""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from backend.domain.patterns import Pattern


@runtime_checkable
class Pixels(Protocol):
    """An array that may still be on disk."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape without loading."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Element type without loading."""
        ...

    def load(self) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return the array, memory-mapped where it is on disk: read only, C order."""
        ...


@dataclass(frozen=True)
class InMemory:
    """Pixels that are in memory already."""

    array: np.ndarray[tuple[int, ...], np.dtype[Any]]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.array.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Element type of the array."""
        return self.array.dtype

    def load(self) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return the array."""
        return self.array


def identity(pixels: Pixels) -> Hashable:
    """Tell pixels apart as long as somebody keeps them: an array is one, however often it was wrapped.

    Examples
    --------
    >>> array = np.zeros((2, 3))
    >>> identity(InMemory(array)) == identity(InMemory(array))
    True
    >>> other = array.copy()
    >>> identity(InMemory(array)) == identity(InMemory(other))
    False
    """
    return id(pixels.array) if isinstance(pixels, InMemory) else id(pixels)


@dataclass(frozen=True)
class Frame:
    """One captured picture: h x w, uint8 or uint16."""

    camera: str
    pattern: Pattern
    exposure_ms: float | None
    """None where an imported folder doesn't tell."""
    pixels: Pixels
    bit_depth: int = 8
    gain_db: float = 0.0
    role: str = ""
    """What the plan took it for, e.g. `white`, `dark`, `fringe`."""

    @property
    def gray(self) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """The picture itself, loaded now."""
        return self.pixels.load()

    @property
    def full_scale_gray(self) -> float:
        """The largest gray level."""
        return float(2**self.bit_depth - 1)
