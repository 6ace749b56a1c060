"""GigE Vision's control protocol (GVCP): commands, answers and registers as bytes.

Source: GigE Vision's public facts as every open driver uses them: big endian, UDP port 3956, a header of eight bytes.
"""

import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

PORT = 3956
MAGIC = 0x42

_REQUEST = struct.Struct(">BBHHH")
_ANSWER = struct.Struct(">HHHH")


class Command(IntEnum):
    """What a client asks; the answer's command is one more."""

    DISCOVERY = 0x0002
    PACKET_RESEND = 0x0040
    READ_REGISTER = 0x0080
    WRITE_REGISTER = 0x0082
    READ_MEMORY = 0x0084
    WRITE_MEMORY = 0x0086


class Status(IntEnum):
    """How a device answers."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    ERROR = 0x8FFF


class RefusedError(Exception):
    """A command that a device doesn't carry out; the status says why."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


class Bootstrap(IntEnum):
    """Addresses of the registers that every GigE Vision device has."""

    VERSION = 0x0000
    DEVICE_MODE = 0x0004
    MAC_HIGH = 0x0008
    MAC_LOW = 0x000C
    IP_CONFIG = 0x0010
    CURRENT_IP = 0x0024
    SUBNET_MASK = 0x0034
    VENDOR = 0x0048
    MODEL = 0x0068
    DEVICE_VERSION = 0x0088
    INFORMATION = 0x00A8
    SERIAL = 0x00D8
    USER_NAME = 0x00E8
    XML_URL = 0x0200
    INTERFACES = 0x0600
    STREAM_CHANNELS = 0x0904
    CAPABILITY = 0x0934
    HEARTBEAT_MS = 0x0938
    TICK_FREQUENCY_HIGH = 0x093C
    TICK_FREQUENCY_LOW = 0x0940
    CONTROL = 0x0A00
    CONTROLLER_PORT = 0x0A04
    CONTROLLER_ADDRESS = 0x0A14
    STREAM_PORT = 0x0D00
    PACKET_SIZE = 0x0D04
    PACKET_DELAY = 0x0D08
    STREAM_ADDRESS = 0x0D18


DISCOVERY_BYTES = 0xF8
"""The answer to a discovery is the first bytes of the registers."""


@dataclass(frozen=True)
class Request:
    """One command as it came."""

    command: int
    request_id: int
    wants_answer: bool
    payload: bytes


def parse_request(packet: bytes) -> Request | None:
    """Read a command; None if it isn't one."""
    if len(packet) < _REQUEST.size:
        return None
    magic, flags, command, length, request_id = _REQUEST.unpack_from(packet)
    payload = packet[_REQUEST.size :]
    if magic != MAGIC or length > len(payload):
        return None
    return Request(command, request_id, bool(flags & 1), payload[:length])


def request(command: Command, payload: bytes = b"", *, request_id: int = 0xFFFF) -> bytes:
    """Write a command that wants an answer."""
    return _REQUEST.pack(MAGIC, 1, command, len(payload), request_id) + payload


def answer(to: Request, payload: bytes, status: Status = Status.SUCCESS) -> bytes:
    """Write the answer to a command."""
    return _ANSWER.pack(status, to.command + 1, len(payload), to.request_id) + payload


_ROUNDS = 2


@dataclass(frozen=True)
class Found:
    """A device that answered."""

    address: str
    vendor: str
    model: str
    serial: str


def ask(addresses: Sequence[str], *, timeout_s: float = 0.3) -> tuple[Found, ...]:
    """Ask known addresses, and nobody else, who is there.

    Parameters
    ----------
    addresses
        IPv4 addresses; each gets one datagram. Nothing is broadcast: the system refuses such an address
        to a socket like this one.
    timeout_s
        How long to wait for the slowest, in [s].
    """
    found: dict[str, Found] = {}
    waiting_for = set(addresses)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _ in range(_ROUNDS):  # a datagram may get lost
            waiting_for = {a for a in waiting_for if _sent(asking, request(Command.DISCOVERY), a)}
            deadline_s = time.monotonic() + timeout_s / _ROUNDS
            while waiting_for and (came := _received(asking, deadline_s)):
                data, address = came
                device = _found(address, data)
                if device and address in waiting_for:
                    found[address] = device
                    waiting_for.discard(address)
    return tuple(found[a] for a in dict.fromkeys(addresses) if a in found)


def read_register(address: str, register: int, *, timeout_s: float = 0.3) -> int | Status | None:
    """Ask one device for one of its registers: the value, why it refuses, or None if it doesn't answer.

    Reading needs no control, so a camera that somebody uses isn't disturbed.
    """
    question = request(Command.READ_REGISTER, register.to_bytes(4))
    came = None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _ in range(_ROUNDS):
            if came is None and _sent(asking, question, address):
                came = _received(asking, time.monotonic() + timeout_s / _ROUNDS)
    if came is None:
        return None
    data, _ = came
    status, command, _length, _id = _ANSWER.unpack_from(data.ljust(_ANSWER.size, b"\0"))
    if command != Command.READ_REGISTER + 1:
        return None
    if status == Status.SUCCESS and len(data) >= _ANSWER.size + 4:
        return int.from_bytes(data[_ANSWER.size : _ANSWER.size + 4])
    return Status(status) if status in set(Status) else Status.ERROR


def _sent(asking: socket.socket, packet: bytes, address: str) -> bool:
    try:
        asking.sendto(packet, (address, PORT))
    except OSError:  # no way leads there
        return False
    return True


def _received(asking: socket.socket, deadline_s: float) -> tuple[bytes, str] | None:
    """Return the next datagram and its sender; None when time is up."""
    while (left_s := deadline_s - time.monotonic()) > 0:
        asking.settimeout(left_s)
        try:
            data, (address, _port) = asking.recvfrom(1024)
        except TimeoutError:
            return None
        except ConnectionError:  # one address refuses; others may still answer
            continue
        return data, address
    return None


def _found(address: str, data: bytes) -> Found | None:
    if len(data) < _ANSWER.size + DISCOVERY_BYTES:
        return None
    status, command, _length, _id = _ANSWER.unpack_from(data)
    if (status, command) != (Status.SUCCESS, Command.DISCOVERY + 1):
        return None
    registers = data[_ANSWER.size :]
    vendor, model = (_text(registers, a, 32) for a in (Bootstrap.VENDOR, Bootstrap.MODEL))
    return Found(address, vendor, model, _text(registers, Bootstrap.SERIAL, 16))


def _text(registers: bytes, address: int, length: int) -> str:
    return registers[address : address + length].split(b"\0")[0].decode("ascii", "replace")
