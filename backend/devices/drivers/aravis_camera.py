"""GigE Vision and USB3 Vision cameras through Aravis.

A camera is opened by its address, which is asked by unicast, or by the serial number of a USB3 Vision camera.
Nothing is ever broadcast here: that is discovery, and only done when an operator asks for it.
"""

import ctypes
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16
from pydantic import model_validator

from backend.devices.drivers.aravis_library import (
    Aravis,
    AravisError,
    AravisMissingError,
    aravis,
    listed_devices,
    on_control_lost,
)
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
    UnsupportedFeature,
)
from backend.devices.found import FoundCamera
from backend.devices.frame_counting import FrameCounter
from backend.devices.link import Link
from backend.devices.options import DeviceOptions, SerialNumber, read_options
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
    LinkState,
    Range,
    TriggerSource,
)
from backend.devices.refusals import refuse_impossible, refuse_locked, refuse_trigger

_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
_SLICE_S = 0.1
"""How long a wait lasts before `abort` and a lost device are noticed."""
_SOCKET_BUFFER_BYTES = 8 << 20
"""Aravis leaves it at the kernel's default, in which a burst of packets doesn't find room."""
_FEWEST_BUFFERS = 4
_SUCCESS, _TIMED_OUT = 0, 2  # states of a buffer
_RANGE_CHECKED = 1
_ORDINARY_SOCKET = 1
_HEARTBEAT_S = 3.0
"""So long a dead client keeps control of a camera."""
_READOUT_MARGIN_S = 0.004
_EXPOSURE_NAMES = ("ExposureTime", "ExposureTimeAbs")
_GAIN_NAMES = ("Gain", "GainAbs")
"""In dB; a raw gain has steps of its own and stays as it is."""


_UNKNOWN = CameraCapabilities((0, 0), (), Range(0, 0), Range(0, 0), ())
"""Before a camera was opened: it can't be set to anything."""


class AravisOptions(DeviceOptions):
    """How a camera is found and connected; one of address and serial."""

    address: str = ""
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


def create_camera(name: str, options: Mapping[str, Any]) -> "AravisCamera":
    """Make a camera of a rig file's entry."""
    return AravisCamera(name, read_options(AravisOptions, name, options))


create_camera.options_model = AravisOptions  # type: ignore[attr-defined]  # read by driver_loading


