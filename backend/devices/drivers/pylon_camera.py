"""Basler's GigE Vision and USB3 Vision cameras, and Basler's emulated ones, through pylon (extra `unglare[pylon]`).

A camera with an `address` is asked by unicast and nobody else. One with a `serial` is looked for among USB3 Vision
cameras, or among the emulated ones: finding a serial number on the network would take a broadcast.

Run on emulated cameras only, which take settings and triggers like an ace 2, but whose pictures don't depend on
exposure and gain. Never run on a real camera: control by somebody else, removal of a cable, time stamps.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
from pydantic import model_validator

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
from backend.devices.options import SerialNumber, SingleAddress, read_options, takes
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
)

_NETWORK, _USB, _EMULATED = "BaslerGigE", "BaslerUsb", "BaslerCamEmu"
_EMULATED_COUNT = "PYLON_CAMEMU"
"""Environment variable: how many cameras pylon emulates; read when it first looks for them."""
_FEWEST_BUFFERS = 10
_TICKS_PER_S = 1e9
_CONTROLLED = "another"
"""Word in pylon's sentences about cameras that another application or client has opened."""


class PylonOptions(SfncOptions):
    """How a camera is found; one of address and serial."""

    address: SingleAddress = ""
    """IPv4 address of a GigE Vision camera."""
    serial: SerialNumber = ""
    """Serial number of a USB3 Vision or emulated camera."""
    emulated: bool = False
    """Whether pylon shall emulate it: serial numbers are 0815-0000, 0815-0001, and so on."""
    pictures: Path | None = None
    """Folder of pictures of one size that an emulated camera takes, by name, one per trigger, over and over."""

    @model_validator(mode="after")
    def _findable(self) -> "PylonOptions":
        if bool(self.address) == bool(self.serial):
            raise ValueError(
                "give either the address of a GigE Vision camera or the serial of a USB3 Vision or emulated one"
            )
        if (self.address or not self.emulated) and (self.pictures or self.emulated):
            raise ValueError("an emulated camera has `emulated: true` and a serial, no address")
        return self


def _library() -> None:
    imported("pylon", "pypylon.pylon", "pylon")


@takes(PylonOptions, library=_library)
def create_camera(name: str, options: Mapping[str, Any]) -> "PylonCamera":
    """Make a camera of a rig file's entry."""
    return PylonCamera(name, read_options(PylonOptions, name, options))


