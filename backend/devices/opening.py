"""Open the devices of a rig: all of them or none."""

from collections.abc import Iterable
from contextlib import ExitStack

from backend.devices.protocols import Device


def open_all(devices: Iterable[Device]) -> None:
    """Open every device in turn; when one refuses, those before it are closed again."""
    with ExitStack() as undo:
        for device in devices:
            device.open()
            undo.callback(device.close)
        undo.pop_all()
