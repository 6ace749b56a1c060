"""LightCrafter 4500 for real, as far as that goes without one: the driver against a simulated DLPC350, and a whole rig
of it and GigE Vision cameras on its trigger line."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backend.devices import dlpc350_protocol as protocol
from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.conformance import RigConformance
from backend.devices.dlpc350_protocol import Action, Command, Request, Validation
from backend.devices.driver_loading import make_projector
from backend.devices.drivers.aravis_camera import AravisCamera, AravisOptions
from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.drivers.dlpc350 import Dlpc350Options, Dlpc350Projector
from backend.devices.drivers.dlpc350_link import SocketHid
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    GeometryError,
    IncompleteFrame,
    RigConfigError,
)
from backend.devices.pages import PageDesk
from backend.devices.pattern_set import NewPattern, PatternSet, write_set
from backend.devices.peers.dlpc350 import SimulatedDlpc350, load_ms
from backend.devices.protocols import Frame, LinkState, Rig, SequenceProjector, TriggerSource
from backend.devices.rig_shelf import RigShelf
from backend.domain.patterns import Gray, Sine, Uniform
from backend.jobs.rendering import render
from tests.lightcrafter_hardware import lightcrafter_hardware

WIDTH, HEIGHT = protocol.SIZE_PX
LEVELS = (0, 32, 50, 64, 100, 128, 150, 200, 255)
STEPS = 24


def even(level: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), level, np.uint8)


def fringe(step: int) -> np.ndarray:
    pattern = Sine(periods=16, shift_rad=2 * np.pi * step / STEPS)
    return render(pattern, width_px=WIDTH, height_px=HEIGHT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of 24 fringes and some even fields: 33 patterns of 8 bit in 11 images."""
    path = tmp_path_factory.mktemp("patterns")
    fields = [
        NewPattern(even(level), f"even {level}", Uniform(gray=level).model_dump(mode="json"))
        for level in LEVELS
    ]
    write_set(
        path, [*(NewPattern(fringe(k), f"fringe {k}") for k in range(STEPS)), *fields], pack=True
    )
    return path


@pytest.fixture(scope="module")
def flash(folder) -> tuple[np.ndarray, ...]:
    return PatternSet.read(folder).image_pictures(folder)


