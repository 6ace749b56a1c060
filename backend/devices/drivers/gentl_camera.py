"""Any vendor's cameras through its GenTL producer, by harvesters (extra `unglare[gentl]`).

The producer is a file ending in `.cti` that comes with the vendor's software. Naming the producer makes it look for
its cameras when a camera is opened: one for GigE Vision does that by broadcast on the networks that it serves, as
GenTL has no other way. Cameras with a known address are better opened by the drivers `aravis` or `pylon`.

Run on the producer `viky` of the wheel of `genicam`: colour pictures in free run, no exposure, gain, trigger or time
stamp. Never run on a real camera: triggers, gain and exposure (tested on a description in memory), incomplete
buffers, control by somebody else, a cable that is pulled.
"""

import ctypes
import logging
import os
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import Field

from backend.devices.drivers.extras import imported
from backend.devices.drivers.sfnc import SfncOptions, bits_of, gray_of
from backend.devices.drivers.sfnc_camera import SfncCamera
from backend.devices.errors import (
    DeviceBusy,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
)
from backend.devices.found import FoundCamera
from backend.devices.frame_counting import FrameCounter
from backend.devices.options import SerialNumber, read_options, takes
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
)

log = logging.getLogger(__name__)

PRODUCERS_PATH = "GENICAM_GENTL64_PATH"
"""Environment variable in which vendors' installers list the folders of their producers."""
_FEWEST_BUFFERS = 6
_LOOK_MS = 1000
_READY_POLL_S = 0.001
_TRIGGER_WAIT = "FrameTriggerWait"
_READABLE = 3
"""Access modes of GenApi: not implemented, not available, write only, read only, read and write."""


class GentlOptions(SfncOptions):
    """Which producer, and which of its cameras."""

    producer: Path
    """The vendor's producer, a file that ends in `.cti`."""
    serial: SerialNumber = Field(min_length=1)
    """The camera's serial number."""


def _library() -> None:
    imported("gentl", "harvesters.core", "gentl")


@takes(GentlOptions, library=_library)
def create_camera(name: str, options: Mapping[str, Any]) -> "GentlCamera":
    """Make a camera of a rig file's entry."""
    return GentlCamera(name, read_options(GentlOptions, name, options))


