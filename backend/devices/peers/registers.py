"""A device's register space: bytes at addresses, some of them writable, some doing something when written."""

from bisect import bisect_right
from collections.abc import Callable

from backend.devices.peers.gvcp import RefusedError, Status

Writer = Callable[[bytes], None]
"""Carries out what a written register asks for; raises `RefusedError` if it can't."""

_SPACE = 0x10000


class Registers:
    """Registers below 64 KiB as one block, longer memory (a description) behind it."""

    def __init__(self) -> None:
        self._space = bytearray(_SPACE)
        self._memories: dict[int, bytes] = {}
        self._writable: dict[int, tuple[int, Writer | None]] = {}

    def number(self, address: int, value: int) -> None:
        """Set a register of four bytes."""
        self._space[address : address + 4] = value.to_bytes(4)

    def text(self, address: int, text: str, length: int) -> None:
        """Set a text of fixed length, ended by at least one zero."""
        data = text.encode("ascii", "replace")[: length - 1]
        self._space[address : address + length] = data.ljust(length, b"\0")

    def memory(self, address: int, data: bytes) -> None:
        """Set bytes anywhere."""
        if address >= _SPACE:
            self._memories[address] = data
        else:
            self._space[address : address + len(data)] = data

    def writable(self, address: int, length: int, act: Writer | None) -> None:
        """Let clients write a register; `act` is called instead of storing the value."""
        self._writable[address] = length, act

    def read(self, address: int, length: int) -> bytes:
        """Return bytes; raises `RefusedError` where nothing is."""
        if address + length <= _SPACE:
            return bytes(self._space[address : address + length])
        starts = sorted(self._memories)
        index = bisect_right(starts, address) - 1
        if index < 0:
            raise RefusedError(Status.INVALID_ADDRESS)
        data = self._memories[starts[index]]
        offset = address - starts[index]
        if offset >= len(data):
            raise RefusedError(Status.INVALID_ADDRESS)
        return data[offset : offset + length].ljust(length, b"\0")  # clients read whole words

    def read_number(self, address: int) -> int:
        """Return a register of four bytes."""
        return int.from_bytes(self.read(address, 4))

    def write(self, address: int, data: bytes) -> None:
        """Write as a client; raises `RefusedError` if the register can't be written."""
        if address not in self._writable:
            known = 0 <= address < _SPACE
            raise RefusedError(Status.WRITE_PROTECT if known else Status.INVALID_ADDRESS)
        length, act = self._writable[address]
        if len(data) != length:
            raise RefusedError(Status.INVALID_PARAMETER)
        if act is None:
            self._space[address : address + length] = data
        else:
            act(data)