class Bench:
    """A lamp that remembers what it showed when the trigger line fired."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.picture = even(0)
        self.lit: list[np.ndarray] = []
        self.edges: list[tuple[float, float]] = []

    def now_s(self) -> float:
        return time.monotonic()

    def light(self, picture: np.ndarray) -> None:
        with self.changed:
            self.picture = picture
            self.changed.notify_all()

    def edge(self, time_s: float, shown_us: float) -> None:
        self.lit.append(self.picture)
        self.edges.append((time_s, shown_us))


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def device(bench, flash) -> Iterator[SimulatedDlpc350]:
    with SimulatedDlpc350(bench, flash) as simulated:
        yield simulated


def projector_of(device: SimulatedDlpc350, folder: Path, **options: object) -> Dlpc350Projector:
    def connect(name: str) -> SocketHid:
        try:
            return SocketHid(device.pair())
        except ConnectionRefusedError as error:
            raise DeviceBusy(name, str(error)) from error

    return Dlpc350Projector("projector", Dlpc350Options(patterns=folder, **options), connect)


@pytest.fixture
def projector(device, folder) -> Iterator[Dlpc350Projector]:
    with projector_of(device, folder) as opened:
        yield opened


def shows(bench: Bench, wanted: np.ndarray) -> bool:
    """Wait for a picture to come to light."""
    with bench.changed:
        return bench.changed.wait_for(lambda: np.array_equal(bench.picture, wanted), timeout=60)


def ran(device: SimulatedDlpc350) -> None:
    """Wait until a sequence is over."""
    player = device._player
    if player is not None:
        player.join(timeout=60)


# ---------------------------------------------------------------- sequences


def test_a_sequence_shows_every_pattern_at_its_edge(projector, device, bench):
    projector.load([fringe(k) for k in range(STEPS)])
    order = [5, 4, 3, 20, 0, 1]
    projector.arm_sequence(order, 9000.0, 10_000.0)
    assert not bench.edges
    projector.start_sequence()
    ran(device)
    assert len(bench.lit) == len(order)
    for picture, step in zip(bench.lit, order, strict=True):
        np.testing.assert_array_equal(picture, fringe(step))
    assert not bench.picture.any(), "dark after the last pattern"
    assert {shown_us for _, shown_us in bench.edges} == {9000.0}


def test_edges_stand_on_the_nominal_time_line(projector, device, bench):
    """Whatever the threads do: edge k stands at start + k periods."""
    projector.load([even(level) for level in LEVELS])
    projector.arm_sequence([0, 1, 2, 3] * 15, 8333.0, 8333.0)
    projector.start_sequence()
    ran(device)
    times_s = np.array([at for at, _ in bench.edges])
    np.testing.assert_allclose(times_s - times_s[0], np.arange(60) * 0.008333, atol=1e-9)
    assert device.late_images == 0


def test_a_sequence_can_be_stopped(projector, device, bench):
    projector.load([even(255)])
    projector.arm_sequence([0] * 100, 20_000.0, 20_000.0)
    projector.start_sequence()
    projector.stop_sequence()
    count = len(bench.edges)
    assert count < 100
    assert not bench.picture.any()
    assert device._action is Action.STOP


def test_a_sequence_is_started_once_only(projector):
    projector.load([even(255)])
    with pytest.raises(FeatureError, match="arm_sequence first"):
        projector.start_sequence()
    projector.arm_sequence([0], 8333.0, 8333.0)
    projector.start_sequence()
    with pytest.raises(FeatureError, match="arm_sequence first"):
        projector.start_sequence()


def test_a_pattern_that_was_shown_meanwhile_is_not_started_as_the_sequence(projector, bench):
    projector.load([even(255), even(100)])
    projector.arm_sequence([0], 8333.0, 8333.0)
    projector.show(1)
    with pytest.raises(FeatureError, match="arm_sequence first"):
        projector.start_sequence()


@pytest.mark.parametrize(
    ("exposure_us", "period_us", "sentence"),
    [
        (5000, 5000, "5000 us is too short for patterns of 8 bit; give 8333 us or more"),
        (16_600, 16_700, "16600 us doesn't fit a period of 16700 us"),
        (20_000, 16_700, "20000 us doesn't fit a period of 16700 us"),
    ],
)
def test_impossible_timings_are_refused(projector, exposure_us, period_us, sentence):
    projector.load([even(255)])
    with pytest.raises(FeatureError, match=sentence):
        projector.arm_sequence([0], exposure_us, period_us)


@pytest.mark.parametrize(
    ("exposure_us", "period_us"), [(8333, 8333), (16_437, 16_667), (16_667, 16_667)]
)
def test_possible_timings_are_taken(projector, exposure_us, period_us):
    projector.load([even(255)])
    projector.arm_sequence([0], exposure_us, period_us)


def test_more_patterns_than_the_table_has_are_refused(projector):
    projector.load([even(255)])
    projector.arm_sequence([0] * 128, 8333, 8333)
    with pytest.raises(FeatureError, match="129 patterns are not within 1 to 128"):
        projector.arm_sequence([0] * 129, 8333, 8333)


def test_images_that_load_too_slowly_are_refused_with_the_period_that_works(tmp_path):
    """Noise can't be compressed: 200 ms for each image, three patterns are over after 50 ms."""
    random = np.random.default_rng(1)
    pictures = [random.integers(0, 256, (HEIGHT, WIDTH), np.uint8) for _ in range(9)]
    write_set(tmp_path, [NewPattern(p, "noise") for p in pictures], pack=True)
    flash = PatternSet.read(tmp_path).image_pictures(tmp_path)
    assert [load_ms(image) for image in flash] == pytest.approx([200.0] * 3)
    with SimulatedDlpc350(Bench(), flash) as device, projector_of(device, tmp_path) as projector:
        projector.load(pictures)
        projector.arm_sequence(range(6), 16_667, 16_667)  # two images are in memory beforehand
        with pytest.raises(FeatureError, match=r"image 2 takes 200 ms .* for 66\.7 ms or longer"):
            projector.arm_sequence(range(9), 16_667, 16_667)
        projector.arm_sequence(range(9), 66_667, 66_667)


def test_fringes_along_the_columns_load_at_once(flash):
    assert max(load_ms(image) for image in flash) < 1.0


