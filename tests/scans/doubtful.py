"""A simulated rig behind a display that nobody can be sure of: it lags, tears, drops, swaps, fades."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from backend.devices.protocols import (
    Camera,
    DeviceInfo,
    LinkState,
    Presented,
    ProjectorCapabilities,
)
from backend.devices.sim import create_rig

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Fault = Callable[[Sequence[Picture], int], Picture]
"""Makes what is lit of everything that was to be shown so far, newest last, and of how many pictures that is."""


def right(asked: Sequence[Picture], count: int) -> Picture:
    """Show what was asked for."""
    return asked[-1]


def before(asked: Sequence[Picture], patterns: int = 1) -> Picture:
    """Return what was asked for so many patterns ago; black before the first."""
    return asked[-1 - patterns] if len(asked) > patterns else np.zeros_like(asked[-1])


def late(patterns: int) -> Fault:
    """Show what was asked for so many patterns ago."""
    return lambda asked, count: before(asked, patterns)


def mixed(share: float) -> Fault:
    """Let so much of each exposure still see the pattern before: a lag shorter than the exposure."""

    def fault(asked: Sequence[Picture], count: int) -> Picture:
        now = asked[-1].astype(np.float64)
        mixture: Picture = np.rint((1 - share) * now + share * before(asked)).astype(np.uint8)
        return mixture

    return fault


def once(at: int, fault: Fault) -> Fault:
    """Let one picture go wrong, counted from 0."""
    return lambda asked, count: fault(asked, count) if count == at + 1 else asked[-1]


def always_from(at: int, fault: Fault) -> Fault:
    """Let every picture go wrong from one on."""
    return lambda asked, count: fault(asked, count) if count > at else asked[-1]


def torn(asked: Sequence[Picture], count: int) -> Picture:
    """Show the pattern before in the lower third."""
    rows = 2 * asked[-1].shape[0] // 3
    return np.vstack([asked[-1][:rows], before(asked)[rows:]])


def dark(asked: Sequence[Picture], count: int) -> Picture:
    """Show nothing."""
    return np.zeros_like(asked[-1])


def fading(per_picture: float) -> Fault:
    """Let the lamp fade."""

    def fault(asked: Sequence[Picture], count: int) -> Picture:
        faded: Picture = np.rint(asked[-1] * (1 - per_picture * count)).astype(np.uint8)
        return faded

    return fault


@dataclass
class DoubtfulProjector:
    """Shows what its fault makes of what it is asked to show."""

    inner: Any
    fault: Fault = right
    loaded: list[Picture] = field(default_factory=list)
    asked: list[Picture] = field(default_factory=list)
    """Everything that was to be shown, from the first on; kept short: faults look back a few pictures."""
    comes_to_rest: bool = False
    """Whether it is right if one waits."""

    @property
    def name(self) -> str:
        return str(self.inner.name)

    @property
    def info(self) -> DeviceInfo:
        info: DeviceInfo = self.inner.info
        return info

    @property
    def state(self) -> LinkState:
        state: LinkState = self.inner.state
        return state

    @property
    def capabilities(self) -> ProjectorCapabilities:
        can: ProjectorCapabilities = self.inner.capabilities
        return replace(can, certain=False, sequence=False)

    def open(self) -> None:
        self.inner.open()

    def close(self) -> None:
        self.inner.close()

    def reconnect(self, timeout_s: float = 10.0) -> None:
        self.inner.reconnect(timeout_s)

    def __enter__(self) -> "DoubtfulProjector":
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def load(self, patterns: Sequence[Picture]) -> None:
        self.loaded = list(patterns)

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        self.asked.append(self.loaded[index])
        lit = self.fault(self.asked, len(self.asked))
        self.inner.load([lit])
        self.inner.show(0)
        return Presented(index, 0.0, None, confirmed=True)

    def rest(self) -> None:
        """Let time pass."""
        if self.comes_to_rest:
            self.inner.load([self.asked[-1]])
            self.inner.show(0)

    def blank(self, level: int = 0) -> Presented:
        presented: Presented = self.inner.blank(level)
        return presented


class DoubtfulRig:
    """A simulated rig whose display isn't certain of its light."""

    def __init__(
        self, fault: Fault = right, *, comes_to_rest: bool = False, **options: object
    ) -> None:
        self._rig = create_rig(options)
        self.projector: Any = DoubtfulProjector(
            self._rig.projector, fault, comes_to_rest=comes_to_rest
        )
        self.name = "doubtful"

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return self._rig.cameras

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def __enter__(self) -> "DoubtfulRig":
        self._rig.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self._rig.close()
