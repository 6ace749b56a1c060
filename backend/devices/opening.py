"""Open the devices of a rig: all of them or none."""

from collections.abc import Iterable
from contextlib import ExitStack

from backend.devices.foreign import is_ours, named, refuse_other_types
from backend.devices.protocols import Device


def open_all(devices: Iterable[Device]) -> None:
    """Open every device in turn; when one refuses, those before it are closed again."""
    with ExitStack() as undo:
        for device in devices:
            with named(device, "opening"):
                device.open()
            undo.callback(device.close)
            if not is_ours(device):
                refuse_other_types(device)
        undo.pop_all()