def test_black_and_white_sets_run_bit_by_bit_and_fast(tmp_path):
    """24 patterns from one image, at a period that 8 bits couldn't have."""
    codes = [
        Gray(bit=bit, bits=10, codes=912, inverse=i) for bit in range(10) for i in (False, True)
    ]
    pictures = [render(code, width_px=WIDTH, height_px=HEIGHT) for code in codes]
    write_set(tmp_path, [NewPattern(p, "code") for p in (*pictures, even(255), even(0))], pack=True)
    flash = PatternSet.read(tmp_path).image_pictures(tmp_path)
    assert len(flash) == 1
    bench = Bench()
    with SimulatedDlpc350(bench, flash) as device, projector_of(device, tmp_path) as projector:
        assert projector.capabilities.bit_depths == (1,)
        projector.load(pictures)
        projector.arm_sequence(range(20), 2000, 2500)
        projector.start_sequence()
        ran(device)
    assert len(bench.lit) == 20
    for picture, wanted in zip(bench.lit, pictures, strict=True):
        np.testing.assert_array_equal(picture, wanted)


# ---------------------------------------------------------------- single patterns


def test_a_pattern_is_shown_until_the_next(projector, bench):
    projector.load([even(100), fringe(3)])
    for index, wanted in ((1, fringe(3)), (0, even(100)), (1, fringe(3))):
        presented = projector.show(index)
        assert presented.index == index
        assert not presented.confirmed, "nobody has measured when it is lit"
        assert shows(bench, wanted)


def test_a_measured_settle_time_confirms_the_light(device, folder):
    with projector_of(device, folder, settle_ms=20.0) as projector:
        projector.load([even(100)])
        assert projector.show(0).confirmed


@pytest.mark.parametrize("settle_ms", [None, 20.0])
def test_an_image_that_loads_slowly_is_waited_for_whatever_was_measured_with_even_fields(
    tmp_path, bench, monkeypatch, settle_ms
):
    noise = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    write_set(tmp_path, [NewPattern(noise, "noise")], pack=True)
    (image,) = PatternSet.read(tmp_path).image_pictures(tmp_path)
    waits_s: list[float] = []
    with (
        SimulatedDlpc350(bench, [image]) as device,
        projector_of(device, tmp_path, settle_ms=settle_ms) as projector,
    ):
        projector.load([noise])
        monkeypatch.setattr(projector._stop, "wait", waits_s.append)
        projector.show(0)
    more_ms = 8.333 if settle_ms is None else settle_ms
    assert 1e3 * waits_s[-1] == pytest.approx(load_ms(image) + more_ms, abs=0.01)


def test_even_fields_come_from_the_set(projector, bench):
    for level in (255, 0, 128, 0):
        assert projector.blank(level).index == -1
        assert shows(bench, even(level))
    with pytest.raises(
        FeatureError,
        match=r"level 77 isn't in the set .* use one of 0, 32, 50, 64, 100, 128, 150, 200, 255",
    ):
        projector.blank(77)


def test_patterns_that_are_not_in_flash_are_refused_with_the_way_out(projector):
    with pytest.raises(
        FeatureError, match=r"pattern 1 isn't in the set .*\(unglare patterns export"
    ):
        projector.load([even(255), even(77)])
    with pytest.raises(GeometryError, match="912x1140"):
        projector.load([np.zeros((800, 1280), np.uint8)])


# ---------------------------------------------------------------- life


def test_it_says_who_it_is_and_what_it_can(projector):
    assert isinstance(projector, SequenceProjector)
    assert "experimental" in projector.info.model
    assert projector.info.firmware == "4.1.0"
    can = projector.capabilities
    assert can.size == (912, 1140)
    assert can.pixel_layout == "diamond"
    assert can.linear
    assert can.sequence
    assert can.max_sequence == 128
    assert can.trigger_out
    assert can.refresh_hz == pytest.approx(120.0, abs=0.01)


def test_options_reach_the_registers(device, folder):
    options = {
        "trigger_edge": "falling",
        "trigger_delay_us": -20.0,
        "led_currents": (255, 100, 0),
        "standby": True,
    }
    with projector_of(device, folder, **options):
        registers = device.registers
        assert registers.power == b"\0"
        assert registers.mode == b"\1"
        assert registers.source == b"\3"
        assert registers.led_enable == b"\x08"
        assert registers.led_currents == bytes((0, 155, 255)), "the LED driver is inverted"
        assert registers.trigger_out_1 == bytes((1, 0, 0xBB))
        assert registers.trigger_out_2 == bytes((1, 0))
    assert device.registers.power == b"\1", "standby"