class GentlCamera(SfncCamera):
    """A `Camera`. One thread at a time, except for `abort` and `state`."""

    def __init__(self, name: str, options: GentlOptions) -> None:
        info = DeviceInfo("", "", options.serial, driver="gentl")
        super().__init__(name, info, options, fewest_buffers=_FEWEST_BUFFERS)
        self._options = options
        self._producer: _Producer | None = None
        self._acquirer: Any = None
        self._features: GentlFeatures | None = None
        self._counter = FrameCounter(first_block=None)
        self._incomplete = threading.Event()

    # ------------------------------------------------------------ life

    def _connect(self) -> tuple[DeviceInfo, CameraCapabilities, CameraSettings]:
        options = self._options
        if not options.producer.is_file():
            raise DeviceNotFound(
                self.name,
                f"there is no GenTL producer {options.producer}; install the vendor's software and name its .cti file",
            )
        self._producer = _borrow(self.name, options.producer)
        self._acquirer = self._created(self._producer)
        self._acquirer.add_callback(
            self._acquirer.Events.INCOMPLETE_BUFFER, _callback(self.name, self._incomplete.set)
        )
        self._features = GentlFeatures(self._acquirer.remote_device.node_map)
        clocks = ("TimestampLatch", "GevTimestampTickFrequency")
        self._prepare(self._features, hardware_timestamp=any(map(self._features.has, clocks)))
        return self._who(), self._controls.capabilities(), self._controls.read()

    def _created(self, producer: "_Producer") -> Any:
        options = self._options
        where = f"serial number {options.serial} of {options.producer.name}"
        try:
            there = producer.look(options.serial)
            if options.serial not in there:
                raise DeviceNotFound(
                    self.name,
                    f"no camera has {where}, there are: {', '.join(there) or 'none'}; check cable, power and the rig's file",
                )
            return producer.harvester.create({"serial_number": options.serial})
        except _library_errors() as error:
            if type(error).__name__ in ("ResourceInUseException", "AccessDeniedException"):
                raise DeviceBusy(
                    self.name, f"another program controls the camera with {where}; close it there"
                ) from error
            raise DeviceNotFound(
                self.name,
                f"the camera with {where} can't be opened ({_first_part(error)}); check cable and power",
            ) from error

    def _who(self) -> DeviceInfo:
        told = self._acquirer.device
        return DeviceInfo(
            vendor=told.vendor or "",
            model=told.model or "",
            serial=self._options.serial,
            driver=f"gentl {self._options.producer.name}",
            firmware=told.version or "",
        )

    def _disconnect(self) -> None:
        acquirer, self._acquirer = self._acquirer, None
        if acquirer is not None:
            with suppress(*_library_errors()):
                acquirer.destroy()
        producer, self._producer = self._producer, None
        if producer is not None:
            _give_back(producer)

    # ------------------------------------------------------------ settings and frames

    def _start(self, n_frames: int | None) -> None:
        wanted = self._buffers_for(n_frames)
        self._acquirer.num_buffers = max(wanted, self._acquirer.min_num_buffers)
        self._counter.restart()
        self._incomplete.clear()
        self._acquirer.start()

    def _stop(self) -> None:
        self._acquirer.stop()

    def _ready(self, wait_s: float) -> bool:
        """Ask the camera, if it has a status for that; in between it is left in peace."""
        features = self._features
        assert features is not None, "made by _connect"
        if _TRIGGER_WAIT not in features.choices("AcquisitionStatusSelector"):
            return True
        features.set_text("AcquisitionStatusSelector", _TRIGGER_WAIT)
        ready = features.number("AcquisitionStatus") != 0
        if not ready:
            self._aborted.wait(min(_READY_POLL_S, wait_s))
        return ready

    def _fire(self) -> None:
        assert self._features is not None, "made by _connect"
        self._features.run("TriggerSoftware")

    def _next(self, wait_s: float) -> Frame | None:
        buffer = self._acquirer.try_fetch(timeout=wait_s)
        if self._incomplete.is_set():
            self._incomplete.clear()
            if buffer is not None:
                buffer.queue()
            raise IncompleteFrame(self.name, "a frame arrived incomplete; take it again")
        if buffer is None:
            return None
        try:
            return self._frame(buffer)
        finally:
            buffer.queue()

    def _frame(self, buffer: Any) -> Frame:
        settings, (width_px, height_px) = self._settings, self.capabilities.sensor_size
        pixel_format = settings.pixel_format or "Mono8"
        number = self._counter.count(int(buffer.module.frame_id))
        parts = buffer.payload.components
        data = (
            gray_of(parts[0].data, width_px, height_px, pixel_format)
            if parts and (parts[0].width, parts[0].height) == (width_px, height_px)
            else None
        )
        if data is None:
            raise IncompleteFrame(
                self.name, f"frame {number} isn't {width_px}x{height_px} {pixel_format}; take it again"
            )  # fmt: skip
        at_s = None
        if self.capabilities.hardware_timestamp:
            at_s = int(buffer.timestamp) / float(buffer.timestamp_frequency)
        return self._told(data, number, at_s, bits_of(pixel_format))

    # ------------------------------------------------------------ errors

    def _translated(self, error: Exception, doing: str) -> DeviceError | None:
        if not isinstance(error, _library_errors()):
            return None
        match type(error).__name__:
            case "TimeoutException":
                return DeviceTimeout(self.name, f"{doing} took too long; try again")
            case "IoException" | "InvalidHandleException" | "NotInitializedException":
                return self._lose(f"the camera is gone ({doing}: {_first_part(error)})")
        return FeatureError(
            self.name, f"refused {doing}: {_first_part(error)}; choose another value"
        )


class GentlFeatures:
    """The `Features` of a description that genicam reads."""

    def __init__(self, nodes: Any) -> None:
        self._nodes = nodes

    def has(self, name: str) -> bool:
        """Tell whether it can be read, or run."""
        if not self._nodes.has_node(name):
            return False
        node = self._nodes.get_node(name)
        runs = hasattr(node, "execute")
        return bool(node.get_access_mode() >= (_READABLE - 1 if runs else _READABLE))

    def choices(self, name: str) -> tuple[str, ...]:
        """Return what can be set now."""
        if not self.has(name):
            return ()
        entries = self._nodes.get_node(name).entries
        return tuple(e.symbolic for e in entries if e.get_access_mode() >= _READABLE)

    def text(self, name: str) -> str:
        """Return a feature as text."""
        return str(self._nodes.get_node(name).to_string())

    def number(self, name: str) -> float:
        """Return a number."""
        return float(self._nodes.get_node(name).value)

    def flag(self, name: str) -> bool:
        """Tell whether something is on."""
        return bool(self._nodes.get_node(name).value)

    def bounds(self, name: str) -> tuple[float, float, float]:
        """Return smallest, largest and step."""
        node = self._nodes.get_node(name)
        stepped = not hasattr(node, "has_inc") or node.has_inc()
        return float(node.min), float(node.max), float(node.inc) if stepped else 0.0

    def unit(self, name: str) -> str:
        """Return the unit."""
        return str(self._nodes.get_node(name).unit)

    def set_text(self, name: str, value: str) -> None:
        """Set an enumeration."""
        self._nodes.get_node(name).value = value

    def set_number(self, name: str, value: float) -> None:
        """Set a number."""
        node = self._nodes.get_node(name)
        node.value = value if hasattr(node, "has_inc") else round(value)

    def set_flag(self, name: str, *, value: bool) -> None:
        """Switch something on or off."""
        self._nodes.get_node(name).value = value

    def run(self, name: str) -> None:
        """Execute a command."""
        self._nodes.get_node(name).execute()


