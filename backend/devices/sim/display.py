"""The part that simulated projectors and screens share: patterns by index, and uniform fields."""

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from backend.devices.protocols import DeviceInfo, Presented
from backend.devices.refusals import refuse_level, refuse_other_sizes, refuse_unloaded
from backend.devices.sim.link import SimulatedLink


class Display(SimulatedLink):
    """A display of fixed size; how a pattern comes to light is up to its kind."""

    def __init__(self, name: str, info: DeviceInfo, size: tuple[int, int]) -> None:
        super().__init__(name, info)
        self._size = size
        self._patterns: list[UInt8[np.ndarray, "h w"]] = []

    def load(self, patterns: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        """Take patterns; they are copied."""
        self._need_link()
        refuse_other_sizes(self.name, patterns, self._size)
        self._patterns = [self._frozen(pattern) for pattern in patterns]

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        """Show a loaded pattern; lit when this returns."""
        del timeout_s  # the display always follows
        self._need_link()
        refuse_unloaded(self.name, index, len(self._patterns))
        return self._present(self._patterns[index], index)

    def blank(self, level: int = 0) -> Presented:
        """Show the whole field at one code."""
        self._need_link()
        refuse_level(self.name, level)
        return self._present(self._uniform(level), -1)

    @abstractmethod
    def _present(self, pattern: UInt8[np.ndarray, "h w"], index: int) -> Presented:
        """Bring a pattern to light."""

    def _uniform(self, level: int) -> UInt8[np.ndarray, "h w"]:
        width, height = self._size
        return self._frozen(np.full((height, width), level, np.uint8))

    def _frozen(self, pattern: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
        copy = np.array(pattern, dtype=np.uint8, order="C")
        copy.setflags(write=False)
        return copy