def test_led_currents_are_left_alone_unless_asked_for(device, projector):
    assert device.registers.led_currents == b"\xff\xff\xff"


def test_closing_leaves_the_light_off(device, folder, bench):
    with projector_of(device, folder) as projector:
        projector.blank(255)
        assert bench.picture.any()
    assert not bench.picture.any()
    assert projector.state is LinkState.CLOSED
    with pytest.raises(DeviceDisconnected, match="open it first"):
        projector.blank()


def test_a_second_program_is_refused(device, folder, projector):
    with pytest.raises(DeviceBusy, match="has a client already"):
        projector_of(device, folder).open()
    projector.blank(255)


def test_a_device_that_goes_away_and_comes_back(device, projector, bench):
    projector.load([even(100)])
    device.unplug()
    with pytest.raises(DeviceDisconnected, match="gone from USB"):
        projector.show(0)
    assert projector.state is LinkState.LOST
    with pytest.raises(DeviceDisconnected, match="reconnect"):
        projector.show(0)
    projector.reconnect()
    projector.show(0)
    assert shows(bench, even(100))


def test_a_device_that_goes_away_during_a_sequence(device, projector, bench):
    """The sequence runs on, by itself; the next command tells."""
    projector.load([even(100)])
    projector.arm_sequence([0] * 12, 8333, 8333)
    projector.start_sequence()
    device.unplug()
    with pytest.raises(DeviceDisconnected):
        projector.arm_sequence([0], 8333, 8333)
    ran(device)
    assert len(bench.edges) == 12
    projector.reconnect()
    assert projector.state is LinkState.READY


def test_what_another_program_left_running_is_stopped(device, projector, folder, bench):
    projector.blank(255)
    device.unplug()  # as if that program had been killed: the device goes on
    with projector_of(device, folder) as another:
        assert not bench.picture.any()
        another.blank(200)
        assert shows(bench, even(200))


def test_a_device_that_stays_away_is_one_sentence(folder, bench, flash):
    with SimulatedDlpc350(bench, flash) as device:
        projector = projector_of(device, folder, transport="unix:/nowhere")
        projector.open()
    projector._connect = lambda name: SocketHid.at(name, "/nowhere")
    with pytest.raises(DeviceDisconnected, match=r"didn't come back within 0\.1 s"):
        projector.reconnect(timeout_s=0.1)


# ---------------------------------------------------------------- refusals of the device


@pytest.mark.parametrize(
    "command", [Command.TIMING, Command.MAILBOX_DATA, Command.VALIDATE, Command.START_STOP]
)
def test_every_refused_command_is_named(device, projector, command):
    projector.load([even(100)])
    device.faults.refused = {command}
    with pytest.raises(FeatureError, match=f"projector refused command {command:04X}"):
        projector.show(0)
    device.faults.refused = ()
    projector.show(0)


def test_an_answer_that_does_not_come_is_a_timeout_and_late_ones_are_passed_over(
    device, projector, monkeypatch
):
    monkeypatch.setattr("backend.devices.drivers.dlpc350_link._ANSWER_S", 0.1)
    projector.load([even(100)])
    device.faults.unanswered = {Command.TIMING}
    with pytest.raises(DeviceTimeout, match="didn't answer command 1A29"):
        projector.show(0)
    device.faults.unanswered = ()
    late = protocol.Reply(3, b"", refused=True)  # of a request long past
    for report in late.reports():
        device._client.sendall(report)
    projector.show(0)


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (Validation.TIMING, "the exposure or the period is invalid"),
        (Validation.PATTERN_NUMBER, "a pattern number is invalid"),
        (Validation.TIMING | Validation.DARK_TIME, "invalid, period and exposure differ"),
    ],
)
def test_what_the_device_finds_wrong_is_said(device, projector, found, sentence):
    projector.load([even(100)])
    device.faults.found = found
    with pytest.raises(FeatureError, match=f"refuses the sequence: .*{sentence}"):
        projector.arm_sequence([0], 8333, 8333)


def test_validation_is_waited_for_and_its_warnings_pass(device, projector):
    projector.load([even(100)])
    device.faults.busy_polls, device.faults.found = 3, Validation.TRIGGER_OUT
    projector.arm_sequence([0], 8333, 8333)


def test_a_pattern_whose_start_was_ignored_is_started_again(device, projector, bench):
    projector.load([even(100)])
    device.faults.ignored_starts = 1
    projector.show(0)
    assert shows(bench, even(100))


