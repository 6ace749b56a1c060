"""The DLPC350's language: every message both ways, and the numbers that the guide gives."""

import numpy as np
import pytest

from backend.devices import dlpc350_protocol as protocol
from backend.devices.dlpc350_protocol import (
    Command,
    Leds,
    LutEntry,
    Reply,
    Request,
    Validation,
    parse_reply,
    parse_request,
)
from backend.devices.pattern_set import bit_depth_for, packed, pattern_hash, unpacked


@pytest.mark.parametrize("length", [0, 1, 57, 58, 59, 122, 123, 384])
@pytest.mark.parametrize("reads", [False, True])
def test_requests_survive_the_way_whatever_their_length(length, reads):
    payload = bytes(i % 251 for i in range(length))
    asked = Request(Command.MAILBOX_DATA, payload, 17, reads)
    reports = list(asked.reports())
    assert {len(report) for report in reports} == {64}
    assert len(reports) == protocol.reports_of(reports[0])
    assert parse_request(reports) == asked


@pytest.mark.parametrize("length", [0, 1, 60, 61, 188, 189, 384])
@pytest.mark.parametrize("refused", [False, True])
def test_answers_survive_the_way_whatever_their_length(length, refused):
    said = Reply(200, bytes(i % 251 for i in range(length)), refused, reads=True)
    reports = list(said.reports())
    assert {len(report) for report in reports} == {64}
    assert len(reports) == protocol.reports_of(reports[0])
    assert parse_reply(reports) == said


@pytest.mark.parametrize(
    ("request_", "beginning"),
    [
        # flags, sequence, length, CMD3, CMD2, payload
        (Request(Command.DISPLAY_MODE, b"\1", 3, reads=False), "40 03 03 00 1b 1a 01"),
        (Request(Command.START_STOP, b"\2", 4, reads=False), "40 04 03 00 24 1a 02"),
        (Request(Command.MAIN_STATUS, b"", 5, reads=True), "c0 05 02 00 0c 1a 00"),
        (
            Request(Command.TIMING, protocol.timing_payload(16_437, 16_667), 6, reads=False),
            "40 06 0a 00 29 1a 35 40 00 00 1b 41 00 00",
        ),
        (
            Request(
                Command.SEQUENCE, protocol.sequence_payload(24, 8, repeat=False), 7, reads=False
            ),
            "40 07 06 00 31 1a 17 00 17 07",
        ),
    ],
    ids=lambda value: Command(value.command).name if isinstance(value, Request) else "",
)
def test_messages_are_the_guides(request_, beginning):
    (report,) = request_.reports()
    wanted = bytes.fromhex(beginning)
    assert report.startswith(wanted)
    assert not any(report[len(wanted) :])


@pytest.mark.parametrize("reports", [[], [b""], [b"\x40\1"], [b"\x40\1\xff\xff".ljust(64, b"\0")]])
def test_what_is_no_message_is_none(reports):
    assert parse_request(reports) is None
    assert parse_reply(reports) is None


@pytest.mark.parametrize("number", [0, 2, 23])
@pytest.mark.parametrize("depth", [1, 8])
@pytest.mark.parametrize("leds", [Leds.WHITE, Leds.RED, Leds.BLUE])
@pytest.mark.parametrize("swap", [False, True])
def test_entries_of_the_pattern_table_survive(number, depth, leds, swap):
    entry = LutEntry(number, depth, leds, swap)
    assert len(entry.packed()) == 3
    assert LutEntry.parse(entry.packed()) == entry


def test_an_entry_is_packed_as_the_guide_says():
    """Pattern 2 of 8 bit (blue bits), white light, with a swap of images."""
    assert LutEntry(2, 8, Leds.WHITE, swap=True).packed() == bytes((2 << 2, 0x78, 0x04))


@pytest.mark.parametrize("images", [(4,), (4, 7), (7, 4), (0, 1, 2), tuple(range(64))])
def test_the_table_of_images_survives_though_two_are_reversed(images):
    lut = protocol.image_lut(images)
    assert protocol.images_in(lut) == images
    assert (tuple(lut) == images) == (len(images) != 2)


@pytest.mark.parametrize(
    ("exposure_us", "period_us", "depth", "problem"),
    [
        (8333, 8333, 8, Validation(0)),
        (8332, 16_667, 8, Validation.TIMING),
        (5000, 5000, 8, Validation.TIMING),
        (5000, 5000, 7, Validation(0)),
        (235, 235, 1, Validation(0)),
        (234, 234, 1, Validation.TIMING),
        (16_437, 16_667, 8, Validation(0)),
        (16_438, 16_667, 8, Validation.DARK_TIME),
        (16_600, 16_700, 8, Validation.DARK_TIME),
        (16_700, 16_600, 8, Validation.DARK_TIME),
        (5000, 5100, 8, Validation.TIMING | Validation.DARK_TIME),
    ],
)
def test_which_timings_are_possible(exposure_us, period_us, depth, problem):
    assert protocol.timing_problem(exposure_us, period_us, (depth,)) == problem


def test_trigger_delays_are_steps_of_107_nanoseconds():
    low, high = protocol.DELAY_RANGE_US
    for delay_us in np.linspace(low, high, 50):
        code = protocol.trigger_delay_code(delay_us)
        assert 0 <= code <= 0xD5
        assert abs(protocol.trigger_delay_us(code) - delay_us) <= 0.0536 + 1e-9
    assert protocol.trigger_delay_code(0.0) == 0xBB


@pytest.mark.parametrize(("depth", "count"), [(8, 3), (8, 2), (1, 24), (1, 5)])
def test_pictures_come_out_of_an_image_as_they_went_in(depth, count):
    random = np.random.default_rng(5)
    levels = [0, 255] if depth == 1 else np.arange(256)
    pictures = [random.choice(levels, (12, 10)).astype(np.uint8) for _ in range(count)]
    image = packed(pictures, depth)
    for position, picture in enumerate(pictures):
        np.testing.assert_array_equal(unpacked(image, position, depth), picture)
    for position in range(count, protocol.patterns_per_image(depth)):
        assert not unpacked(image, position, depth).any()


def test_the_first_eight_bits_of_an_image_are_green():
    first, second, third = (np.full((2, 2), level, np.uint8) for level in (10, 20, 30))
    assert packed([first, second, third], 8)[0, 0].tolist() == [20, 10, 30]


def test_black_and_white_sets_are_packed_bit_by_bit():
    white, gray = np.full((4, 4), 255, np.uint8), np.full((4, 4), 128, np.uint8)
    assert bit_depth_for([white, white * 0]) == 1
    assert bit_depth_for([white, gray]) == 8


def test_a_pictures_hash_knows_its_shape():
    picture = np.arange(12, dtype=np.uint8)
    hashes = {pattern_hash(picture.reshape(shape)) for shape in ((3, 4), (4, 3), (2, 6))}
    assert len(hashes) == 3
    assert pattern_hash(picture.reshape(3, 4)) == pattern_hash(picture.reshape(3, 4).copy("F"))
