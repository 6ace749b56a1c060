"""A camera that somebody found: who it is, and what a rig file says of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml


@dataclass(frozen=True)
class FoundCamera:
    """A camera that a driver could open."""

    driver: str
    options: Mapping[str, Any]
    """What the driver needs to find it again, e.g. its address."""
    vendor: str = ""
    model: str = ""
    serial: str = ""
    address: str = ""
    """IPv4 address; empty for cameras that have none."""
    controlled_by: str | None = None
    """Who controls it: empty: nobody; None: not known."""
    used_in: tuple[str, ...] = field(default=())
    """Where it stands in rig files already, e.g. `bench: left`."""

    @property
    def rig_line(self) -> str:
        """The entry of a rig file, without the camera's name.

        Examples
        --------
        >>> FoundCamera("aravis", {"address": "192.168.10.2"}).rig_line
        '{driver: aravis, address: 192.168.10.2}'
        >>> FoundCamera("pylon", {"serial": "24512345"}).rig_line
        "{driver: pylon, serial: '24512345'}"
        """
        entry = {"driver": self.driver, **self.options}
        text: str = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, width=10_000)
        return text.strip()
