"""Commands of a LightCrafter on a slow connection."""

import threading

from backend.devices import dlpc350_protocol as protocol
from backend.devices.dlpc350_protocol import Command
from backend.devices.drivers.dlpc350_link import Commands


class SlowHid:
    """A connection whose device takes its time to answer."""

    def __init__(self) -> None:
        self.asked, self.answers, self.closed = (threading.Event() for _ in range(3))
        self.closed_while_asked = False

    def write(self, data: bytes) -> int:
        return len(data)

    def read(self, max_length: int, timeout_ms: int = 0) -> bytes:
        del max_length, timeout_ms
        self.asked.set()
        self.answers.wait(60)
        self.closed_while_asked = self.closed.is_set()
        return next(protocol.Reply(1).reports())

    def close(self) -> None:
        self.closed.set()


def test_a_connection_is_not_closed_under_a_command():
    """hidapi frees what a read in another thread still uses."""
    hid = SlowHid()
    commands = Commands("projector", hid)
    asking = threading.Thread(target=commands.write, args=(Command.POWER, b"\0"))
    hanging_up = threading.Thread(target=commands.close)
    asking.start()
    assert hid.asked.wait(60)
    hanging_up.start()
    assert not hid.closed.wait(0.05)
    hid.answers.set()
    asking.join(5)
    hanging_up.join(5)
    assert hid.closed.is_set()
    assert not hid.closed_while_asked