def test_a_sequence_whose_start_was_ignored_is_told_and_not_started_again(device, projector, bench):
    projector.load([even(100)])
    projector.arm_sequence([0] * 100, 8333, 8333)
    device.faults.ignored_starts = 1
    with pytest.raises(DeviceTimeout, match="didn't start the sequence"):
        projector.start_sequence()
    assert not bench.edges


def test_too_few_images_in_flash_are_found_when_opened(folder, flash, bench):
    with SimulatedDlpc350(bench, flash[:4]) as device:
        with pytest.raises(FeatureError, match=r"flash holds 4 images, the set in .* number 10"):
            projector_of(device, folder).open()


def test_a_set_may_stand_behind_other_images(folder, flash, bench):
    other = np.full((HEIGHT, WIDTH, 3), 50, np.uint8)
    with SimulatedDlpc350(bench, (other, other, *flash)) as device:
        with projector_of(device, folder, first_image=2) as projector:
            projector.blank(200)
            assert shows(bench, even(200))


class Raw:
    """A client that says what it likes."""

    def __init__(self, device: SimulatedDlpc350) -> None:
        self.hid = SocketHid(device.pair())
        self.sequence = 0

    def refused(self, command: int, payload: bytes = b"", *, reads: bool = False) -> bool:
        self.sequence += 1
        for report in Request(command, payload, self.sequence, reads).reports():
            self.hid.write(b"\0" + report)
        reply = protocol.parse_reply([self.hid.read(64, 2000)])
        assert reply is not None
        assert reply.sequence == self.sequence
        return reply.refused


@pytest.mark.parametrize(
    ("command", "payload", "reads"),
    [
        (0x1AFF, b"", False),
        (0x7777, b"\1", False),
        (Command.TIMING, b"\0", False),
        (Command.MAILBOX, b"\x09", False),
        (Command.MAILBOX_DATA, b"\0\0\0", False),
        (Command.START_STOP, b"\2", False),
        (Command.START_STOP, b"", False),
        (Command.IMAGE_LOAD_TIME, b"\xff\1", False),
        (Command.VERSION, b"\0", False),
        (Command.MAILBOX, b"", True),
    ],
)
def test_the_device_refuses_what_makes_no_sense_and_goes_on(device, command, payload, reads):
    client = Raw(device)
    with closing(client.hid):
        assert client.refused(command, payload, reads=reads)
        assert not client.refused(Command.MAIN_STATUS, reads=True)


def test_the_device_starts_nothing_that_was_not_validated(device, projector, bench):
    projector.load([even(100)])
    projector.arm_sequence([0], 8333, 8333)
    projector._device.write(Command.TIMING, protocol.timing_payload(5000, 5000))
    with pytest.raises(FeatureError, match="refused command 1A24"):
        projector.start_sequence()
    assert not bench.edges


@pytest.mark.parametrize(
    ("exposure_us", "period_us", "found"),
    [(5000, 5000, Validation.TIMING), (16_600, 16_700, Validation.DARK_TIME)],
)
def test_the_device_itself_rejects_invalid_timing(device, projector, exposure_us, period_us, found):
    projector.load([even(100)])
    projector.arm_sequence([0], 8333, 8333)
    link = projector._device
    link.write(Command.TIMING, protocol.timing_payload(exposure_us, period_us))
    link.write(Command.VALIDATE, b"\0")
    assert Validation(link.read(Command.VALIDATE)[0]) == found


def test_nothing_is_changed_while_a_sequence_runs(device, projector):
    projector.blank(255)
    with pytest.raises(FeatureError, match="refused command 1A29"):
        projector._device.write(Command.TIMING, protocol.timing_payload(9000, 9000))


# ---------------------------------------------------------------- from a rig file, from another process


def test_the_driver_has_a_name(folder):
    made = make_projector("projector", "dlpc350", {"patterns": str(folder)}, PageDesk())
    assert isinstance(made, Dlpc350Projector)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "option patterns is missing"),
        ({"patterns": "/nowhere"}, "pattern set /nowhere/patterns.json can't be read"),
        ({"transport": "tcp:1"}, "use usb, usb:SERIAL or unix:"),
        ({"source": "video"}, "source"),
        ({"led_currents": [0, 0, 256]}, "0 to 255"),
        ({"trigger_delay_us": 10}, "trigger_delay_us"),
        ({"show_period_us": 5000}, "show_period_us 5000 is too short for patterns of 8 bit"),
    ],
)
def test_options_that_cannot_be_used_are_one_sentence(folder, options, sentence):
    given = {"patterns": str(folder), **options} if options else {}
    with pytest.raises(RigConfigError, match=sentence):
        make_projector("projector", "dlpc350", given, PageDesk())


