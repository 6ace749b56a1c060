"""GigE Vision and USB3 Vision cameras through Aravis.

A camera is opened by its address, which is asked by unicast, or by the serial number of a USB3 Vision camera.
Nothing is ever broadcast here but by `search`: that is discovery, and only done when an operator asks for it.
"""

import ctypes
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt8
from pydantic import model_validator

from backend.devices.drivers import gige_link
from backend.devices.drivers.aravis_library import (
    Aravis,
    AravisError,
    AravisMissingError,
    aravis,
    listed_devices,
    on_control_lost,
)
from backend.devices.drivers.sfnc import SfncOptions, bits_of, gray_of
from backend.devices.drivers.sfnc_camera import SfncCamera
from backend.devices.errors import (
    DeviceBusy,
    DeviceError,
    DeviceNotFound,
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
    LinkState,
    TriggerSource,
)

_RETENTION_US = 400_000
"""How long a frame waits for packets: Aravis' 100 ms are too few for a machine that is busy."""
_FEWEST_BUFFERS = 4
_SUCCESS, _TIMED_OUT = 0, 2  # states of a buffer
_RANGE_CHECKED = 1
_ORDINARY_SOCKET = 1


class AravisOptions(SfncOptions):
    """How a camera is found and connected; one of address and serial."""

    address: SingleAddress = ""
    """IPv4 address of a GigE Vision camera."""
    serial: SerialNumber = ""
    """Serial number of a USB3 Vision camera."""
    packet_bytes: int | None = None
    """Size of stream packets; None: the largest that gets through, found by test packets."""

    @model_validator(mode="after")
    def _findable(self) -> "AravisOptions":
        if bool(self.address) == bool(self.serial):
            raise ValueError(
                "give either the address of a GigE Vision camera or the serial of a USB3 Vision one"
            )
        return self


def _library() -> None:
    try:
        aravis()
    except AravisMissingError as error:
        raise DeviceNotFound("aravis", str(error)) from error


@takes(AravisOptions, library=_library)
def create_camera(name: str, options: Mapping[str, Any]) -> "AravisCamera":
    """Make a camera of a rig file's entry."""
    return AravisCamera(name, read_options(AravisOptions, name, options))


