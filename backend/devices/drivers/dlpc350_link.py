"""Commands to a DLPC350 over USB HID, or over a socket to a simulated one: one at a time, every answer checked.

Whatever has `write` (report number and 64 bytes) and `read` (64 bytes, timeout in ms) serves as a connection; that is
how `hid.device` of the package hidapi looks.
"""

import contextlib
import importlib
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from backend.devices import dlpc350_protocol as protocol
from backend.devices.dlpc350_protocol import Command, Request
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
)

INSTALL = "pip install 'unglare[lightcrafter]'"

_ANSWER_S = 2.0
_CONNECT_S = 2.0
_CLOSE_S = 2 * _ANSWER_S


@runtime_checkable
class HidLike(Protocol):
    """What is needed of a connection; `hid.device` has it."""

    def write(self, data: bytes) -> int:
        """Send the report number 0 and a report of 64 bytes; a negative number or OSError: the device is gone."""
        ...

    def read(self, max_length: int, timeout_ms: int = 0) -> Sequence[int]:
        """Return the next report; empty when none came in time, OSError: the device is gone."""
        ...

    def close(self) -> None:
        """Give the connection back."""
        ...


Connect = Callable[[str], HidLike]
"""Opens a connection for the device of this name; raises `DeviceNotFound` or `DeviceBusy`."""


def connection(transport: str) -> Connect:
    """Return how to reach `usb`, `usb:SERIAL` or `unix:PATH`.

    Raises
    ------
    ValueError
        If it is none of them.
    """
    kind, _, rest = transport.partition(":")
    if kind == "usb":
        return lambda name: open_usb(name, rest)
    if kind == "unix" and rest:
        return lambda name: SocketHid.at(name, rest)
    raise ValueError("use usb, usb:SERIAL or unix:/PATH/OF/A/SIMULATED/DEVICE")


def hidapi(name: str) -> Any:
    """Import the library, an extra: only where a LightCrafter is opened.

    Raises
    ------
    DeviceNotFound
        If it isn't installed.
    """
    try:
        hid: Any = importlib.import_module("hid")
    except ImportError as error:
        raise DeviceNotFound(
            name, f"a LightCrafter needs the package hidapi; install it: {INSTALL}"
        ) from error
    if not hasattr(hid, "device"):  # another package has the same name
        raise DeviceNotFound(
            name, f"the package hid stands before hidapi; run: pip uninstall hid; {INSTALL}"
        )
    return hid


def open_usb(name: str, serial: str = "") -> HidLike:
    """Open the LightCrafter on USB.

    Raises
    ------
    DeviceNotFound
        If hidapi isn't installed or no such device is there.
    DeviceBusy
        If it is there but can't be opened.
    """
    hid = hidapi(name)
    there = [
        found
        for found in hid.enumerate(protocol.VENDOR_ID, protocol.PRODUCT_ID)
        if not serial or found["serial_number"] == serial
    ]
    if not there:
        which = f" with serial number {serial}" if serial else ""
        raise DeviceNotFound(
            name, f"no LightCrafter 4500{which} is on USB; check its cable and power"
        )
    device = hid.device()
    try:
        device.open_path(there[0]["path"])
    except OSError as error:
        raise DeviceBusy(
            name,
            "the LightCrafter 4500 on USB can't be opened; close TI's program, or allow access to it (see the README)",
        ) from error
    opened: HidLike = device
    return opened


class SocketHid:
    """A connection to a simulated device: a socket that keeps reports apart (SOCK_SEQPACKET)."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock

    @classmethod
    def at(cls, name: str, path: str) -> "SocketHid":
        """Connect to a path.

        Raises
        ------
        DeviceNotFound
            If nobody listens there.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.settimeout(_CONNECT_S)
        try:
            sock.connect(path)
        except OSError as error:
            sock.close()
            raise DeviceNotFound(
                name, f"no simulated LightCrafter listens at {path}; start it first"
            ) from error
        return cls(sock)

    def write(self, data: bytes) -> int:
        """Send a report."""
        self._socket.settimeout(_ANSWER_S)
        return self._socket.send(data[1:]) + 1

    def read(self, max_length: int, timeout_ms: int = 0) -> bytes:
        """Receive a report."""
        self._socket.settimeout(max(timeout_ms, 1) / 1000.0)
        try:
            report = self._socket.recv(max_length)
        except TimeoutError:
            return b""
        if not report:
            raise ConnectionResetError("the simulated device hung up")
        return report

    def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(OSError):
            self._socket.close()


