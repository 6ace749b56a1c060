"""DLP LightCrafter 4500 (controller DLPC350) over USB: patterns from its flash, timed by its own clock. Experimental.

Written from TI's programmer's guide and public drivers, tried against the simulated device of
`backend.devices.peers.dlpc350` only, never on a real one.

USB can't carry patterns fast enough: they have to be in the projector's flash already. `unglare patterns export --pack
24bit` writes them, TI's program stores them, and the rig file names the folder of that export: a pattern to be shown is
found in it by its content. Whether the flash really holds what the folder says can't be read back; the number of
images is checked.

The chip is linear, has no gamma in this mode, and its 912x1140 mirrors stand on their corners (`pixel_layout`
"diamond"): a projector model for square pixels doesn't fit it.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, field_validator

from backend.devices import dlpc350_protocol as protocol
from backend.devices.dlpc350_protocol import Action, Command, LutEntry, Mailbox, Validation
from backend.devices.drivers.dlpc350_link import Commands, Connect, connection, hidapi
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    RigConfigError,
)
from backend.devices.link import Link
from backend.devices.options import DeviceOptions, read_options, takes
from backend.devices.pages import PageDesk
from backend.devices.pattern_set import PatternSet, SetPattern, pattern_hash
from backend.devices.protocols import DeviceInfo, LinkState, Presented, ProjectorCapabilities
from backend.devices.refusals import refuse_level, refuse_other_sizes, refuse_unloaded

log = logging.getLogger(__name__)

_POLL_S = 0.005
_VALIDATED_S = 2.0
_STARTED_S = 0.5
_RETRY_S = 0.5
_REFUSED = Validation.TIMING | Validation.PATTERN_NUMBER | Validation.DARK_TIME
_PROBLEMS = {
    Validation.TIMING: "the exposure or the period is invalid",
    Validation.PATTERN_NUMBER: "a pattern number is invalid",
    Validation.DARK_TIME: f"period and exposure differ by less than {protocol.DARK_US} us",
    Validation.TRIGGER_OUT: "the trigger output overlaps",
    Validation.POST_VECTOR: "no black follows a pattern",
}


class Dlpc350Options(DeviceOptions):
    """How a LightCrafter 4500 is driven."""

    patterns: Path
    """Folder of the exported pattern set that its flash holds."""
    source: Literal["flash"] = "flash"
    """Where patterns come from; the video input isn't supported."""
    transport: str = "usb"
    """`usb`, `usb:SERIAL`, or `unix:/path` of a simulated one."""
    first_image: int = Field(0, ge=0, le=255)
    """Number in flash of the set's first image, where others were there before."""
    trigger_edge: Literal["rising", "falling"] = "rising"
    """Edge of TRIG_OUT_1 at the start of each pattern."""
    trigger_delay_us: float = Field(
        0.0, ge=round(protocol.DELAY_RANGE_US[0], 3), le=round(protocol.DELAY_RANGE_US[1], 3)
    )
    """From the pattern's start to that edge; before it where negative."""
    leds: Literal["white", "red", "green", "blue"] = "white"
    led_currents: tuple[int, int, int] | None = None
    """Red, green, blue, 0 to 255 (most); None leaves them alone. Too much destroys the LEDs: see TI's guide."""
    show_period_us: int = Field(protocol.SHOW_PERIOD_US, ge=235, le=2_000_000)
    """Period of a single pattern that is shown until the next: exposures should be multiples of it."""
    settle_ms: float | None = Field(None, ge=0, le=10_000)
    """From the start of a single pattern, its image being loaded, to its light, as the latency calibration found it;
    None: not measured yet."""
    standby: bool = False
    """Leave the projector in standby when it is closed."""

    @field_validator("patterns")
    @classmethod
    def _from_home(cls, value: Path) -> Path:
        return value.expanduser()

    @field_validator("transport")
    @classmethod
    def _reachable(cls, value: str) -> str:
        connection(value)
        return value

    @field_validator("led_currents")
    @classmethod
    def _of_a_byte(cls, value: tuple[int, int, int] | None) -> tuple[int, int, int] | None:
        if value is not None and not all(0 <= current <= 255 for current in value):
            raise ValueError("currents are whole numbers from 0 to 255")
        return value


@takes(Dlpc350Options, library=lambda: hidapi("dlpc350"))
def create_projector(name: str, options: Mapping[str, Any], desk: PageDesk) -> "Dlpc350Projector":
    """Make a projector of a rig file's entry."""
    del desk  # it has no page
    chosen = read_options(Dlpc350Options, name, options)
    return Dlpc350Projector(name, chosen)