class AravisCamera(SfncCamera):
    """A `Camera`. One thread at a time, except for `abort` and `state`."""

    def __init__(self, name: str, options: AravisOptions) -> None:
        where = options.address or options.serial
        info = DeviceInfo("", "", options.serial, driver="aravis", address=where)
        super().__init__(name, info, options, fewest_buffers=_FEWEST_BUFFERS)
        self._options = options
        self._camera = 0
        self._stream = 0
        """Addresses of GObjects; 0: there is none."""
        self._lost_callback: object = None
        self._counter = FrameCounter()
        self._whole_frames = self._broken_frames = 0
        """Since acquisition was started."""

    # ------------------------------------------------------------ life

    def _connect(self) -> tuple[DeviceInfo, CameraCapabilities, CameraSettings]:
        library = self._library()
        self._camera = self._connected(library)
        library.plain("arv_camera_set_range_check_policy", self._camera, _RANGE_CHECKED)
        device = library.plain("arv_camera_get_device", self._camera)
        _, self._lost_callback = on_control_lost(device, self._note_loss)
        features = AravisFeatures(self._camera)
        self._prepare(features, hardware_timestamp=True)
        self._set_packet_size(library)
        self._remarks = (*self._remarks, *self._small_buffer())
        return self._who(features), self._controls.capabilities(), self._controls.read()

    def _library(self) -> Aravis:
        try:
            return aravis()
        except AravisMissingError as error:
            raise DeviceNotFound(self.name, str(error)) from error

    def _connected(self, library: Aravis) -> int:
        """Open by address; by serial number among USB cameras only, as GigE Vision would be searched by broadcast."""
        options = self._options
        with library.opening:
            if not options.address:
                library.plain("arv_disable_interface", b"GigEVision")
            try:
                camera = library.call(
                    "arv_camera_new", (options.address or options.serial).encode()
                )
            except AravisError as error:
                raise self._not_opened(error) from error
            finally:
                library.plain("arv_enable_interface", b"GigEVision")
        if not camera:
            raise self._not_opened(None)
        return int(camera)

    def _not_opened(self, error: AravisError | None) -> DeviceError:
        address, serial = self._options.address, self._options.serial
        where = f"at {address}" if address else f"with serial number {serial}"
        if error is not None and error.is_refused_access:
            return DeviceBusy(
                self.name, f"another program controls the camera {where}; close it there"
            )
        cure = "check cable, power and the rig's file"
        if address:
            elsewhere = gige_link.wrong_network(address, gige_link.content_of(gige_link.ROUTES))
            cure = elsewhere or cure
        return DeviceNotFound(self.name, f"no camera answers {where}; {cure}")

    def _note_loss(self) -> None:
        """Notice, on a thread of Aravis, that control is gone."""
        if self._state in (LinkState.READY, LinkState.ARMED):
            self._state = LinkState.LOST

    def _disconnect(self) -> None:
        for handle in (self._stream, self._camera):
            if handle:
                aravis().plain("g_object_unref", handle)
        self._stream = self._camera = 0

    def _who(self, features: "AravisFeatures") -> DeviceInfo:
        vendor, model, serial, firmware = (
            features.text(name) if features.has(name) else ""
            for name in ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber", "DeviceVersion")
        )  # fmt: skip
        return DeviceInfo(
            vendor=vendor,
            model=model,
            serial=serial,
            firmware=firmware,
            driver="aravis 0.8",
            address=self._options.address,
        )

    def _set_packet_size(self, library: Aravis) -> None:
        if not library.plain("arv_camera_is_gv_device", self._camera):
            return
        # An ordinary socket is bound before the first trigger, so that nothing is lost while the receiving
        # thread starts; and it is the same one with and without privileges.
        library.plain("arv_camera_gv_set_stream_options", self._camera, _ORDINARY_SOCKET)
        if self._options.packet_bytes is None:
            self._call("arv_camera_gv_auto_packet_size")
        else:
            self._call("arv_camera_gv_set_packet_size", self._options.packet_bytes)

    def _small_buffer(self) -> Iterator[str]:
        """Say that the computer's receive buffers are too small for a frame."""
        allowed = gige_link.content_of(gige_link.LARGEST_BUFFER).strip()
        if self._options.address and allowed.isdecimal():
            payload = int(self._call("arv_camera_get_payload"))
            problem = gige_link.small_buffer(payload, int(allowed))
            if problem:
                yield f"{self.name}: {problem}."

    # ------------------------------------------------------------ settings and frames

    def _start(self, n_frames: int | None) -> None:
        payload = int(self._call("arv_camera_get_payload"))
        self._provide_buffers(payload, self._buffers_for(n_frames))
        self._call("arv_camera_start_acquisition")

    def _provide_buffers(self, payload: int, count: int) -> None:
        """Make a stream with fresh buffers: whatever was left over goes with the old one."""
        library = aravis()
        if self._stream:
            library.plain("g_object_unref", self._stream)
            self._stream = 0
        stream = library.call("arv_camera_create_stream", self._camera, None, None)
        if not stream:
            raise AravisError("arv-device-error-quark", 0, "no stream was made")
        self._stream = int(stream)
        if library.plain("arv_camera_is_gv_device", self._camera):
            library.set_number_property(
                self._stream, b"socket-buffer-size", gige_link.WANTED_BUFFER_BYTES
            )
            library.set_number_property(self._stream, b"frame-retention", _RETENTION_US)
        for _ in range(count):
            buffer = library.plain("arv_buffer_new_allocate", payload)
            library.plain("arv_stream_push_buffer", self._stream, buffer)
        self._counter.restart()
        self._whole_frames = self._broken_frames = 0

    @property
    def _cure(self) -> str:
        """What to do when no frame comes."""
        waits_for_line = self._settings.trigger not in (
            TriggerSource.SOFTWARE,
            TriggerSource.FREE_RUN,
        )
        fired = self._due_at_s > 0 or self._settings.trigger is TriggerSource.FREE_RUN
        if waits_for_line or not fired:
            return super()._cure
        # A camera that is gone says so here; one that is aborted meanwhile has no stream any more.
        with self._calling, self._doing("asking why no picture comes"):
            return self._stream_trouble() or super()._cure

    def _stream_trouble(self) -> str:
        """Say what is known of a stream that brings no picture; empty: nothing, or it isn't on a network."""
        library = aravis()
        if not (self._options.address and self._stream):
            return ""
        packets = library.plain(
            "arv_stream_get_info_uint64_by_name", self._stream, b"n_received_packets"
        )
        counts = gige_link.StreamCounts(int(packets), self._whole_frames, self._broken_frames)
        packet_bytes = int(self._call("arv_camera_gv_get_packet_size"))
        return gige_link.stream_trouble(counts, packet_bytes, self._options.address)

    def _stop(self) -> None:
        self._call("arv_camera_stop_acquisition")

    def _fire(self) -> None:
        self._call("arv_camera_execute_command", b"TriggerSoftware")

    def _next(self, wait_s: float) -> Frame | None:
        slice_us = max(1, int(wait_s * 1e6))
        buffer = aravis().plain("arv_stream_timeout_pop_buffer", self._stream, slice_us)
        return self._taken(int(buffer)) if buffer else None

    def _taken(self, buffer: int) -> Frame:
        """Copy a frame out of its buffer and give the buffer back."""
        library = aravis()
        try:
            status = library.plain("arv_buffer_get_status", buffer)
            number = self._counter.count(int(library.plain("arv_buffer_get_frame_id", buffer)))
            if status != _SUCCESS:
                what = (
                    "didn't arrive in time"
                    if status == _TIMED_OUT
                    else "arrived with packets missing"
                )
                self._broken_frames += 1
                cure = self._stream_trouble() or "take it again"
                raise IncompleteFrame(self.name, f"frame {number} {what} (status {status}); {cure}")
            self._whole_frames += 1
            return self._frame(buffer, number)
        finally:
            library.plain("arv_stream_push_buffer", self._stream, buffer)

    def _frame(self, buffer: int, number: int) -> Frame:
        library, pixel_format = aravis(), self._settings.pixel_format or "Mono8"
        width_px, height_px = (
            int(library.plain(f"arv_buffer_get_image_{n}", buffer)) for n in ("width", "height")
        )
        bits = bits_of(pixel_format)
        content = _content(buffer)
        samples = content if bits == 8 else content[: content.size // 2 * 2].view("<u2")
        wanted_px = self.capabilities.sensor_size
        data = gray_of(samples, *wanted_px, pixel_format)
        if data is None or (width_px, height_px) != wanted_px:
            raise IncompleteFrame(
                self.name,
                f"frame {number} is {width_px}x{height_px}, not {wanted_px[0]}x{wanted_px[1]} {pixel_format}; take it again",
            )
        at_s = int(library.plain("arv_buffer_get_timestamp", buffer)) * 1e-9
        return self._told(data, number, at_s, bits)

    # ------------------------------------------------------------ errors

    def _call(self, name: str, *arguments: object) -> Any:
        return aravis().call(name, self._camera, *arguments)

    def _translated(self, error: Exception, doing: str) -> DeviceError | None:
        if not isinstance(error, AravisError):
            return None
        if error.is_refused_access:
            self._state = LinkState.LOST
            return DeviceBusy(
                self.name, f"another program controls it ({doing}: {error}); close it there"
            )
        if error.is_timeout:
            return self._lose(f"doesn't answer ({doing})")
        if error.is_locked:
            return FeatureError(self.name, f"is busy ({doing}: {error}); disarm first")
        return FeatureError(self.name, f"refused {doing}: {error}; choose another value")


class AravisFeatures:
    """The `Features` of a camera that Aravis opened."""

    def __init__(self, camera: int) -> None:
        self._camera = camera

    def has(self, name: str) -> bool:
        """Tell whether it is available."""
        return bool(self._call("arv_camera_is_feature_available", name))

    def choices(self, name: str) -> tuple[str, ...]:
        """Return what can be set now."""
        if not self.has(name):
            return ()
        function = "arv_camera_dup_available_enumerations_as_strings"
        return aravis().texts(function, self._camera, name.encode())

    def text(self, name: str) -> str:
        """Return a feature as text."""
        value = self._call("arv_camera_get_string", name)
        return value.decode("utf-8", "replace") if value else ""

    def number(self, name: str) -> float:
        """Return a number."""
        return float(self._call(f"arv_camera_get_{_kind(name)}", name))

    def flag(self, name: str) -> bool:
        """Tell whether something is on."""
        return bool(self._call("arv_camera_get_boolean", name))

    def bounds(self, name: str) -> tuple[float, float, float]:
        """Return smallest, largest and step; Aravis knows the steps of whole numbers only for sure."""
        whole = _kind(name) == "integer"
        low, high = (ctypes.c_int64() if whole else ctypes.c_double() for _ in range(2))
        limits = ctypes.byref(low), ctypes.byref(high)
        self._call(f"arv_camera_get_{_kind(name)}_bounds", name, *limits)
        step = self._call("arv_camera_get_integer_increment", name) if whole else 0.0
        return float(low.value), float(high.value), float(step)

    def unit(self, name: str) -> str:
        """Return nothing: Aravis doesn't tell it."""
        del name
        return ""

    def set_text(self, name: str, value: str) -> None:
        """Set an enumeration."""
        self._call("arv_camera_set_string", name, value.encode())

    def set_number(self, name: str, value: float) -> None:
        """Set a number."""
        kind = _kind(name)
        self._call(f"arv_camera_set_{kind}", name, round(value) if kind == "integer" else value)

    def set_flag(self, name: str, *, value: bool) -> None:
        """Switch something on or off."""
        self._call("arv_camera_set_boolean", name, int(value))

    def run(self, name: str) -> None:
        """Execute a command."""
        self._call("arv_camera_execute_command", name)

    def _call(self, function: str, feature: str, *arguments: object) -> Any:
        return aravis().call(function, self._camera, feature.encode(), *arguments)


def _kind(feature: str) -> str:
    """Return how Aravis reads a number: by its type, which it doesn't tell."""
    return "integer" if feature in _WHOLE else "float"


_WHOLE = {
    *(
        "Width",
        "Height",
        "OffsetX",
        "OffsetY",
        "GainRaw",
        "DigitalShift",
        "DeviceLinkThroughputLimit",
    ),
    *("BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical"),
}


def _content(buffer: int) -> UInt8[np.ndarray, "n"]:
    """Return the bytes of a buffer, which the library goes on using: copy what is to stay."""
    size = ctypes.c_size_t()
    address = aravis().plain("arv_buffer_get_data", buffer, ctypes.byref(size))
    if not address:
        return np.zeros(0, np.uint8)
    content = ctypes.cast(address, ctypes.POINTER(ctypes.c_uint8))
    return np.ctypeslib.as_array(content, (size.value,))


def search() -> tuple[FoundCamera, ...]:
    """Let Aravis look for cameras on USB and, by broadcast, on every network."""
    try:
        listed = listed_devices()
    except AravisMissingError as error:
        raise DeviceNotFound("aravis", str(error)) from error
    return tuple(
        FoundCamera(
            "aravis",
            {"address": one.address} if one.protocol == "GigEVision" else {"serial": one.serial},
            vendor=one.vendor,
            model=one.model,
            serial=one.serial,
            address=one.address if one.protocol == "GigEVision" else "",
        )
        for one in listed
    )


create_camera.search = search  # type: ignore[attr-defined]  # called by discovery
