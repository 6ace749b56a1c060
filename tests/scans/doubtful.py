"""A simulated rig that nobody can be sure of: its display lags, tears, drops, swaps, fades; its cameras see other light."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from backend.devices.protocols import (
    Camera,
    DeviceInfo,
    Frame,
    LinkState,
    Presented,
    ProjectorCapabilities,
)
from backend.devices.sim import create_rig

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Fault = Callable[[Sequence[Picture], int], Picture]
"""Makes what is lit of everything that was to be shown so far, newest last, and of how many pictures that is."""


CameraFault = Callable[[Sequence[Frame], int], Frame]
"""Makes what a camera hands out of its last few frames, newest last, and of how many it has exposed."""


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


def at_random(share: float, fault: Fault) -> Fault:
    """Let so many of all pictures go wrong, nobody knows which."""
    rng = np.random.default_rng(5)
    return lambda asked, count: fault(asked, count) if rng.random() < share else asked[-1]


def every(n: int, fault: Fault) -> Fault:
    """Let every n-th picture go wrong."""
    return lambda asked, count: fault(asked, count) if count % n == 0 else asked[-1]


def rolling(asked: Sequence[Picture], count: int) -> Picture:
    """Show the pattern before from a row on that is another one each time."""
    row = count * 37 % asked[-1].shape[0]
    return np.vstack([asked[-1][:row], before(asked)[row:]])


def frozen_from(at: int) -> Fault:
    """Show the same from one picture on, counted from 0."""
    return lambda asked, count: asked[min(at, len(asked) - 1)]


def through(curve: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]) -> Fault:
    """Show every picture changed."""
    return lambda asked, count: np.rint(curve(asked[-1].astype(np.float64))).astype(np.uint8)


def _with(frame: Frame, gray: np.ndarray[Any, Any]) -> Frame:
    most = 2**frame.bits - 1
    return replace(frame, data=np.clip(np.rint(gray), 0, most).astype(frame.data.dtype))


def stale(frames: Sequence[Frame], count: int) -> Frame:
    """Hand out the frame before: one was waiting when the trigger came."""
    return frames[-2] if len(frames) > 1 else frames[-1]


def lamp(gray: Callable[[int], float]) -> CameraFault:
    """Let a lamp in the room add some gray levels, more in the middle of the picture than at its edges."""

    def fault(frames: Sequence[Frame], count: int) -> Frame:
        height, width = frames[-1].data.shape
        y, x = np.mgrid[:height, :width] / max(height, width)
        seen = gray(count) * (1 - (x - 0.5) ** 2 - (y - 0.4) ** 2)
        return _with(frames[-1], frames[-1].data + seen)

    return fault


def brighter(per_frame: float) -> CameraFault:
    """Let the camera expose longer and longer by itself."""
    return lambda frames, count: _with(frames[-1], frames[-1].data * (1 + per_frame * count))


def moved(at: int, columns: int) -> CameraFault:
    """Let somebody knock against the camera."""

    def fault(frames: Sequence[Frame], count: int) -> Frame:
        last = frames[-1]
        return _with(last, np.roll(last.data, columns, 1)) if count > at else last

    return fault


def covered(at: int, level: float = 4.0) -> CameraFault:
    """Let somebody put the cap on the lens, or light it straight, from one frame on."""

    def fault(frames: Sequence[Frame], count: int) -> Frame:
        noise = np.random.default_rng(count).normal(level, 1.0, frames[-1].data.shape)
        return _with(frames[-1], noise) if count > at else frames[-1]

    return fault


class DoubtfulCamera:
    """Hands out what its fault makes of the frames of another camera."""

    def __init__(self, inner: Camera, fault: CameraFault) -> None:
        self._inner, self._fault = inner, fault
        self._frames: list[Frame] = []
        self._count = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        self._frames = [*self._frames[-3:], self._inner.get_frame(timeout_s)]
        self._count += 1
        return self._fault(self._frames, self._count)


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
        self.cameras: Mapping[str, Any] = self._rig.cameras

    def spoil(self, fault: CameraFault, *cameras: str) -> None:
        """Let cameras go wrong: these, or all."""
        spoilt = cameras or tuple(self.cameras)
        self.cameras = {
            name: DoubtfulCamera(camera, fault) if name in spoilt else camera
            for name, camera in self._rig.cameras.items()
        }

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def __enter__(self) -> "DoubtfulRig":
        self._rig.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self._rig.close()
