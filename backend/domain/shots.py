"""Capture plans: generators that yield bursts of shots and receive their frames.

A plan is deterministic: given the same frames it asks for the same shots. That is what makes resume,
undo, partial re-capture and replay one mechanism: driving the plan again with journalled frames.
"""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from backend.domain.frames import Frame, Pixels
from backend.domain.patterns import Pattern

T = TypeVar("T")


@dataclass(frozen=True)
class Shot:
    """One pattern at one exposure, taken by all (or the named) cameras at once."""

    pattern: Pattern
    exposure_ms: float
    gain_db: float = 0.0
    cameras: tuple[str, ...] | None = None
    """None: every camera of the rig."""
    role: str = ""
    mask: Pixels | None = None
    """Intensity mask, projector height x width, float32 in [0, 1], that the pattern is multiplied with."""


Burst = tuple[Shot, ...]
"""Shots that can be preloaded and run hardware-timed; nothing between them depends on their frames."""

Exposed = Mapping[str, Frame]
"""What one shot brought: a frame per camera."""


@dataclass(frozen=True)
class Until:
    """Repeat a shot until `ready` says yes (an operator's click, a board that is sharp and still)."""

    shot: Shot
    ready: Callable[[Exposed], bool]
    timeout_s: float = 120.0


@dataclass(frozen=True)
class OneOf:
    """A burst that is one of several alike, so that whoever waits is told how far all of them are."""

    burst: Burst
    number: int
    """From 0."""
    count: int
    word: str = "burst"
    """What operators call one of them."""


Plan = Generator[Burst | OneOf | Until, tuple[Exposed, ...], T]
"""Yields bursts, receives one `Exposed` per shot (a single one after `Until`), returns what it learnt."""


@runtime_checkable
class Shoot(Protocol):
    """Drives a plan on the rig (or from the journal) and returns what the plan returns.

    A stage that has a parameter of this type captures. It may be called several times; it raises
    `CancelledError` when the operator cancels and `RigFailedError` when a device gives up: let both pass.
    """

    def __call__(self, plan: Plan[T]) -> T:
        """Drive the plan to its end."""
        ...


@runtime_checkable
class Progress(Protocol):
    """Tells how far a stage is; raises `CancelledError` when the operator has cancelled."""

    def __call__(self, done: float, text: str = "") -> None:
        """Report the share done in [0, 1] and what is being done."""
        ...