def test_sets_for_another_projector_or_without_images_are_refused(tmp_path):
    write_set(tmp_path / "small", [NewPattern(np.zeros((100, 160), np.uint8), "black")], pack=True)
    with pytest.raises(RigConfigError, match="160x100 px, the projector 912x1140"):
        make_projector("p", "dlpc350", {"patterns": str(tmp_path / "small")}, PageDesk())
    write_set(tmp_path / "loose", [NewPattern(even(0), "black")])
    with pytest.raises(RigConfigError, match="export it with --pack 24bit"):
        make_projector("p", "dlpc350", {"patterns": str(tmp_path / "loose")}, PageDesk())


def test_another_process_connects_at_a_path_one_at_a_time(tmp_path, folder, flash, bench):
    path = str(tmp_path / "lcr")
    options = {"patterns": str(folder), "transport": f"unix:{path}"}
    first, second = (make_projector(n, "dlpc350", options, PageDesk()) for n in ("one", "two"))
    with pytest.raises(DeviceNotFound, match="no simulated LightCrafter listens at"):
        first.open()
    with SimulatedDlpc350(bench, flash) as device:
        device.listen(path)
        with first:
            first.blank(200)
            assert shows(bench, even(200))
            with pytest.raises(DeviceBusy, match="close the other program"):
                second.open()
        second.reconnect()
        second.close()
    assert not Path(path).exists()


def test_a_measured_latency_is_waited_for(tmp_path, folder):
    """Its rig file says no size: there is only one."""
    entry = f"projector: {{driver: dlpc350, patterns: {folder}}}"
    (tmp_path / "bench.yaml").write_text(
        f"cameras: {{left: {{driver: aravis, address: 127.0.0.9}}}}\n{entry}\n"
    )
    shelf = RigShelf(tmp_path, PageDesk())
    assert _settle_ms(shelf) is None
    kept = {"size": [WIDTH, HEIGHT], "refresh_hz": 120.0048, "settle_ms": 25.0}
    (tmp_path / "bench.latency.json").write_text(json.dumps(kept))
    assert _settle_ms(shelf) == 25.0
    text = (tmp_path / "bench.yaml").read_text()
    for period_us, holds in ((8333, True), (16_667, False), (8334, False)):
        other = text.replace("driver: dlpc350,", f"driver: dlpc350, show_period_us: {period_us},")
        (tmp_path / "bench.yaml").write_text(other)
        assert _settle_ms(shelf) == (25.0 if holds else None), "measured with another period"


def test_a_later_image_is_loaded_while_the_one_before_it_is_shown(tmp_path):
    """Of four images the second is there from the beginning, however shortly the first one is shown."""
    random = np.random.default_rng(1)
    noise = [random.integers(0, 256, (HEIGHT, WIDTH), np.uint8) for _ in range(3)]
    pictures = [*noise, *(even(level) for level in range(6))]
    write_set(tmp_path, [NewPattern(p, "mixed") for p in pictures], pack=True)
    flash = PatternSet.read(tmp_path).image_pictures(tmp_path)
    assert [round(load_ms(image)) for image in flash] == [200, 0, 0]
    bench = Bench()
    with SimulatedDlpc350(bench, flash) as device, projector_of(device, tmp_path) as projector:
        projector.load(pictures)
        for order in ([3, 4, 5, 0, 1, 2, 6, 7, 8], [0, 1, 2, 3, 4, 5, 6, 7, 8]):
            projector.arm_sequence(order, 16_667, 16_667)
            projector.start_sequence()
            ran(device)
        assert device.late_images == 0
        with pytest.raises(FeatureError, match="image 0 takes 200 ms"):
            projector.arm_sequence([3, 4, 5, 6, 7, 8, 0, 1, 2], 16_667, 16_667)


def _settle_ms(shelf: RigShelf) -> float | None:
    projector = shelf.open("bench", {}).projector
    assert isinstance(projector, Dlpc350Projector)
    return projector.settle_ms