@dataclass(frozen=True)
class _Run:
    """A sequence as the device's two tables have it."""

    images: tuple[int, ...]
    """Numbers in flash, in the order in which they are needed."""
    entries: tuple[LutEntry, ...]
    shown: tuple[int, ...]
    """How many patterns are taken from each image before the next."""


class Dlpc350Projector(Link):
    """A `SequenceProjector`.

    Parameters
    ----------
    name
        Name of the projector in its rig.
    options
        How it is driven.
    connect
        Opens a connection instead of the one that the options name; for a simulated device in this process.

    Raises
    ------
    RigConfigError
        If the pattern set can't be used.
    """

    def __init__(self, name: str, options: Dlpc350Options, connect: Connect | None = None) -> None:
        super().__init__(
            name,
            DeviceInfo(
                "Texas Instruments",
                "LightCrafter 4500 (experimental)",
                driver="dlpc350 (experimental)",
                address=options.transport,
            ),
        )
        self._options = options
        self._connect = connect or connection(options.transport)
        self._set = _usable_set(name, options)
        self._by_hash = {pattern.hash: pattern for pattern in self._set.patterns}
        self._device: Commands | None = None
        self._loaded: tuple[SetPattern, ...] = ()
        self._load_ms: dict[int, float] = {}
        self._stop = threading.Event()
        self._duration_s: float | None = None
        self.settle_ms = options.settle_ms

    @property
    def notes(self) -> tuple[str, ...]:
        """Say what its mirrors mean for who decodes columns."""
        return (
            f"{self.name}: its mirrors stand on their corners: columns are twice as far apart as rows, and every second row"
            " stands half a column further; decoded columns are a quarter of one off there, to either side.",
        )

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return ProjectorCapabilities(
            size=protocol.SIZE_PX,
            bit_depths=(self._set.bit_depth,),
            refresh_hz=1e6 / self._options.show_period_us,
            sequence=True,
            max_sequence=protocol.MOST_PATTERNS,
            linear=True,
            pixel_layout="diamond",
            trigger_out=True,
            min_exposure_us=float(protocol.LEAST_EXPOSURE_US[self._set.bit_depth]),
        )

    # ------------------------------------------------------------ life

    def open(self) -> None:
        """Take control, and set up what doesn't change from pattern to pattern; the light stays off."""
        if self._state in (LinkState.READY, LinkState.ARMED):
            return
        self._stop.clear()
        self._hang_up()
        self._device = Commands(self.name, self._connect(self.name))
        try:
            self._set_up(self._device)
        except BaseException:
            self._hang_up()
            raise
        self._state = LinkState.READY

    def close(self) -> None:
        """Darken the projector and give it back."""
        self._stop.set()
        if self._device is not None and self._state is LinkState.READY:
            try:
                self._device.write(Command.START_STOP, bytes((Action.STOP,)))
                if self._options.standby:
                    self._device.write(Command.POWER, b"\1")
            except DeviceError as error:
                log.warning("The projector may still be lit: %s", error)
        self._hang_up()
        self._duration_s = None
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Take control again once the device is back; loaded patterns are in its flash still."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self.close()
            try:
                self.open()
                return
            except (DeviceNotFound, DeviceBusy, DeviceTimeout, DeviceDisconnected) as error:
                if time.monotonic() > deadline_s:
                    raise self._lose(f"it didn't come back within {timeout_s:g} s") from error
            time.sleep(_RETRY_S)

    def _hang_up(self) -> None:
        if self._device is not None:
            self._device.close()
        self._device = None

    def _set_up(self, device: Commands) -> None:
        try:
            version = device.read(Command.VERSION, 4)
        except DeviceDisconnected as error:
            raise DeviceBusy(
                self.name, "the projector hung up at once; close the other program that uses it"
            ) from error
        patch, minor, major = version[0] | version[1] << 8, version[2], version[3]
        self._info = replace(self._info, firmware=f"{major}.{minor}.{patch}")
        device.write(Command.POWER, b"\0")
        with contextlib.suppress(FeatureError):  # nothing runs, or video is shown
            device.write(Command.START_STOP, bytes((Action.STOP,)))
        device.write(Command.DISPLAY_MODE, bytes((protocol.DisplayMode.PATTERN,)))
        device.write(Command.START_STOP, bytes((Action.STOP,)))
        device.write(Command.LED_ENABLE, bytes((protocol.LEDS_BY_SEQUENCER,)))
        if self._options.led_currents is not None:
            # The LightCrafter's LED driver is inverted: 255 is no current.
            device.write(Command.LED_CURRENTS, bytes(255 - c for c in self._options.led_currents))
        device.write(Command.PATTERN_SOURCE, bytes((protocol.PatternSource.FLASH,)))
        device.write(Command.TRIGGER_MODE, bytes((protocol.TriggerMode.INTERNAL,)))
        inverted = int(self._options.trigger_edge == "falling")
        delay = protocol.trigger_delay_code(self._options.trigger_delay_us)
        falling = protocol.trigger_delay_code(0.0)
        device.write(Command.TRIGGER_OUT_1, bytes((inverted, delay, falling)))
        device.write(Command.TRIGGER_OUT_2, bytes((inverted, delay)))
        self._refuse_missing_images(device)

    def _refuse_missing_images(self, device: Commands) -> None:
        held = device.read(Command.IMAGES_IN_FLASH)[0]
        needed = self._options.first_image + len(self._set.images)
        if held < needed:
            raise FeatureError(
                self.name,
                f"the projector's flash holds {held} images, the set in {self._options.patterns} ends with number"
                f" {needed - 1}; store the set's images with TI's program, or correct first_image",
            )

    # ------------------------------------------------------------ patterns

    def load(self, patterns: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        """Find patterns in the set that the flash holds."""
        self._need_link()
        refuse_other_sizes(self.name, patterns, protocol.SIZE_PX)
        self._loaded = tuple(self._found(index, picture) for index, picture in enumerate(patterns))

    def _found(self, index: int, picture: UInt8[np.ndarray, "h w"]) -> SetPattern:
        found = self._by_hash.get(pattern_hash(picture))
        if found is None:
            raise FeatureError(
                self.name,
                f"pattern {index} isn't in the set {self._options.patterns}; export the set that this method and its"
                " settings show (unglare patterns export --pack 24bit) and store it in the projector's flash",
            )
        return found

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        """Show one pattern again and again until something else is shown."""
        del timeout_s  # each command has its own
        self._need_link()
        refuse_unloaded(self.name, index, len(self._loaded))
        return self._show(self._loaded[index], index)

    def blank(self, level: int = 0) -> Presented:
        """Darken the projector, or show an even field that the set has."""
        self._need_link()
        refuse_level(self.name, level)
        if level == 0:
            self._halt()
            return self._settled(-1, loading_ms=0.0, frame_ms=0.0)
        width, height = protocol.SIZE_PX
        even = self._by_hash.get(pattern_hash(np.full((height, width), level, np.uint8)))
        if even is None:
            raise FeatureError(
                self.name,
                f"an even field of level {level} isn't in the set {self._options.patterns}; use one of"
                f" {', '.join(map(str, self._levels()))}, or export the set with --level {level}",
            )
        return self._show(even, -1)

    def _levels(self) -> list[int]:
        grays = (
            pattern.pattern["gray"]
            for pattern in self._set.patterns
            if pattern.pattern and pattern.pattern.get("kind") == "uniform"
        )
        return sorted({0, *(round(gray) for gray in grays)})

    def _show(self, pattern: SetPattern, index: int) -> Presented:
        run = self._run((pattern,))
        period_us = self._options.show_period_us
        loading_ms = self._loading_ms(run.images[0])  # measured while nothing runs
        self._program(run, period_us, period_us, repeat=True)
        self._start(None)
        return self._settled(index, loading_ms=loading_ms, frame_ms=period_us / 1000.0)

    def _settled(self, index: int, *, loading_ms: float, frame_ms: float) -> Presented:
        """Wait until the pattern is lit: its image is loaded, and then as long as measured, else a frame.

        The latency is measured with even fields, which load at once; other images take up to 200 ms.
        """
        self._stop.wait(
            (loading_ms + (frame_ms if self.settle_ms is None else self.settle_ms)) / 1000.0
        )
        return Presented(index, time.monotonic(), None, confirmed=self.settle_ms is not None)

    # ------------------------------------------------------------ sequences

    def arm_sequence(self, indices: Sequence[int], exposure_us: float, period_us: float) -> None:
        """Write a run into the device's tables and let it check them."""
        self._need_link()
        for index in indices:
            refuse_unloaded(self.name, index, len(self._loaded))
        if not 0 < len(indices) <= protocol.MOST_PATTERNS:
            raise FeatureError(
                self.name,
                f"{len(indices)} patterns are not within 1 to {protocol.MOST_PATTERNS} of one sequence; split it",
            )
        exposure, period = round(exposure_us), round(period_us)
        self._refuse_timing(exposure, period)
        run = self._run([self._loaded[index] for index in indices])
        self._refuse_slow_loading(run, period)
        self._program(run, exposure, period, repeat=False)
        self._duration_s = len(indices) * period * 1e-6

    def start_sequence(self) -> None:
        """Start the prepared run; returns as soon as it runs."""
        self._need_link()
        if self._duration_s is None:
            raise FeatureError(self.name, "no sequence is prepared; call arm_sequence first")
        duration_s, self._duration_s = self._duration_s, None
        self._start(duration_s)

    def stop_sequence(self) -> None:
        """Stop what runs, and darken the projector."""
        if self._state is LinkState.READY:
            self._halt()

    def _refuse_timing(self, exposure_us: int, period_us: int) -> None:
        depth = self._set.bit_depth
        problem = protocol.timing_problem(exposure_us, period_us, (depth,))
        if Validation.TIMING in problem:
            least_us = protocol.LEAST_EXPOSURE_US[depth]
            raise FeatureError(
                self.name,
                f"an exposure of {exposure_us} us is too short for patterns of {depth} bit; give {least_us} us or more",
            )
        if Validation.DARK_TIME in problem:
            raise FeatureError(
                self.name,
                f"an exposure of {exposure_us} us doesn't fit a period of {period_us} us; make both equal, or the period"
                f" {protocol.DARK_US} us longer or more",
            )

    def _refuse_slow_loading(self, run: _Run, period_us: int) -> None:
        """Refuse a sequence that is through with an image before the next one has been loaded from flash.

        Two images are loaded beforehand; only longer sequences load while they run.
        """
        if len(run.images) <= protocol.PRELOADED_IMAGES:
            return
        preloaded = protocol.PRELOADED_IMAGES
        # While an image is shown, the next one but none further is loaded.
        for image, shown in zip(run.images[preloaded:], run.shown[preloaded - 1 :], strict=False):
            least_us = self._loading_ms(image) * 1000.0 / shown
            if period_us < least_us:
                raise FeatureError(
                    self.name,
                    f"image {image} takes {self._loading_ms(image):.0f} ms to load from flash, the {shown} patterns"
                    f" before it are over after {shown * period_us / 1000.0:.1f} ms; show every pattern for"
                    f" {least_us / 1000.0:.1f} ms or longer, or split the sequence",
                )

    def _loading_ms(self, image: int) -> float:
        """Return how long an image takes from flash to memory, as the device measures it, once for each."""
        if image not in self._load_ms:
            self._load_ms[image] = self._measured_loading_ms(image)
        return self._load_ms[image]

    def _measured_loading_ms(self, image: int) -> float:
        self._halt()
        try:
            self._written(Command.IMAGE_LOAD_TIME, bytes((image, 1)))
            ticks = int.from_bytes(self._read(Command.IMAGE_LOAD_TIME, 4)[:4], "little")
        except FeatureError:  # older firmware can't tell
            return protocol.SLOWEST_LOAD_MS
        return ticks / protocol.LOAD_TICKS_PER_MS

    def _run(self, patterns: Sequence[SetPattern]) -> _Run:
        """Lay patterns out: an image is loaded again whenever the next pattern isn't in the one before."""
        images: list[int] = []
        shown: list[int] = []
        entries = []
        for pattern in patterns:
            image, position = self._place(pattern)
            swap = not images or images[-1] != image
            if swap:
                images.append(image)
                shown.append(0)
            shown[-1] += 1
            leds = protocol.Leds[self._options.leds.upper()]
            entries.append(LutEntry(position, self._set.bit_depth, leds, swap))
        if len(images) > protocol.MOST_IMAGES:
            raise FeatureError(
                self.name,
                f"the sequence changes between images {len(images)} times, at most {protocol.MOST_IMAGES} are possible;"
                " split it",
            )
        return _Run(tuple(images), tuple(entries), tuple(shown))

    def _place(self, pattern: SetPattern) -> tuple[int, int]:
        assert pattern.image is not None  # `_usable_set` refused a set that isn't packed
        assert pattern.position is not None
        return self._options.first_image + pattern.image, pattern.position

    # ------------------------------------------------------------ the device's tables

    def _program(self, run: _Run, exposure_us: int, period_us: int, *, repeat: bool) -> None:
        self._duration_s = None  # whatever was prepared is overwritten
        self._halt()
        for command, payload in _tables(run, exposure_us, period_us, repeat=repeat):
            self._written(command, payload)
        self._validate()

    def _validate(self) -> None:
        self._written(Command.VALIDATE, b"\0")
        deadline_s = time.monotonic() + _VALIDATED_S
        while True:
            found = Validation(self._read(Command.VALIDATE)[0])
            if Validation.BUSY not in found:
                break
            self._wait(deadline_s, "didn't finish checking the sequence; try again")
        if found & _REFUSED:
            raise FeatureError(
                self.name,
                f"the projector refuses the sequence: {_words(found)}; change exposure or period",
            )
        if found:
            log.warning(
                "%s: the projector has doubts about the sequence: %s", self.name, _words(found)
            )

    def _start(self, duration_s: float | None) -> None:
        """Start, and see that it runs; a sequence that may be over by then is believed.

        What repeats until it is stopped (None) is started again if need be: coming from video, a first start was
        seen to be ignored. A sequence never is: its trigger edges would come twice.
        """
        deadline_s = time.monotonic() + _STARTED_S
        self._written(Command.START_STOP, bytes((Action.START,)))
        if duration_s is not None and duration_s < _STARTED_S:
            return
        while self._read(Command.START_STOP)[0] != Action.START:
            self._wait(deadline_s, "didn't start the sequence; try again")
            if duration_s is None:
                self._written(Command.START_STOP, bytes((Action.START,)))

    def _halt(self) -> None:
        self._written(Command.START_STOP, bytes((Action.STOP,)))
        deadline_s = time.monotonic() + _STARTED_S
        while self._read(Command.START_STOP)[0] != Action.STOP:
            self._wait(deadline_s, "didn't stop the sequence; try again")

    def _wait(self, deadline_s: float, problem: str) -> None:
        if time.monotonic() > deadline_s:
            raise DeviceTimeout(self.name, f"the projector {problem}")
        self._stop.wait(_POLL_S)

    def _connected(self) -> Commands:
        self._need_link()
        if self._device is None:
            raise self._lose("the connection was closed")
        return self._device

    def _written(self, command: Command, payload: bytes) -> None:
        try:
            self._connected().write(command, payload)
        except DeviceDisconnected:
            self._state = LinkState.LOST
            raise

    def _read(self, command: Command, least_bytes: int = 1) -> bytes:
        try:
            return self._connected().read(command, least_bytes)
        except DeviceDisconnected:
            self._state = LinkState.LOST
            raise


def _tables(
    run: _Run, exposure_us: int, period_us: int, *, repeat: bool
) -> Iterator[tuple[Command, bytes]]:
    """Return the commands that describe a sequence, in the order that TI's own program has: tables last."""
    yield Command.TIMING, protocol.timing_payload(exposure_us, period_us)
    yield (
        Command.SEQUENCE,
        protocol.sequence_payload(len(run.entries), len(run.images), repeat=repeat),
    )
    patterns = b"".join(entry.packed() for entry in run.entries)
    for mailbox, data in (
        (Mailbox.PATTERNS, patterns),
        (Mailbox.IMAGES, protocol.image_lut(run.images)),
    ):
        yield Command.MAILBOX, bytes((mailbox,))
        yield Command.MAILBOX_OFFSET, b"\0"
        yield Command.MAILBOX_DATA, data
        yield Command.MAILBOX, bytes((Mailbox.CLOSED,))


def _words(found: Validation) -> str:
    return ", ".join(text for bit, text in _PROBLEMS.items() if bit in found)


def _usable_set(name: str, options: Dlpc350Options) -> PatternSet:
    kept = PatternSet.read(options.patterns)
    size = (kept.width_px, kept.height_px)
    wanted = "x".join(map(str, protocol.SIZE_PX))
    if size != protocol.SIZE_PX:
        raise RigConfigError(
            f"{name}: the pattern set {options.patterns} is {size[0]}x{size[1]} px, the projector {wanted}; export it with"
            f" --projector-size {wanted}"
        )
    if not kept.images or any(p.image is None or p.position is None for p in kept.patterns):
        raise RigConfigError(
            f"{name}: the pattern set {options.patterns} has no images for the projector's flash; export it with"
            " --pack 24bit"
        )
    least_us = protocol.LEAST_EXPOSURE_US[kept.bit_depth]
    if options.show_period_us < least_us:
        raise RigConfigError(
            f"{name}: show_period_us {options.show_period_us} is too short for patterns of {kept.bit_depth} bit; give"
            f" {least_us} or more"
        )
    return kept
