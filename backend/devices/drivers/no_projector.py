"""No projector at all: to try cameras alone, before the projector is there, or for the author of a camera's driver."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from backend.devices.link import Link
from backend.devices.options import DeviceOptions, DisplaySize, read_options, takes
from backend.devices.pages import PageDesk
from backend.devices.protocols import DeviceInfo, LinkState, Presented, ProjectorCapabilities
from backend.devices.refusals import refuse_level, refuse_other_sizes, refuse_unloaded


class NoProjectorOptions(DeviceOptions):
    """What is pretended."""

    size: DisplaySize = (64, 48)
    """Width and height in [px] of patterns that nobody sees."""


@takes(NoProjectorOptions)
def create_projector(name: str, options: Mapping[str, Any], desk: PageDesk) -> "NoProjector":
    """Make the projector of a rig file's entry."""
    del desk  # it has no page
    return NoProjector(name, read_options(NoProjectorOptions, name, options))


class NoProjector(Link):
    """A `Projector` that shows nothing: cameras see the room's light, whatever pattern is asked for."""

    def __init__(self, name: str, options: NoProjectorOptions) -> None:
        super().__init__(name, DeviceInfo("", "no projector", driver="none"))
        self._size = options.size
        self._loaded = 0

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return ProjectorCapabilities(self._size, linear=True)

    def open(self) -> None:
        """Have nothing to open."""
        if self._state in (LinkState.CLOSED, LinkState.LOST):
            self._state = LinkState.READY

    def close(self) -> None:
        """Have nothing to close."""
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Open again."""
        del timeout_s  # it is back at once
        self.close()
        self.open()

    def load(self, patterns: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        """Check patterns, and forget them."""
        self._need_link()
        refuse_other_sizes(self.name, patterns, self._size)
        self._loaded = len(patterns)

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        """Show nothing."""
        del timeout_s  # that takes no time
        self._need_link()
        refuse_unloaded(self.name, index, self._loaded)
        return Presented(index, time.monotonic(), None, confirmed=True)

    def blank(self, level: int = 0) -> Presented:
        """Show nothing."""
        self._need_link()
        refuse_level(self.name, level)
        return Presented(-1, time.monotonic(), None, confirmed=True)