class AravisCamera(Link):
    """A `Camera`. One thread at a time, except for `abort` and `state`."""

    def __init__(self, name: str, options: AravisOptions) -> None:
        where = options.address or options.serial
        super().__init__(name, DeviceInfo("", "", options.serial, driver="aravis", address=where))
        self._options = options
        self._camera = _Handle()
        self._stream = _Handle()
        self._lost_callback: object = None
        self._aborted = threading.Event()
        self._stopping = threading.Lock()
        """`abort` may come from any thread, also while the camera is given back."""
        self._capabilities = _UNKNOWN
        self._settings = CameraSettings(0.0)
        self._wanted: CameraSettings | None = None
        self._buffers = 0
        self._free_at_s = 0.0
        self._due_at_s = 0.0
        self._counter = FrameCounter()

    # ------------------------------------------------------------ life

    def open(self) -> None:
        """Take control."""
        if self._state in (LinkState.READY, LinkState.ARMED):
            return
        library = self._library()
        self._drop()  # what a lost connection left behind
        self._camera.value = self._connected(library)
        try:
            library.plain("arv_camera_set_range_check_policy", self._camera.value, _RANGE_CHECKED)
            self._watch(library)
            self._info = self._read_info()
            self._capabilities = self._read_capabilities()
            self._prepare_trigger()
            self._settings = self._read_settings()
            self._set_packet_size(library)
        except AravisError as error:
            self._drop()
            raise self._translated(error, "opening") from error
        except BaseException:
            self._drop()
            raise
        self._state = LinkState.READY

    def close(self) -> None:
        """Give the camera back; whoever waits for a frame stops waiting."""
        self._aborted.set()
        with suppress(DeviceError):  # a camera that is gone streams no more either
            self.disarm()
        self._drop()
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Open again, with the settings of before; a former owner's heartbeat may have to end first."""
        wanted = self._wanted
        patience_s = max(timeout_s, 2 * _HEARTBEAT_S)
        deadline_s = time.monotonic() + patience_s
        while True:
            self.close()
            try:
                self.open()
                break
            except (DeviceBusy, DeviceNotFound, DeviceTimeout, DeviceDisconnected) as error:
                if time.monotonic() > deadline_s:
                    raise self._lose(
                        f"doesn't come back within {patience_s:g} s ({error})"
                    ) from error
                time.sleep(0.25)
        if wanted is not None:
            self.configure(wanted)

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
        where = self._options.address or f"serial number {self._options.serial}"
        if error is not None and error.is_refused_access:
            return DeviceBusy(
                self.name, f"another program controls the camera at {where}; close it there"
            )
        return DeviceNotFound(
            self.name, f"no camera answers at {where}; check cable, power and the rig's file"
        )

    def _watch(self, library: Aravis) -> None:
        device = library.plain("arv_camera_get_device", self._camera.value)
        _, self._lost_callback = on_control_lost(device, self._note_loss)

    def _note_loss(self) -> None:
        """Notice, on a thread of Aravis, that control is gone."""
        if self._state in (LinkState.READY, LinkState.ARMED):
            self._state = LinkState.LOST

    def _drop(self) -> None:
        with self._stopping:
            for handle in (self._stream, self._camera):
                if handle.value:
                    aravis().plain("g_object_unref", handle.value)
                    handle.value = 0
        self._buffers = 0

    # ------------------------------------------------------------ what it is

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can be set to."""
        return self._capabilities

    @property
    def settings(self) -> CameraSettings:
        """The settings as read back."""
        return self._settings

    def _read_info(self) -> DeviceInfo:
        options = self._options
        texts = {n: self._text(n) for n in ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber", "DeviceVersion")}  # fmt: skip
        return DeviceInfo(
            vendor=texts["DeviceVendorName"],
            model=texts["DeviceModelName"],
            serial=texts["DeviceSerialNumber"],
            firmware=texts["DeviceVersion"],
            driver="aravis 0.8",
            address=options.address,
        )

    def _text(self, feature: str) -> str:
        if not self._has(feature):
            return ""
        value = self._call("arv_camera_get_string", feature.encode())
        return value.decode("utf-8", "replace") if value else ""

    def _read_capabilities(self) -> CameraCapabilities:
        formats = tuple(f for f in self._choices("PixelFormat") if f in _BITS)
        if not formats:
            raise UnsupportedFeature(
                self.name, f"none of its pixel formats is one of {', '.join(_BITS)}; a monochrome camera is needed"
            )  # fmt: skip
        known = {source.value for source in TriggerSource}
        sources = tuple(TriggerSource(s) for s in self._choices("TriggerSource") if s in known)
        size = tuple(int(self._call("arv_camera_get_integer", n)) for n in (b"Width", b"Height"))
        return CameraCapabilities(
            sensor_size=(size[0], size[1]),
            pixel_formats=formats,
            exposure_us=self._range(self._exposure_name(), "us"),
            gain_db=self._range(self._gain_name(), "dB")
            if self._gain_name()
            else Range(0, 0, 0, "dB"),
            trigger_sources=sources,
            hardware_timestamp=True,
            min_frame_period_s=_READOUT_MARGIN_S,
        )

    def _range(self, feature: str, unit: str) -> Range:
        low, high = ctypes.c_double(), ctypes.c_double()
        self._call(
            "arv_camera_get_float_bounds", feature.encode(), ctypes.byref(low), ctypes.byref(high)
        )
        return Range(low.value, high.value, 0.0, unit)

    def _exposure_name(self) -> str:
        return next((n for n in _EXPOSURE_NAMES if self._has(n)), _EXPOSURE_NAMES[0])

    def _gain_name(self) -> str:
        return next((n for n in _GAIN_NAMES if self._has(n)), "")

    def _has(self, feature: str) -> bool:
        return bool(self._call("arv_camera_is_feature_available", feature.encode()))

    def _choices(self, feature: str) -> tuple[str, ...]:
        if not self._has(feature):
            return ()
        name = "arv_camera_dup_available_enumerations_as_strings"
        return aravis().texts(name, self._camera.value, feature.encode())

    def _prepare_trigger(self) -> None:
        """Let every frame wait for a trigger; whatever else was set before us is overruled."""
        for feature, value in (
            ("AcquisitionMode", "Continuous"), ("TriggerSelector", "FrameStart"), ("TriggerMode", "On"),
            ("TriggerActivation", "RisingEdge"), ("ExposureAuto", "Off"), ("GainAuto", "Off"),
        ):  # fmt: skip
            if value in self._choices(feature):
                self._call("arv_camera_set_string", feature.encode(), value.encode())

    def _set_packet_size(self, library: Aravis) -> None:
        if not library.plain("arv_camera_is_gv_device", self._camera.value):
            return
        # An ordinary socket is bound before the first trigger, so that nothing is lost while the receiving
        # thread starts; and it is the same one with and without privileges.
        library.plain("arv_camera_gv_set_stream_options", self._camera.value, _ORDINARY_SOCKET)
        if self._options.packet_bytes is None:
            self._call("arv_camera_gv_auto_packet_size")
        else:
            self._call("arv_camera_gv_set_packet_size", self._options.packet_bytes)

    # ------------------------------------------------------------ settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Check everything, then apply what changes, then read back."""
        self._need_link()
        refuse_impossible(self.name, settings, self.capabilities)
        wanted = replace(
            settings, pixel_format=settings.pixel_format or self._settings.pixel_format
        )
        if self._state is LinkState.ARMED:
            refuse_locked(self.name, self._settings, wanted)
        try:
            self._apply(wanted)
            self._settings = self._read_settings()
        except AravisError as error:
            raise self._translated(error, "setting up") from error
        self._wanted = self._settings
        return self._settings

    def _apply(self, wanted: CameraSettings) -> None:
        now = self._settings
        if wanted.pixel_format != now.pixel_format:
            assert wanted.pixel_format is not None, "replaced by the camera's own"
            self._call("arv_camera_set_string", b"PixelFormat", wanted.pixel_format.encode())
        if wanted.trigger is not now.trigger:
            self._call("arv_camera_set_string", b"TriggerSource", wanted.trigger.value.encode())
        if wanted.exposure_us != now.exposure_us:
            self._call("arv_camera_set_float", self._exposure_name().encode(), wanted.exposure_us)
        if wanted.gain_db != now.gain_db:
            self._call("arv_camera_set_float", self._gain_name().encode(), wanted.gain_db)

    def _read_settings(self) -> CameraSettings:
        source = self._text("TriggerSource")
        gain = self._gain_name()
        return CameraSettings(
            exposure_us=float(self._call("arv_camera_get_float", self._exposure_name().encode())),
            gain_db=float(self._call("arv_camera_get_float", gain.encode())) if gain else 0.0,
            pixel_format=self._text("PixelFormat"),
            trigger=TriggerSource(source)
            if source in set(TriggerSource)
            else TriggerSource.SOFTWARE,
        )

    # ------------------------------------------------------------ frames

    def arm(self, n_frames: int | None = None) -> None:
        """Provide buffers and start acquisition."""
        self._need_link()
        if self._state is LinkState.ARMED:
            self.disarm()
        self._aborted.clear()
        try:
            payload = int(self._call("arv_camera_get_payload"))
            self._provide_buffers(payload, max(_FEWEST_BUFFERS, (n_frames or 0) + 2))
            self._call("arv_camera_start_acquisition")
        except AravisError as error:
            raise self._translated(error, "arming") from error
        self._free_at_s = self._due_at_s = 0.0
        self._state = LinkState.ARMED

    def _provide_buffers(self, payload: int, count: int) -> None:
        """Make a stream with fresh buffers: whatever was left over goes with the old one."""
        library = aravis()
        if self._stream.value:
            library.plain("g_object_unref", self._stream.value)
            self._stream.value = 0
        stream = library.call("arv_camera_create_stream", self._camera.value, None, None)
        if not stream:
            raise AravisError("arv-device-error-quark", 0, "no stream was made")
        self._stream.value = int(stream)
        if library.plain("arv_camera_is_gv_device", self._camera.value):
            library.set_number_property(
                self._stream.value, b"socket-buffer-size", _SOCKET_BUFFER_BYTES
            )
        for _ in range(count):
            buffer = library.plain("arv_buffer_new_allocate", payload)
            library.plain("arv_stream_push_buffer", self._stream.value, buffer)
        self._buffers = count
        self._counter.restart()

    def trigger(self) -> None:
        """Wait until the last exposure has ended, then start one."""
        self._need_link()
        refuse_trigger(self.name, self._settings, armed=self._state is LinkState.ARMED)
        self._aborted.wait(max(0.0, self._free_at_s - time.monotonic()))
        try:
            self._call("arv_camera_execute_command", b"TriggerSoftware")
        except AravisError as error:
            raise self._translated(error, "the trigger") from error
        self._due_at_s = time.monotonic() + self._settings.exposure_us * 1e-6
        self._free_at_s = self._due_at_s + self.capabilities.min_frame_period_s

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        """Fetch the oldest frame."""
        self._need_link()
        deadline_s = max(self._due_at_s, time.monotonic()) + timeout_s
        while True:
            if self._aborted.is_set():
                raise DeviceTimeout(self.name, "waiting for a frame was aborted; arm again")
            if self._state is LinkState.LOST:
                raise self._lose("control was lost")
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise DeviceTimeout(
                    self.name, f"no frame came within {timeout_s:g} s; trigger one, or check the line"
                )  # fmt: skip
            buffer = self._popped(min(left_s, _SLICE_S))
            if buffer:
                return self._taken(buffer)

    def _popped(self, wait_s: float) -> int:
        if not self._stream.value:
            self._aborted.wait(wait_s)  # never armed: nothing comes
            return 0
        slice_us = max(1, int(wait_s * 1e6))
        buffer = aravis().plain("arv_stream_timeout_pop_buffer", self._stream.value, slice_us)
        return int(buffer or 0)

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
                raise IncompleteFrame(
                    self.name, f"frame {number} {what} (status {status}); take it again"
                )
            return self._frame(buffer, number)
        finally:
            library.plain("arv_stream_push_buffer", self._stream.value, buffer)

    def _frame(self, buffer: int, number: int) -> Frame:
        library, settings = aravis(), self._settings
        pixel_format = settings.pixel_format or "Mono8"
        width_px, height_px = (
            int(library.plain(f"arv_buffer_get_image_{n}", buffer)) for n in ("width", "height")
        )
        data = _pixels(buffer, height_px, width_px, pixel_format)
        if data is None:
            raise IncompleteFrame(
                self.name, f"frame {number} is too short for {width_px}x{height_px} {pixel_format}; take it again"
            )  # fmt: skip
        return Frame(
            data=data,
            pixel_format=pixel_format,
            bits=_BITS[pixel_format],
            frame_id=number,
            exposure_us=settings.exposure_us,
            gain_db=settings.gain_db,
            timestamp_s=int(library.plain("arv_buffer_get_timestamp", buffer)) * 1e-9,
            host_time_s=time.monotonic(),
        )

    def disarm(self) -> None:
        """Stop acquisition."""
        with self._stopping:
            if self._state is not LinkState.ARMED:
                return
            self._state = LinkState.READY
            try:
                self._call("arv_camera_stop_acquisition")
            except AravisError as error:
                raise self._translated(error, "disarming") from error

    def abort(self) -> None:
        """Stop waiting; acquisition is ended by whoever waits or arms next. Thread-safe."""
        self._aborted.set()
        self.disarm()

    # ------------------------------------------------------------ errors

    def _call(self, name: str, *arguments: object) -> Any:
        return aravis().call(name, self._camera.value, *arguments)

    def _translated(self, error: AravisError, doing: str) -> DeviceError:
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


class _Handle:
    """A GObject's address, 0 when there is none."""

    def __init__(self) -> None:
        self.value = 0


def _pixels(
    buffer: int, height_px: int, width_px: int, pixel_format: str
) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | None:
    """Copy the pixels out of a buffer; None if it holds fewer."""
    size = ctypes.c_size_t()
    address = aravis().plain("arv_buffer_get_data", buffer, ctypes.byref(size))
    dtype = np.dtype(np.uint8) if pixel_format == "Mono8" else np.dtype("<u2")
    count_bytes = height_px * width_px * dtype.itemsize
    if not address or size.value < count_bytes:
        return None
    data = ctypes.string_at(address, count_bytes)
    return np.frombuffer(bytearray(data), dtype).reshape(height_px, width_px)


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