def test_without_a_device_on_usb_it_is_one_sentence(folder):
    pytest.importorskip("hid")
    projector = make_projector("projector", "dlpc350", {"patterns": str(folder)}, PageDesk())
    with pytest.raises(DeviceNotFound, match="projector: no LightCrafter 4500 is on USB"):
        projector.open()


def test_without_hidapi_the_sentence_says_what_to_install(folder, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "hid", None)
    projector = make_projector("projector", "dlpc350", {"patterns": str(folder)}, PageDesk())
    with pytest.raises(DeviceNotFound, match=r"pip install 'unglare\[lightcrafter\]'"):
        projector.open()


# ---------------------------------------------------------------- a whole rig

try:
    aravis()
except AravisMissingError as error:
    needs_aravis = pytest.mark.skipif(True, reason=str(error))
else:
    needs_aravis = pytest.mark.skipif(False, reason="Aravis is installed.")


@contextmanager
def laboratory(addresses: tuple[str, str], folder: Path) -> Iterator[Rig]:
    """The rig that an operator would open."""
    with lightcrafter_hardware(addresses, folder) as (device, _):
        cameras = {
            name: AravisCamera(name, AravisOptions(address=address))
            for name, address in zip(("left", "right"), addresses, strict=True)
        }
        sensors = dict.fromkeys(cameras, SensorFacts(8, 4.0, 15_300.0, 12.0))
        projector = projector_of(device, folder, settle_ms=10.0)
        lines = dict.fromkeys(cameras, TriggerSource.LINE1)
        rig = AssembledRig("bench", cameras, projector, sensors=sensors, trigger_lines=lines)
        with rig:
            yield rig


@needs_aravis
class TestLightCrafterWithGigEVision(RigConformance):
    has_light = True

    @pytest.fixture
    def rig(self, addresses, folder):
        with laboratory(addresses, folder) as rig:
            yield rig


@needs_aravis
def test_a_sequence_brings_every_frame_of_every_camera(addresses, folder):
    """24 fringes at 16.7 ms: 24 frames of each camera, in order, equally spaced by its own clock."""
    with laboratory(addresses, folder) as rig:
        rig.projector.load([fringe(k) for k in range(STEPS)])
        for frames in _sequence(rig):
            spacing_s = np.diff([f.timestamp_s for f in frames])
            np.testing.assert_allclose(spacing_s, 0.016667, atol=1e-6)
            assert np.unique(np.diff([f.frame_id for f in frames])).tolist() == [1]
            _in_order(np.array([f.data for f in frames], float))


def _sequence(rig: Rig) -> list[list[Frame]]:
    """Run it, again as a scan does if a packet came too late on a busy machine."""
    projector = rig.projector
    assert isinstance(projector, SequenceProjector)
    for attempt in (1, 2, 3):
        for camera in rig.cameras.values():
            camera.disarm()
            camera.configure(
                replace(camera.settings, exposure_us=12_000.0, trigger=TriggerSource.LINE1)
            )
            camera.arm(STEPS)
        projector.arm_sequence(range(STEPS), 16_437.0, 16_667.0)
        projector.start_sequence()
        try:
            return [
                [camera.get_frame(timeout_s=10.0) for _ in range(STEPS)]
                for camera in rig.cameras.values()
            ]
        except (IncompleteFrame, DeviceTimeout):
            if attempt == 3:
                raise
    raise AssertionError("the last attempt returns or raises")


def _in_order(frames: np.ndarray) -> None:
    """Each pixel sees one period of a cosine in 24 steps: its phase says where the sequence began, to a step."""
    steps = np.exp(-2j * np.pi * np.arange(STEPS) / STEPS)
    seen = np.tensordot(steps, frames, axes=1) * 2 / STEPS
    back = np.real(seen[np.newaxis] * np.conj(steps)[:, np.newaxis, np.newaxis])
    well_lit = np.abs(seen) > 20
    assert well_lit.mean() > 0.3
    residual = (frames - frames.mean(axis=0) - back)[:, well_lit]
    assert np.sqrt((residual**2).mean()) < 3.0


def test_stopping_from_another_thread_ends_a_sequence(projector, device):
    projector.load([even(255)])
    projector.arm_sequence([0] * 128, 30_000, 30_000)
    projector.start_sequence()
    stopping = threading.Thread(target=projector.stop_sequence)
    stopping.start()
    stopping.join(timeout=60)
    assert device._action is Action.STOP
