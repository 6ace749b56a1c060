"""What drivers ask of the library that reads a GenICam camera's description."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Features(Protocol):
    """A camera's features by name, as its library has them. Its errors are the library's own."""

    def has(self, name: str) -> bool:
        """Tell whether the camera has a feature now."""
        ...

    def choices(self, name: str) -> tuple[str, ...]:
        """Return what an enumeration can be set to."""
        ...

    def text(self, name: str) -> str:
        """Return a feature as text."""
        ...

    def number(self, name: str) -> float:
        """Return a number."""
        ...

    def flag(self, name: str) -> bool:
        """Tell whether something is on."""
        ...

    def bounds(self, name: str) -> tuple[float, float, float]:
        """Return smallest, largest and step (0: any) of a number."""
        ...

    def unit(self, name: str) -> str:
        """Return the unit of a number; empty if the camera doesn't say."""
        ...

    def set_text(self, name: str, value: str) -> None:
        """Set an enumeration."""
        ...

    def set_number(self, name: str, value: float) -> None:
        """Set a number."""
        ...

    def set_flag(self, name: str, *, value: bool) -> None:
        """Switch something on or off."""
        ...

    def run(self, name: str) -> None:
        """Execute a command."""
        ...
