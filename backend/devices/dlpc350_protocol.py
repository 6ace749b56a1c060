"""What a DLPC350 (DLP LightCrafter 4500) and its host say to each other over USB HID, in reports of 64 bytes.

Request: flags, sequence number, length of what follows (low byte first), CMD3, CMD2, payload. Answer: flags, sequence
number, length, data. What doesn't fit goes on in further reports that carry nothing else. Command numbers and bit
meanings: DLPC350 programmer's guide (TI DLPU010) and TI's API in public drivers; none of it was tried on a device.
"""

import enum
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

REPORT_BYTES = 64
HEADER_BYTES = 4

VENDOR_ID, PRODUCT_ID = 0x0451, 0x6401

SIZE_PX = (912, 1140)
"""The chip's mirrors: columns and rows, rotated by 45 degrees, every second row half a column further."""

COLUMN_PITCH_BY_ROW_PITCH = 2.0
"""Columns are so many times as far apart as rows."""
SHOW_PERIOD_US = 8333
"""Of a single pattern that is shown until the next, unless a rig file says another one."""

MOST_PATTERNS = 128
"""Entries of the table of patterns."""
MOST_IMAGES = 64
"""Entries of the table of images that the patterns are taken from."""
PRELOADED_IMAGES = 2
"""Images that the controller's memory holds: a sequence over more of them loads the others while it runs."""
SLOWEST_LOAD_MS = 200.0
"""Longest time that an image takes from flash to memory."""
DARK_US = 230
"""A period that is longer than its exposure is so by at least this."""
LEAST_EXPOSURE_US = {1: 235, 2: 700, 3: 1570, 4: 1700, 5: 2000, 6: 2500, 7: 4500, 8: 8333}
"""Shortest exposure of a pattern by its bit depth."""
LOAD_TICKS_PER_MS = 18_667

_READ, _REPLY, _NACK = 0x80, 0x40, 0x20
_DELAY_ZERO, _DELAY_STEP_US = 0xBB, 0.1072
_DELAY_STEPS = (0x00, 0xD5)


class Command(enum.IntEnum):
    """CMD2 and CMD3 in one number."""

    POWER = 0x0200
    VERSION = 0x0205
    LED_CURRENTS = 0x0B01
    LED_ENABLE = 0x1A07
    MAIN_STATUS = 0x1A0C
    VALIDATE = 0x1A1A
    DISPLAY_MODE = 0x1A1B
    TRIGGER_OUT_1 = 0x1A1D
    TRIGGER_OUT_2 = 0x1A1E
    PATTERN_SOURCE = 0x1A22
    TRIGGER_MODE = 0x1A23
    START_STOP = 0x1A24
    TIMING = 0x1A29
    SEQUENCE = 0x1A31
    MAILBOX_OFFSET = 0x1A32
    MAILBOX = 0x1A33
    MAILBOX_DATA = 0x1A34
    IMAGE_LOAD_TIME = 0x1A3A
    IMAGES_IN_FLASH = 0x1A42


class DisplayMode(enum.IntEnum):
    """What the chip shows."""

    VIDEO = 0
    PATTERN = 1


class PatternSource(enum.IntEnum):
    """Where patterns come from."""

    VIDEO_PORT = 0
    FLASH = 3


class TriggerMode(enum.IntEnum):
    """What takes a sequence from one pattern to the next."""

    VIDEO_FRAME = 0
    INTERNAL = 1


class Action(enum.IntEnum):
    """What a sequence is told to do, and what it says that it does."""

    STOP = 0
    PAUSE = 1
    START = 2


class Mailbox(enum.IntEnum):
    """Which table is written."""

    CLOSED = 0
    IMAGES = 1
    PATTERNS = 2


class Validation(enum.IntFlag):
    """What the device found when it checked a sequence; 0: it can run."""

    TIMING = 0x01
    PATTERN_NUMBER = 0x02
    TRIGGER_OUT = 0x04
    POST_VECTOR = 0x08
    DARK_TIME = 0x10
    BUSY = 0x80


class MainStatus(enum.IntFlag):
    """The state of chip and sequencer."""

    PARKED = 0x01
    RUNNING = 0x02
    FROZEN = 0x04
    GAMMA = 0x08


class Leds(enum.IntFlag):
    """Light sources of a pattern."""

    RED = 1
    GREEN = 2
    BLUE = 4
    WHITE = 7


LEDS_BY_SEQUENCER = 0x08
"""LEDs are on only while a pattern that uses them is shown."""


@dataclass(frozen=True)
class Request:
    """One command as it is sent."""

    command: int
    payload: bytes
    sequence: int
    reads: bool
    wants_reply: bool = True

    def reports(self) -> Iterator[bytes]:
        """Cut it into reports of 64 bytes."""
        flags = (_READ if self.reads else 0) | (_REPLY if self.wants_reply else 0)
        body = bytes((self.command & 0xFF, self.command >> 8)) + self.payload
        yield from _cut(struct.pack("<BBH", flags, self.sequence, len(body)) + body)


@dataclass(frozen=True)
class Reply:
    """What the device answers."""

    sequence: int
    data: bytes = b""
    refused: bool = False
    reads: bool = False

    def reports(self) -> Iterator[bytes]:
        """Cut it into reports of 64 bytes."""
        flags = (_READ if self.reads else 0) | _REPLY | (_NACK if self.refused else 0)
        yield from _cut(struct.pack("<BBH", flags, self.sequence, len(self.data)) + self.data)