class PylonCamera(SfncCamera):
    """A `Camera`. One thread at a time, except for `abort` and `state`."""

    def __init__(self, name: str, options: PylonOptions) -> None:
        where = DeviceInfo(
            "", "", options.serial, driver="pylon", address=options.address, simulated=options.emulated
        )  # fmt: skip
        super().__init__(name, where, options, fewest_buffers=_FEWEST_BUFFERS)
        self._options = options
        self._device: Any = None
        self._counter = FrameCounter()
        self._ticks_per_s: float | None = None

    # ------------------------------------------------------------ life

    def _connect(self) -> tuple[DeviceInfo, CameraCapabilities, CameraSettings]:
        if self._options.emulated:
            os.environ.setdefault(_EMULATED_COUNT, "8")
        pylon = imported(self.name, "pypylon.pylon", "pylon")
        self._device = pylon.InstantCamera(self._created(pylon))
        try:
            self._device.Open()
        except _library_errors() as error:
            raise self._not_opened(error) from error
        features = PylonFeatures(self._device.GetNodeMap())
        self._ticks_per_s = _clock_of(features, self._device_class)
        self._prepare(features, hardware_timestamp=self._ticks_per_s is not None)
        self._replay(features)
        return self._who(pylon, features), self._controls.capabilities(), self._controls.read()

    @property
    def _device_class(self) -> str:
        if self._options.address:
            return _NETWORK
        return _EMULATED if self._options.emulated else _USB

    def _created(self, pylon: Any) -> Any:
        """Make pylon's device; the class confines the search to one way of finding cameras."""
        wanted = pylon.DeviceInfo()
        wanted.SetDeviceClass(self._device_class)
        if self._options.address:
            wanted.SetIpAddress(self._options.address)
        else:
            wanted.SetSerialNumber(self._options.serial)
        try:
            return pylon.TlFactory.GetInstance().CreateDevice(wanted)
        except _library_errors() as error:
            raise self._not_opened(error) from error

    def _not_opened(self, error: Exception) -> DeviceError:
        options = self._options
        where = (
            f"at {options.address}" if options.address else f"with serial number {options.serial}"
        )
        if _CONTROLLED in str(error):
            return DeviceBusy(
                self.name, f"another program controls the camera {where}; close it there"
            )
        cure = "check cable, power and the rig's file"
        if options.emulated:
            cure = f"set {_EMULATED_COUNT} to a number of cameras before the program starts"
        return DeviceNotFound(
            self.name, f"no camera answers {where} (pylon: {_first_part(error)}); {cure}"
        )

    def _disconnect(self) -> None:
        if self._device is None:
            return
        device, self._device = self._device, None
        with suppress(*_library_errors()):
            device.Close()
        with suppress(*_library_errors()):
            device.DestroyDevice()

    def _who(self, pylon: Any, features: "PylonFeatures") -> DeviceInfo:
        options, told = self._options, self._device.GetDeviceInfo()
        firmware = "DeviceFirmwareVersion"
        return DeviceInfo(
            vendor=told.GetVendorName(),
            model=told.GetModelName(),
            serial=told.GetSerialNumber(),
            driver=f"pylon {pylon.GetPylonVersionString()}",
            firmware=features.text(firmware) if features.has(firmware) else "",
            address=options.address,
            simulated=options.emulated,
        )

    def _replay(self, features: "PylonFeatures") -> None:
        """Let an emulated camera take the pictures of a folder, in their size."""
        folder = self._options.pictures
        if folder is None:
            return
        size = _picture_size(folder)
        if size is None:
            raise FeatureError(
                self.name, f"there is no picture in {folder}; name a folder of PNG or TIFF files"
            )
        features.set_number("Width", size[0])
        features.set_number("Height", size[1])
        features.set_text("TestImageSelector", "Off")
        features.set_text("ImageFilename", str(folder))
        features.set_text("ImageFileMode", "On")

    # ------------------------------------------------------------ settings and frames

    def _start(self, n_frames: int | None) -> None:
        """Grab one by one: every frame that was exposed is delivered, in order."""
        pylon = imported(self.name, "pypylon.pylon", "pylon")
        self._device.MaxNumBuffer.SetValue(self._buffers_for(n_frames))
        self._counter.restart()
        self._device.StartGrabbing(pylon.GrabStrategy_OneByOne)

    def _stop(self) -> None:
        self._device.StopGrabbing()

    def _ready(self, wait_s: float) -> bool:
        """Ask the camera: a trigger that comes right after the start is lost otherwise."""
        if not self._device.CanWaitForFrameTriggerReady():
            return True
        pylon = imported(self.name, "pypylon.pylon", "pylon")
        wait_ms = max(1, round(1e3 * wait_s))
        ready = self._device.WaitForFrameTriggerReady(wait_ms, pylon.TimeoutHandling_Return)
        if not ready:
            self._refuse_removed()
        return bool(ready)

    def _fire(self) -> None:
        self._device.GetNodeMap().GetNode("TriggerSoftware").Execute()

    def _next(self, wait_s: float) -> Frame | None:
        pylon = imported(self.name, "pypylon.pylon", "pylon")
        wait_ms = max(1, round(1e3 * wait_s))
        grabbed = self._device.RetrieveResult(wait_ms, pylon.TimeoutHandling_Return)
        if not grabbed.IsValid():
            self._refuse_removed()
            return None
        try:
            return self._frame(grabbed)
        finally:
            grabbed.Release()

    def _frame(self, grabbed: Any) -> Frame:
        settings = self._settings
        pixel_format = settings.pixel_format or "Mono8"
        number = self._counter.count(int(grabbed.GetBlockID()))
        if not grabbed.GrabSucceeded():
            why = grabbed.GetErrorDescription().rstrip(".")
            raise IncompleteFrame(
                self.name, f"frame {number} arrived incomplete (pylon: {why}); take it again"
            )
        with grabbed.GetArrayZeroCopy() as samples:
            data = gray_of(samples, *self.capabilities.sensor_size, pixel_format)
        if data is None:
            raise IncompleteFrame(self.name, f"frame {number} is too short; take it again")
        ticks = int(grabbed.GetTimeStamp())
        at_s = ticks / self._ticks_per_s if self._ticks_per_s else None
        return self._told(data, number, at_s, bits_of(pixel_format))

    # ------------------------------------------------------------ errors

    def _refuse_removed(self) -> None:
        if self._device.IsCameraDeviceRemoved():
            raise self._lose("the camera is gone")

    def _translated(self, error: Exception, doing: str) -> DeviceError | None:
        if not isinstance(error, _library_errors()):
            return None
        if self._device is not None and self._device.IsCameraDeviceRemoved():
            return self._lose(f"the camera is gone ({doing})")
        if isinstance(error, _genicam().TimeoutException):
            return DeviceTimeout(self.name, f"{doing} took too long ({_first_part(error)}); try again")  # fmt: skip
        return FeatureError(
            self.name, f"refused {doing}: {_first_part(error)}; choose another value"
        )


