"""The part that simulated cameras and projectors share: a cable that may be unplugged for good."""

from backend.devices.errors import DeviceDisconnected
from backend.devices.link import Link
from backend.devices.protocols import DeviceInfo, LinkState


class SimulatedLink(Link):
    """A device's life where opening takes no time."""

    answers_within_s = 600.0
    """A picture is computed: on a small machine, with kernels that have to be compiled first, that may take minutes."""

    def __init__(self, name: str, info: DeviceInfo) -> None:
        super().__init__(name, info)
        self._gone_for_good = False

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

    def _lose_cable(self, why: str, *, for_good: bool) -> DeviceDisconnected:
        self._gone_for_good = for_good
        return self._lose(why)