class Commands:
    """The commands over one connection; usable from any thread, one at a time.

    Parameters
    ----------
    device
        Name of the device, for sentences.
    connected
        The connection; closed by `close`.
    """

    def __init__(self, device: str, connected: HidLike) -> None:
        self._device = device
        self._hid = connected
        self._lock = threading.Lock()
        self._sequence = 0

    def close(self) -> None:
        """Give the connection back, after the command that another thread may be waiting for."""
        if not self._lock.acquire(timeout=_CLOSE_S):
            return  # hidapi frees what a call in progress still uses: rather leave it open than crash
        try:
            with contextlib.suppress(OSError, ValueError):
                self._hid.close()
        finally:
            self._lock.release()

    def write(self, command: Command, payload: bytes) -> None:
        """Send a command and wait until the device has acknowledged it.

        Raises
        ------
        FeatureError
            If the device refuses it.
        DeviceTimeout
            If no answer comes.
        DeviceDisconnected
            If the device is gone.
        """
        self._ask(command, payload, reads=False)

    def read(self, command: Command, least_bytes: int = 1) -> bytes:
        """Ask for a value; raises what `write` does, and `FeatureError` for an answer that is too short."""
        data = self._ask(command, b"", reads=True)
        if len(data) < least_bytes:
            raise FeatureError(
                self._device,
                f"the projector answered {_named(command)} with {len(data)} bytes instead of {least_bytes};"
                " check its firmware",
            )
        return data

    def _ask(self, command: Command, payload: bytes, *, reads: bool) -> bytes:
        with self._lock:
            self._sequence = (self._sequence + 1) & 0xFF
            request = Request(command, payload, self._sequence, reads)
            for report in request.reports():
                self._send(b"\0" + report)
            return self._answer(command)

    def _answer(self, command: Command) -> bytes:
        """Wait for the answer to the last request; answers that come too late for theirs are passed over."""
        deadline_s = time.monotonic() + _ANSWER_S
        while True:
            reports = [self._receive(command, deadline_s)]
            reports += [
                self._receive(command, deadline_s)
                for _ in range(protocol.reports_of(reports[0]) - 1)
            ]
            reply = protocol.parse_reply(reports)
            if reply is None or reply.sequence != self._sequence:
                continue
            if reply.refused:
                raise FeatureError(
                    self._device,
                    f"the projector refused {_named(command)}; check its firmware and that no other program uses it",
                )
            return reply.data

    def _send(self, report: bytes) -> None:
        try:
            sent = self._hid.write(report)
        except (OSError, ValueError) as error:
            raise self._gone() from error
        if sent < 0:
            raise self._gone()

    def _receive(self, command: Command, deadline_s: float) -> bytes:
        left_ms = round((deadline_s - time.monotonic()) * 1000.0)
        try:
            report = bytes(self._hid.read(protocol.REPORT_BYTES, max(left_ms, 1)))
        except (OSError, ValueError) as error:
            raise self._gone() from error
        if len(report) < protocol.HEADER_BYTES:
            raise DeviceTimeout(
                self._device,
                f"the projector didn't answer {_named(command)} within {_ANSWER_S:g} s; try again",
            )
        return report

    def _gone(self) -> DeviceDisconnected:
        return DeviceDisconnected(
            self._device,
            "the projector is gone from USB; check cable and power, then reconnect",
        )


def _named(command: Command) -> str:
    return f"command {command:04X} ({command.name.lower().replace('_', ' ')})"