class PylonFeatures:
    """The `Features` of a camera that pylon opened."""

    def __init__(self, nodes: Any) -> None:
        self._nodes = nodes

    def has(self, name: str) -> bool:
        """Tell whether it can be read, written or run."""
        node = self._nodes.GetNode(name)
        return bool(node is not None and _genicam().IsAvailable(node))

    def choices(self, name: str) -> tuple[str, ...]:
        """Return what can be set now."""
        return tuple(self._nodes.GetNode(name).GetSettableValues()) if self.has(name) else ()

    def text(self, name: str) -> str:
        """Return a feature as text."""
        return str(self._nodes.GetNode(name).ToString())

    def number(self, name: str) -> float:
        """Return a number."""
        return float(self._nodes.GetNode(name).GetValue())

    def flag(self, name: str) -> bool:
        """Tell whether something is on."""
        return bool(self._nodes.GetNode(name).GetValue())

    def bounds(self, name: str) -> tuple[float, float, float]:
        """Return smallest, largest and step."""
        node = self._nodes.GetNode(name)
        stepped = not hasattr(node, "HasInc") or node.HasInc()
        return float(node.GetMin()), float(node.GetMax()), float(node.GetInc()) if stepped else 0.0

    def unit(self, name: str) -> str:
        """Return the unit."""
        return str(self._nodes.GetNode(name).GetUnit())

    def set_text(self, name: str, value: str) -> None:
        """Set an enumeration or text."""
        self._nodes.GetNode(name).FromString(value)

    def set_number(self, name: str, value: float) -> None:
        """Set a number; integers refuse fractions of no value."""
        node = self._nodes.GetNode(name)
        node.SetValue(value if hasattr(node, "HasInc") else round(value))

    def set_flag(self, name: str, *, value: bool) -> None:
        """Switch something on or off."""
        self._nodes.GetNode(name).SetValue(value)

    def run(self, name: str) -> None:
        """Execute a command."""
        self._nodes.GetNode(name).Execute()


def _genicam() -> Any:
    return imported("pylon", "pypylon.genicam", "pylon")


def _library_errors() -> tuple[type[Exception], ...]:
    return (_genicam().GenericException,)


def _first_part(error: Exception) -> str:
    """Return what happened, without where in pylon."""
    return " ".join(str(error).split(" : ")[0].split()).rstrip(".")


def _clock_of(features: PylonFeatures, device_class: str) -> float | None:
    """Return the rate of a camera's clock in [Hz]; None if its frames have no time."""
    if features.has("GevTimestampTickFrequency"):
        return features.number("GevTimestampTickFrequency")
    return _TICKS_PER_S if device_class == _USB or features.has("TimestampLatch") else None


def _picture_size(folder: Path) -> tuple[int, int] | None:
    """Return width and height of the first picture in a folder."""
    for path in sorted(folder.glob("*")) if folder.is_dir() else ():
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if picture is not None:
            height_px, width_px = picture.shape[:2]
            return width_px, height_px
    return None


def search() -> tuple[FoundCamera, ...]:
    """Let pylon look for cameras on USB and, by broadcast, on every network."""
    return tuple(_found(told) for told in _enumerated() if told.GetDeviceClass() != _EMULATED)


def _enumerated() -> tuple[Any, ...]:
    pylon = imported("pylon", "pypylon.pylon", "pylon")
    return tuple(pylon.TlFactory.GetInstance().EnumerateDevices())


def _found(told: Any) -> FoundCamera:
    on_network = told.GetDeviceClass() == _NETWORK
    address = told.GetIpAddress() if on_network else ""
    return FoundCamera(
        "pylon",
        {"address": address} if on_network else {"serial": told.GetSerialNumber()},
        vendor=told.GetVendorName(),
        model=told.GetModelName(),
        serial=told.GetSerialNumber(),
        address=address,
    )


create_camera.search = search  # type: ignore[attr-defined]  # called by discovery
