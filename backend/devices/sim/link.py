"""The part that simulated cameras and projectors share: opening, closing, getting lost."""

from typing import TypeVar

from backend.devices.errors import DeviceDisconnected
from backend.devices.protocols import DeviceInfo, LinkState

AnyLink = TypeVar("AnyLink", bound="Link")
"""Not `Self`: the shape checks of the tests can't execute that on single methods."""


class Link:
    """A device's life as `backend.devices.protocols` draws it."""

    def __init__(self, name: str, info: DeviceInfo) -> None:
        self._name = name
        self._info = info
        self._state = LinkState.CLOSED
        self._gone_for_good = False

    @property
    def name(self) -> str:
        """The device's name in its rig."""
        return self._name

    @property
    def info(self) -> DeviceInfo:
        """Who the device is."""
        return self._info

    @property
    def state(self) -> LinkState:
        """Where the device is in its life."""
        return self._state

    def open(self) -> None:
        """Take control."""
        if self._gone_for_good:
            raise DeviceDisconnected(
                self._name, "the simulated cable stays unplugged (fail_for_good); open the rig anew"
            )
        if self._state in (LinkState.CLOSED, LinkState.LOST):
            self._state = LinkState.READY

    def close(self) -> None:
        """Give the device back."""
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Close and open; the settings and patterns of before hold again."""
        del timeout_s  # a simulated cable is back at once or never
        self.close()
        self.open()

    def __enter__(self: AnyLink) -> AnyLink:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _lose(self, why: str, *, for_good: bool = False) -> DeviceDisconnected:
        self._state = LinkState.LOST
        self._gone_for_good = for_good
        return DeviceDisconnected(self._name, f"{why}; check cable and power, then reconnect")

    def _need_link(self) -> None:
        if self._state is LinkState.LOST:
            raise DeviceDisconnected(self._name, "control is lost; reconnect")
        if self._state is LinkState.CLOSED:
            raise DeviceDisconnected(self._name, "the device is closed; open it first")
