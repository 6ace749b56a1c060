"""A simulated DLPC350: the LightCrafter 4500's controller as its host sees it, before any display that is told what to show.

Registers, tables of images and patterns, validation, refusals and the trigger output are the real one's, as far as its
guide and public drivers tell. Sequences run on a time line of their own: edge k stands at start + k periods, however
late this program gets round to it.
"""

import contextlib
import logging
import os
import socket
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from backend.devices import dlpc350_protocol as protocol
from backend.devices.dlpc350_protocol import (
    Action,
    Command,
    DisplayMode,
    LutEntry,
    Mailbox,
    MainStatus,
    PatternSource,
    Reply,
    Request,
    Validation,
)
from backend.devices.errors import DeviceError
from backend.devices.pattern_set import unpacked

log = logging.getLogger(__name__)

Picture = UInt8[np.ndarray, "h w"]

_POLL_S = 0.1
_HANG_UP_S = 0.5
"""So long a new client waits for one that has just hung up."""
_FIRMWARE = bytes((0, 0, 1, 4))
"""4.1.0, low byte first."""


@runtime_checkable
class Lamp(Protocol):
    """What the controller drives: mirrors, LEDs and the trigger line. The simulated rig's projector is one."""

    def now_s(self) -> float:
        """Return the time, on the clock that edges are told on; it has to be real time."""
        ...

    def light(self, picture: UInt8[np.ndarray, "h w"]) -> None:
        """Show a picture from now on."""
        ...

    def edge(self, time_s: float, shown_us: float) -> None:
        """Fire the trigger line: a pattern that began (or begins) at a time is shown for so long."""
        ...


@dataclass
class Faults:
    """What goes wrong; may be changed while the device runs."""

    refused: Collection[int] = ()
    """Commands that are answered with NACK."""
    unanswered: Collection[int] = ()
    """Commands that get no answer."""
    found: int = 0
    """What every validation finds besides."""
    busy_polls: int = 0
    """How often a validation says that it isn't through yet."""
    ignored_starts: int = 0
    """So many starts are acknowledged, and nothing starts."""


@dataclass
class _Registers:
    """What was written last; the values after power-up."""

    power: bytes = b"\1"
    mode: bytes = bytes((DisplayMode.VIDEO,))
    source: bytes = bytes((PatternSource.VIDEO_PORT,))
    trigger_mode: bytes = b"\0"
    led_enable: bytes = b"\0"
    led_currents: bytes = b"\xff\xff\xff"
    trigger_out_1: bytes = b"\0\xbb\xbb"
    trigger_out_2: bytes = b"\0\xbb"
    timing: bytes = field(default_factory=lambda: protocol.timing_payload(8333, 8333))
    sequence: bytes = b"\0\0\0\0"


@dataclass(frozen=True)
class _Step:
    """One pattern of a sequence, ready to be shown."""

    picture: UInt8[np.ndarray, "h w"]
    swaps: bool
    """Whether it comes with another image."""
    loading_ms: float = 0.0
    """How long that image takes to load while the one before is shown; 0: it is in memory already."""
    stale: UInt8[np.ndarray, "h w"] | None = None
    """What is shown where that isn't done in time: the same bits of the image before."""


_SETTINGS = {
    Command.POWER: ("power", 1),
    Command.DISPLAY_MODE: ("mode", 1),
    Command.PATTERN_SOURCE: ("source", 1),
    Command.TRIGGER_MODE: ("trigger_mode", 1),
    Command.LED_ENABLE: ("led_enable", 1),
    Command.LED_CURRENTS: ("led_currents", 3),
    Command.TRIGGER_OUT_1: ("trigger_out_1", 3),
    Command.TRIGGER_OUT_2: ("trigger_out_2", 2),
    Command.TIMING: ("timing", 8),
    Command.SEQUENCE: ("sequence", 4),
}
"""Commands that keep a value of so many bytes."""

_STOPPED_ONLY = {
    Command.DISPLAY_MODE,
    Command.PATTERN_SOURCE,
    Command.TRIGGER_MODE,
    Command.TRIGGER_OUT_1,
    Command.TRIGGER_OUT_2,
    Command.TIMING,
    Command.SEQUENCE,
    Command.MAILBOX_DATA,
    Command.IMAGE_LOAD_TIME,
}
"""Refused while a sequence runs; all but the last unmake a validation."""


