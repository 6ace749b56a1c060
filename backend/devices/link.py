"""The part that cameras and projectors share, real and simulated: a device's life, and what is refused in which state."""

from typing import TypeVar

from backend.devices.errors import DeviceDisconnected
from backend.devices.protocols import DeviceInfo, LinkState

AnyLink = TypeVar("AnyLink", bound="Link")
"""Not `Self`: the shape checks of the tests can't execute that on single methods."""


class Link:
    """A device's life as `backend.devices.protocols` draws it; drivers set the state."""

    def __init__(self, name: str, info: DeviceInfo) -> None:
        self._name = name
        self._info = info
        self._state = LinkState.CLOSED

    @property
    def name(self) -> str:
        """The device's name in its rig."""
        return self._name

    @property
    def info(self) -> DeviceInfo:
        """Who the device is; complete after `open`."""
        return self._info

    @property
    def state(self) -> LinkState:
        """Where the device is in its life."""
        return self._state

    def open(self) -> None:
        """Take control."""
        raise NotImplementedError

    def close(self) -> None:
        """Give the device back."""
        raise NotImplementedError

    def __enter__(self: AnyLink) -> AnyLink:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _lose(
        self, why: str, *, cure: str = "check cable and power, then reconnect"
    ) -> DeviceDisconnected:
        self._state = LinkState.LOST
        return DeviceDisconnected(self._name, f"{why}; {cure}")

    def _need_link(self) -> None:
        if self._state is LinkState.LOST:
            raise DeviceDisconnected(self._name, "control is lost; reconnect")
        if self._state is LinkState.CLOSED:
            raise DeviceDisconnected(self._name, "the device is closed; open it first")