def _cut(message: bytes) -> Iterator[bytes]:
    for start in range(0, len(message), REPORT_BYTES):
        yield message[start : start + REPORT_BYTES].ljust(REPORT_BYTES, b"\0")


def message_bytes(first_report: bytes) -> int:
    """Return how long the message is that begins with this report, header included."""
    (length,) = struct.unpack_from("<H", first_report, 2)
    return HEADER_BYTES + int(length)


def reports_of(first_report: bytes) -> int:
    """Return how many reports a message has, by its first one."""
    return -(-message_bytes(first_report) // REPORT_BYTES)


def parse_request(reports: Sequence[bytes]) -> Request | None:
    """Join a request's reports; None where they make no command."""
    message = b"".join(reports)
    if len(message) < HEADER_BYTES + 2:
        return None
    flags, sequence, length = struct.unpack_from("<BBH", message)
    body = message[HEADER_BYTES : HEADER_BYTES + length]
    if length < 2 or len(body) < length:
        return None
    command = body[0] | body[1] << 8
    return Request(command, body[2:], sequence, bool(flags & _READ), bool(flags & _REPLY))


def parse_reply(reports: Sequence[bytes]) -> Reply | None:
    """Join an answer's reports; None where they make none."""
    message = b"".join(reports)
    if len(message) < HEADER_BYTES:
        return None
    flags, sequence, length = struct.unpack_from("<BBH", message)
    data = message[HEADER_BYTES : HEADER_BYTES + length]
    if len(data) < length:
        return None
    return Reply(sequence, data, bool(flags & _NACK), bool(flags & _READ))


@dataclass(frozen=True)
class LutEntry:
    """One pattern of a sequence: which bits of the image in memory, lit by which LEDs."""

    pattern_number: int
    bit_depth: int
    leds: int
    swap: bool
    """Take the next image of the table first."""
    trigger: int = 0
    """0: the sequence's own clock starts it."""
    invert: bool = False

    def packed(self) -> bytes:
        """Write it as the mailbox takes it."""
        flags = int(self.invert) | int(self.swap) << 2
        return bytes(
            (self.trigger | self.pattern_number << 2, self.bit_depth | self.leds << 4, flags)
        )

    @classmethod
    def parse(cls, packed: bytes) -> "LutEntry":
        """Read what was written to the mailbox."""
        first, second, flags = packed
        return cls(
            pattern_number=first >> 2,
            bit_depth=second & 0x0F,
            leds=second >> 4 & 0x07,
            swap=bool(flags & 0x04),
            trigger=first & 0x03,
            invert=bool(flags & 0x01),
        )


def image_lut(images: Sequence[int]) -> bytes:
    """Write the table of images.

    A table of exactly two is taken in reverse order: so the firmware wants it, as TI's own API knows.
    """
    return bytes(reversed(images)) if len(images) == 2 else bytes(images)


def images_in(lut: bytes) -> tuple[int, ...]:
    """Read a table of images as the firmware does."""
    return tuple(reversed(lut)) if len(lut) == 2 else tuple(lut)


def patterns_per_image(bit_depth: int) -> int:
    """Return how many patterns of a depth (1 or 8) one 24-bit image holds."""
    return 24 // bit_depth


def timing_payload(exposure_us: int, period_us: int) -> bytes:
    """Write exposure and period of every pattern."""
    return struct.pack("<II", exposure_us, period_us)


def timing_in(payload: bytes) -> tuple[int, int]:
    """Read exposure and period in [us]."""
    exposure_us, period_us = struct.unpack("<II", payload)
    return exposure_us, period_us


def sequence_payload(patterns: int, images: int, *, repeat: bool) -> bytes:
    """Write how long the tables are; TRIG_OUT_2 comes once for the whole sequence."""
    return bytes((patterns - 1, int(repeat), patterns - 1, images - 1))


def trigger_delay_code(delay_us: float) -> int:
    """Write the delay of a trigger output's edge against the pattern's, in steps of 107.2 ns.

    Examples
    --------
    >>> trigger_delay_code(0.0), trigger_delay_code(-20.05)
    (187, 0)
    """
    least, most = _DELAY_STEPS
    return min(max(_DELAY_ZERO + round(delay_us / _DELAY_STEP_US), least), most)


def trigger_delay_us(code: int) -> float:
    """Read the delay of a trigger output's edge."""
    return (code - _DELAY_ZERO) * _DELAY_STEP_US


DELAY_RANGE_US = (trigger_delay_us(_DELAY_STEPS[0]), trigger_delay_us(_DELAY_STEPS[1]))
"""Earliest and latest edge of a trigger output against the pattern's."""


def timing_problem(exposure_us: int, period_us: int, bit_depths: Iterable[int]) -> Validation:
    """Tell what the device will find wrong with exposure and period; 0: nothing."""
    problem = Validation(0)
    if exposure_us < max(LEAST_EXPOSURE_US[depth] for depth in bit_depths):
        problem |= Validation.TIMING
    if exposure_us != period_us and period_us - exposure_us < DARK_US:
        problem |= Validation.DARK_TIME
    return problem