# ---------------------------------------------------------------- producers


class _Producer:
    """A loaded producer, and how many cameras of this process use it."""

    def __init__(self, path: Path, harvester: Any) -> None:
        self.path = path
        self.harvester = harvester
        self.users = 0

    def look(self, serial: str = "") -> list[str]:
        """Look whether a camera is there, or which are; return the serial numbers."""
        if self.users == 1:  # harvesters takes the cameras away from whoever has one
            self.harvester.update()
        for told in self.harvester.device_info_list:
            if str(told.serial_number) == serial:
                told.parent.update_device_info_list(_LOOK_MS)  # it may have been away meanwhile
        return [str(told.serial_number) for told in self.harvester.device_info_list]


_producers: dict[Path, _Producer] = {}
_loading = threading.Lock()


def _borrow(device: str, path: Path) -> _Producer:
    """Load a producer, or take the loaded one: most can't be loaded twice by one process."""
    core = imported(device, "harvesters.core", "gentl")
    with _loading:
        producer = _producers.get(path)
        if producer is None:
            try:
                _ = ctypes.CDLL(str(path)).GCInitLib  # harvesters only logs what it can't load
            except (OSError, AttributeError) as error:
                raise DeviceNotFound(
                    device,
                    f"GenTL producer {path} can't be loaded ({error}); install the vendor's software again",
                ) from error
            # What it logs comes as exceptions, too.
            logging.getLogger("harvesters").setLevel(logging.CRITICAL)
            harvester = core.Harvester()
            harvester.add_file(str(path))
            producer = _producers[path] = _Producer(path, harvester)
        producer.users += 1
        return producer


def _give_back(producer: _Producer) -> None:
    with _loading:
        producer.users -= 1
        if producer.users == 0:
            del _producers[producer.path]
            with suppress(*_library_errors()):
                producer.harvester.reset()


def _callback(device: str, tell: Callable[[], None]) -> Any:
    """Make harvesters' kind of callback of a function."""
    core = imported(device, "harvesters.core", "gentl")

    class _Told(core.Callback):  # type: ignore[misc,name-defined]  # a class of a library that may be missing
        def emit(self, context: object) -> None:
            del context
            tell()

    return _Told()


def _library_errors() -> tuple[type[Exception], ...]:
    gentl = imported("gentl", "genicam.gentl", "gentl")
    genapi = imported("gentl", "genicam.genapi", "gentl")
    return gentl.GenericException, genapi.GenericException


def _first_part(error: Exception) -> str:
    """Return what happened, without where in the library."""
    text = " ".join(str(error).split()).removeprefix("GenTL exception: ")
    return text.split(" (Message from")[0].split(" : ")[0].rstrip(".")


def search() -> tuple[FoundCamera, ...]:
    """Let the producers that vendors' installers registered look for cameras; those for GigE Vision broadcast.

    Raises
    ------
    DeviceNotFound
        If none sees a camera and one can't be used, e.g. that of a program that was half removed.
    """
    found: list[FoundCamera] = []
    failed: list[DeviceError] = []
    for path in _registered():
        try:
            found += _seen_by(path)
        except DeviceError as error:
            failed.append(error)
    if failed and not found:
        raise failed[0]
    for problem in failed:
        log.warning("%s", problem)
    return tuple(found)


def _registered() -> list[Path]:
    folders = os.environ.get(PRODUCERS_PATH, "").split(os.pathsep)
    return [path for folder in folders if folder for path in sorted(Path(folder).glob("*.cti"))]


def _seen_by(path: Path) -> list[FoundCamera]:
    producer = _borrow("gentl", path)
    try:
        try:
            producer.look()
        except _library_errors() as error:
            raise DeviceNotFound(
                "gentl",
                f"GenTL producer {path} can't look for cameras ({_first_part(error)}); install the vendor's software again",
            ) from error
        return [
            FoundCamera(
                "gentl",
                {"producer": str(path), "serial": str(told.serial_number)},
                vendor=told.vendor or "",
                model=told.model or "",
                serial=str(told.serial_number),
            )
            for told in producer.harvester.device_info_list
        ]
    finally:
        _give_back(producer)


create_camera.search = search  # type: ignore[attr-defined]  # called by discovery