class SimulatedDlpc350:
    """The device. `pair` connects a client in this process, `listen` one in another; one client at a time.

    Parameters
    ----------
    lamp
        What it drives.
    flash
        The images in its flash, 24-bit RGB of 912x1140 px.
    faults
        What goes wrong.
    """

    def __init__(
        self,
        lamp: Lamp,
        flash: Sequence[UInt8[np.ndarray, "h w 3"]],
        faults: Faults | None = None,
    ) -> None:
        width, height = protocol.SIZE_PX
        for number, image in enumerate(flash):
            if image.shape != (height, width, 3):
                raise ValueError(f"image {number} in flash has {image.shape}, not {width}x{height}")
        self.faults = faults or Faults()
        self.late_images = 0
        """Images that weren't loaded from flash when the sequence wanted them."""
        self.served_clients = 0
        """Clients since it was made; a reconnected one counts again."""
        self.registers = _Registers()
        self._lamp = lamp
        self._flash = tuple(flash)
        self._black = np.zeros((height, width), np.uint8)
        self._mailbox, self._offset = Mailbox.CLOSED, 0
        self._images, self._entries = b"", b""
        self._validated, self._polls = Validation(0), 0
        self._is_valid = False
        self._timed_image = 0
        self._action = Action.STOP
        self._halt = threading.Event()
        self._player: threading.Thread | None = None
        self._ending = threading.Event()
        self._client: socket.socket | None = None
        self._taken = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._listener: tuple[socket.socket, str] | None = None

    # ------------------------------------------------------------ clients

    def pair(self) -> socket.socket:
        """Return the client's end of a connection in this process.

        Raises
        ------
        ConnectionRefusedError
            If there is a client already.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if not self._serve(ours):
            theirs.close()
            raise ConnectionRefusedError("the simulated LightCrafter has a client already")
        return theirs

    def listen(self, path: str) -> None:
        """Let a client in another process connect at a path, from now on.

        Raises
        ------
        OSError
            If the path can't be used.
        """
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            listener.bind(path)
            listener.listen(1)
            listener.settimeout(_POLL_S)
        except OSError:
            listener.close()
            raise
        self._listener = (listener, path)
        self._run(lambda: self._accept(listener), f"dlpc350-{path}")

    def unplug(self) -> None:
        """Drop the client, as when the cable is pulled; a sequence that runs goes on. It may connect again."""
        client = self._client
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def stop(self) -> None:
        """Go dark and hang up; any number of times."""
        self._ending.set()
        self._stop_playing()
        self.unplug()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        if self._listener is not None:
            listener, path = self._listener
            self._listener = None
            listener.close()
            with contextlib.suppress(OSError):
                os.unlink(path)

    def __enter__(self) -> "SimulatedDlpc350":
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _run(self, work: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=work, name=name, daemon=True)
        self._threads = [t for t in self._threads if t.is_alive()]
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket) -> None:
        while not self._ending.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            if not self._serve(connection):
                log.warning("A second client of the simulated LightCrafter was turned away.")

    def _serve(self, connection: socket.socket) -> bool:
        """Answer a client in a thread of its own; a second one is hung up on."""
        if not self._taken.acquire(timeout=_HANG_UP_S):
            connection.close()
            return False
        self._client = connection
        self.served_clients += 1
        self._run(lambda: self._answer(connection), "dlpc350-client")
        return True

    def _answer(self, connection: socket.socket) -> None:
        try:
            with connection:
                for reports in _messages(connection, self._ending):
                    request = protocol.parse_request(reports)
                    reply = None if request is None else self._reply(request)
                    if reply is not None:
                        for report in reply.reports():
                            connection.sendall(report)
        except OSError:
            return
        finally:
            self._client = None
            self._taken.release()

    # ------------------------------------------------------------ commands

    def _reply(self, request: Request) -> Reply | None:
        if request.command in self.faults.unanswered:
            return None
        refused, data = False, b""
        try:
            if request.command in self.faults.refused:
                raise ValueError("as asked for")
            command = Command(request.command)
            if request.reads:
                data = self._read(command)
            else:
                self._write(command, request.payload)
        except (ValueError, IndexError):  # an unknown command, a value that can't be, or not now
            refused = True
        wants = request.reads or request.wants_reply
        return Reply(request.sequence, data, refused, request.reads) if wants else None

    def _read(self, command: Command) -> bytes:
        if command in _SETTINGS:
            value: bytes = getattr(self.registers, _SETTINGS[command][0])
            return value
        match command:
            case Command.VERSION:
                return _FIRMWARE * 4
            case Command.MAIN_STATUS:
                running = MainStatus.RUNNING if self._action is Action.START else MainStatus(0)
                return bytes((running,))
            case Command.START_STOP:
                return bytes((self._action,))
            case Command.VALIDATE:
                self._polls += 1
                busy = self._polls <= self.faults.busy_polls
                return bytes((Validation.BUSY if busy else self._validated,))
            case Command.IMAGES_IN_FLASH:
                return bytes((len(self._flash),))
            case Command.IMAGE_LOAD_TIME:
                ticks = round(load_ms(self._flash[self._timed_image]) * protocol.LOAD_TICKS_PER_MS)
                return ticks.to_bytes(4, "little")
            case Command.MAILBOX_DATA:
                return self._images if self._mailbox is Mailbox.IMAGES else self._entries
        raise ValueError("can't be read")

    def _write(self, command: Command, payload: bytes) -> None:
        running = self._action is Action.START
        if running and command in _STOPPED_ONLY:
            raise ValueError("stop the sequence first")
        if command in _STOPPED_ONLY - {Command.IMAGE_LOAD_TIME}:
            self._is_valid = False
        if command in _SETTINGS:
            name, length = _SETTINGS[command]
            if len(payload) != length:
                raise ValueError("a payload of another length")
            setattr(self.registers, name, payload)
            return
        acts: dict[int, Callable[[bytes], None]] = {
            Command.MAILBOX: self._open_mailbox,
            Command.MAILBOX_OFFSET: self._set_offset,
            Command.MAILBOX_DATA: self._fill,
            Command.VALIDATE: lambda _: self._validate(),
            Command.IMAGE_LOAD_TIME: self._time_image,
            Command.START_STOP: lambda payload: self._act(Action(payload[0])),
        }
        if command not in acts:
            raise ValueError("can't be written")
        acts[command](payload)

    def _open_mailbox(self, payload: bytes) -> None:
        self._mailbox = Mailbox(payload[0])

    def _set_offset(self, payload: bytes) -> None:
        self._offset = payload[0]

    def _time_image(self, payload: bytes) -> None:
        if payload[0] >= len(self._flash):
            raise ValueError("no such image")
        self._timed_image = payload[0]

    def _validate(self) -> None:
        self._validated, self._polls = self._found() | Validation(self.faults.found), 0
        self._is_valid = not self._validated & _INVALID

    def _fill(self, payload: bytes) -> None:
        if self._mailbox is Mailbox.IMAGES:
            self._images = self._images[: self._offset] + payload
        elif self._mailbox is Mailbox.PATTERNS and len(payload) % 3 == 0:
            self._entries = self._entries[: 3 * self._offset] + payload
        else:
            raise ValueError("no mailbox is open for that")

    # ------------------------------------------------------------ sequences

    def _table(self) -> tuple[LutEntry, ...]:
        count = self.registers.sequence[0] + 1
        packed = self._entries[: 3 * count]
        return tuple(LutEntry.parse(packed[i : i + 3]) for i in range(0, len(packed), 3))

    def _image_numbers(self) -> tuple[int, ...]:
        return protocol.images_in(self._images[: self.registers.sequence[3] + 1])

    def _found(self) -> Validation:
        """Check timing and tables as the device does."""
        entries, images = self._table(), self._image_numbers()
        depths = {entry.bit_depth for entry in entries}
        numbers_fit = (
            len(entries) == self.registers.sequence[0] + 1
            and depths <= protocol.LEAST_EXPOSURE_US.keys()
            and all((e.pattern_number + 1) * e.bit_depth <= 24 for e in entries)
            and len(images) == self.registers.sequence[3] + 1
            and all(image < len(self._flash) for image in images)
        )
        if not numbers_fit:
            return Validation.PATTERN_NUMBER
        exposure_us, period_us = protocol.timing_in(self.registers.timing)
        return protocol.timing_problem(exposure_us, period_us, depths)

    def _act(self, action: Action) -> None:
        if action is not Action.START:
            self._stop_playing()
            return
        ready = (
            self._is_valid
            and self.registers.power == b"\0"
            and self.registers.mode == bytes((DisplayMode.PATTERN,))
            and self.registers.source == bytes((PatternSource.FLASH,))
        )
        if not ready:
            raise ValueError("not before a sequence is validated in pattern mode")
        self._stop_playing()
        if self.faults.ignored_starts:
            self.faults.ignored_starts -= 1
            return
        self._halt.clear()
        self._action = Action.START
        steps, start_s = self._steps(), self._lamp.now_s() + self._preloading_ms() / 1000.0
        self._player = threading.Thread(
            target=self._play, args=(steps, start_s), name="dlpc350-sequence", daemon=True
        )
        self._player.start()

    def _stop_playing(self) -> None:
        self._halt.set()
        if self._player is not None:
            self._player.join()
        self._player = None
        self._action = Action.STOP
        self._lamp.light(self._black)

    def _play(self, steps: Sequence[_Step], start_s: float) -> None:
        """Run through a sequence, once or again and again."""
        exposure_us, period_us = protocol.timing_in(self.registers.timing)
        repeats = bool(self.registers.sequence[1])
        delay_s = protocol.trigger_delay_us(self.registers.trigger_out_1[1]) * 1e-6
        swapped_s, count, lit = start_s, 0, self._black
        while repeats or count < len(steps):
            step = steps[count % len(steps)]
            at_s = start_s + count * period_us * 1e-6
            if self._halted_before(at_s):
                break
            picture = self._picture(step, at_s - swapped_s)
            if picture is not lit:  # one that is shown again and again is lit once
                self._lamp.light(picture)
            lit = picture
            self._fire(at_s + delay_s, exposure_us)
            swapped_s = at_s if step.swaps else swapped_s
            count += 1
        self._halted_before(start_s + count * period_us * 1e-6)
        self._lamp.light(self._black)
        self._action = Action.STOP

    def _picture(self, step: _Step, since_swap_s: float) -> UInt8[np.ndarray, "h w"]:
        if step.stale is None or since_swap_s * 1000.0 >= step.loading_ms:
            return step.picture
        self.late_images += 1
        return step.stale

    def _steps(self) -> list[_Step]:
        """Take the patterns out of their images. Two images are in memory before the sequence starts."""
        images, used, held = self._image_numbers(), 0, 0
        steps: list[_Step] = []
        for entry in self._table():
            before, swaps = held, entry.swap or not steps
            if swaps:
                held = images[used % len(images)]
                used += 1
            picture = self._cut_out(held, entry)
            if swaps and used > protocol.PRELOADED_IMAGES:
                loading_ms, stale = load_ms(self._flash[held]), self._cut_out(before, entry)
                steps.append(_Step(picture, swaps, loading_ms, stale))
            else:
                steps.append(_Step(picture, swaps))
        return steps

    def _preloading_ms(self) -> float:
        first = self._image_numbers()[: protocol.PRELOADED_IMAGES]
        return sum(load_ms(self._flash[image]) for image in first)

    def _cut_out(self, image: int, entry: LutEntry) -> UInt8[np.ndarray, "h w"]:
        if not entry.leds:
            return self._black
        picture = unpacked(self._flash[image], entry.pattern_number, entry.bit_depth)
        return 255 - picture if entry.invert else picture

    def _halted_before(self, time_s: float) -> bool:
        return self._halt.wait(max(0.0, time_s - self._lamp.now_s()))

    def _fire(self, time_s: float, shown_us: int) -> None:
        try:
            self._lamp.edge(time_s, float(shown_us))
        except (
            DeviceError
        ) as error:  # a camera exposes for too long: on a real bench nobody says so either
            log.warning("An edge of the trigger line had no effect: %s", error)


_INVALID = Validation.TIMING | Validation.PATTERN_NUMBER | Validation.DARK_TIME


def load_ms(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return how long an image takes from flash: 200 ms at worst, less where it can be compressed.

    Notes
    -----
    A model, not a measurement: a line like the one above costs nothing, another one two bytes for every run of
    equal pixels, at most what it has uncompressed.
    """
    new_line = np.ones(len(image), bool)
    new_line[1:] = (image[1:] != image[:-1]).any(axis=(1, 2))
    lines = image[new_line]
    runs = 1 + (lines[:, 1:] != lines[:, :-1]).any(axis=2).sum(axis=1)
    cost = np.minimum(1.0, 2.0 * runs / image.shape[1]).sum() / len(image)
    return float(protocol.SLOWEST_LOAD_MS * cost)


def _messages(connection: socket.socket, ending: threading.Event) -> Iterator[list[bytes]]:
    """Yield messages, joined of their reports, until the client hangs up."""
    connection.settimeout(_POLL_S)
    reports: list[bytes] = []
    while not ending.is_set():
        try:
            report = connection.recv(protocol.REPORT_BYTES)
        except TimeoutError:
            continue
        if not report:
            return
        reports.append(report.ljust(protocol.REPORT_BYTES, b"\0"))
        if len(reports) >= protocol.reports_of(reports[0]):
            yield reports
            reports = []
