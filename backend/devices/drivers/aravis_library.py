"""libaravis 0.8 through ctypes: the functions that the camera driver needs, with Python's errors.

ctypes needs neither a compiler nor GObject introspection, and runs with any CPython.
"""

import ctypes
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

LIBRARY = "libaravis-0.8.so.0"
INSTALL = "apt-get install libaravis-0.8-0"

_POINTER, _TEXT, _INT, _UINT, _BOOL = (
    ctypes.c_void_p,
    ctypes.c_char_p,
    ctypes.c_int,
    ctypes.c_uint,
    ctypes.c_int,
)
_LONG, _ULONG, _DOUBLE, _SIZE = ctypes.c_int64, ctypes.c_uint64, ctypes.c_double, ctypes.c_size_t


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", ctypes.c_char_p))


_ERROR = ctypes.POINTER(ctypes.POINTER(_GError))

CONTROL_LOST = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
"""Type of a callback for the signal `control-lost`: device, data."""


class AravisMissingError(Exception):
    """The library isn't installed."""


class AravisError(Exception):
    """A call failed; `domain` and `code` say how."""

    def __init__(self, domain: str, code: int, message: str) -> None:
        super().__init__(message)
        self.domain = domain
        self.code = code

    @property
    def is_timeout(self) -> bool:
        """The device doesn't answer."""
        return self.domain == "arv-device-error-quark" and self.code in (_TIMEOUT, _CANT_CONNECT)

    @property
    def is_refused_access(self) -> bool:
        """Somebody else controls the device."""
        return self.domain == "arv-device-error-quark" and self.code == _ACCESS_DENIED

    @property
    def is_locked(self) -> bool:
        """The device is busy."""
        return self.domain == "arv-device-error-quark" and self.code == _BUSY


_TIMEOUT, _CANT_CONNECT, _ACCESS_DENIED, _BUSY = 5, 6, 17, 18

_FAILING: dict[str, tuple[Any, tuple[Any, ...]]] = {
    # name: result, arguments without the error that all of them take last
    "arv_camera_new": (_POINTER, (_TEXT,)),
    "arv_camera_is_feature_available": (_BOOL, (_POINTER, _TEXT)),
    "arv_camera_get_string": (_TEXT, (_POINTER, _TEXT)),
    "arv_camera_set_string": (None, (_POINTER, _TEXT, _TEXT)),
    "arv_camera_get_integer": (_LONG, (_POINTER, _TEXT)),
    "arv_camera_set_integer": (None, (_POINTER, _TEXT, _LONG)),
    "arv_camera_get_float": (_DOUBLE, (_POINTER, _TEXT)),
    "arv_camera_set_float": (None, (_POINTER, _TEXT, _DOUBLE)),
    "arv_camera_get_float_bounds": (None, (_POINTER, _TEXT, ctypes.POINTER(_DOUBLE), ctypes.POINTER(_DOUBLE))),
    "arv_camera_get_float_increment": (_DOUBLE, (_POINTER, _TEXT)),
    "arv_camera_get_integer_bounds": (None, (_POINTER, _TEXT, ctypes.POINTER(_LONG), ctypes.POINTER(_LONG))),
    "arv_camera_get_integer_increment": (_LONG, (_POINTER, _TEXT)),
    "arv_camera_dup_available_enumerations_as_strings": (ctypes.POINTER(_TEXT), (_POINTER, _TEXT, ctypes.POINTER(_UINT))),
    "arv_camera_get_boolean": (_BOOL, (_POINTER, _TEXT)),
    "arv_camera_set_boolean": (None, (_POINTER, _TEXT, _BOOL)),
    "arv_camera_execute_command": (None, (_POINTER, _TEXT)),
    "arv_camera_get_payload": (_UINT, (_POINTER,)),
    "arv_camera_create_stream": (_POINTER, (_POINTER, _POINTER, _POINTER)),
    "arv_camera_start_acquisition": (None, (_POINTER,)),
    "arv_camera_stop_acquisition": (None, (_POINTER,)),
    "arv_camera_gv_set_packet_size": (None, (_POINTER, _INT)),
    "arv_camera_gv_get_packet_size": (_UINT, (_POINTER,)),
    "arv_camera_gv_auto_packet_size": (_UINT, (_POINTER,)),
}  # fmt: skip
_PLAIN: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (_UINT, ()),
    "arv_get_device_protocol": (_TEXT, (_UINT,)),
    "arv_get_device_address": (_TEXT, (_UINT,)),
    "arv_get_device_vendor": (_TEXT, (_UINT,)),
    "arv_get_device_model": (_TEXT, (_UINT,)),
    "arv_get_device_serial_nbr": (_TEXT, (_UINT,)),
    "arv_camera_get_device": (_POINTER, (_POINTER,)),
    "arv_camera_is_gv_device": (_BOOL, (_POINTER,)),
    "arv_camera_set_range_check_policy": (None, (_POINTER, _INT)),
    "arv_camera_gv_set_stream_options": (None, (_POINTER, _INT)),
    "arv_buffer_new_allocate": (_POINTER, (_SIZE,)),
    "arv_buffer_get_status": (_INT, (_POINTER,)),
    "arv_buffer_get_data": (_POINTER, (_POINTER, ctypes.POINTER(_SIZE))),
    "arv_buffer_get_timestamp": (_ULONG, (_POINTER,)),
    "arv_buffer_get_frame_id": (_ULONG, (_POINTER,)),
    "arv_buffer_get_image_width": (_INT, (_POINTER,)),
    "arv_buffer_get_image_height": (_INT, (_POINTER,)),
    "arv_stream_get_info_uint64_by_name": (_ULONG, (_POINTER, _TEXT)),
    "arv_stream_push_buffer": (None, (_POINTER, _POINTER)),
    "arv_stream_timeout_pop_buffer": (_POINTER, (_POINTER, _ULONG)),
    "arv_stream_try_pop_buffer": (_POINTER, (_POINTER,)),
    "arv_enable_interface": (None, (_TEXT,)),
    "arv_disable_interface": (None, (_TEXT,)),
    "g_object_unref": (None, (_POINTER,)),
    "g_error_free": (None, (ctypes.POINTER(_GError),)),
    "g_free": (None, (_POINTER,)),
    "g_quark_to_string": (_TEXT, (ctypes.c_uint32,)),
    "g_signal_connect_data": (_ULONG, (_POINTER, _TEXT, CONTROL_LOST, _POINTER, _POINTER, _INT)),
    "g_signal_handler_disconnect": (None, (_POINTER, _ULONG)),
}


class Aravis:
    """The library's functions: `call` for those that can fail, `plain` for the others."""

    def __init__(self) -> None:
        try:
            self._library = ctypes.CDLL(LIBRARY)
        except OSError as error:
            raise AravisMissingError(f"{LIBRARY} isn't installed; run: {INSTALL}") from error
        self.opening = threading.Lock()
        """Which interfaces are searched is one setting of the whole library."""
        for name, (result, arguments) in (*_FAILING.items(), *_PLAIN.items()):
            function = getattr(self._library, name)
            function.restype = result
            function.argtypes = (*arguments, _ERROR) if name in _FAILING else arguments

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function that may fail.

        Raises
        ------
        AravisError
            If it does.
        """
        error = ctypes.POINTER(_GError)()
        result = getattr(self._library, name)(*arguments, ctypes.byref(error))
        if error:
            raise self._taken(error)
        return result

    def plain(self, name: str, *arguments: Any) -> Any:
        """Call a function that can't fail."""
        return getattr(self._library, name)(*arguments)

    def set_number_property(self, instance: int, name: bytes, value: int) -> None:
        """Set a GObject property; the function takes any number of arguments, ended by nothing."""
        self._library.g_object_set(
            ctypes.c_void_p(instance), name, ctypes.c_int(value), ctypes.c_void_p(None)
        )

    def texts(self, name: str, *arguments: Any) -> tuple[str, ...]:
        """Call a function that returns an array of texts and their number."""
        count = _UINT()
        array = self.call(name, *arguments, ctypes.byref(count))
        found = tuple(array[i].decode() for i in range(count.value))
        self._library.g_free(ctypes.cast(array, _POINTER))
        return found

    def _taken(self, error: Any) -> AravisError:
        content = error.contents
        domain = self._library.g_quark_to_string(content.domain).decode()
        message = (content.message or b"").decode("utf-8", "replace")
        taken = AravisError(domain, int(content.code), message)
        self._library.g_error_free(error)
        return taken


@dataclass(frozen=True)
class Listed:
    """A device of the library's list."""

    protocol: str
    """GigEVision or USB3Vision."""
    address: str
    vendor: str
    model: str
    serial: str


def listed_devices() -> tuple[Listed, ...]:
    """Let the library look for devices. It broadcasts on every network: only on an operator's request."""
    library = aravis()
    with library.opening:
        library.plain("arv_update_device_list")
        count = int(library.plain("arv_get_n_devices"))
        return tuple(
            Listed(
                *(
                    (library.plain(f"arv_get_device_{what}", index) or b"").decode(
                        "utf-8", "replace"
                    )
                    for what in ("protocol", "address", "vendor", "model", "serial_nbr")
                )
            )
            for index in range(count)
        )


@lru_cache(maxsize=1)
def aravis() -> Aravis:
    """Load the library once.

    Raises
    ------
    AravisMissingError
        If it isn't installed; the sentence says how to.
    """
    return Aravis()


def on_control_lost(device: int, tell: Callable[[], None]) -> tuple[int, Any]:
    """Be told when control of a device is lost.

    Returns the handler's number and the callback, which the caller keeps as long as the device lives:
    C holds no reference to it.
    """

    def lost(_device: int | None, _data: int | None) -> None:
        tell()

    callback = CONTROL_LOST(lost)
    handler = aravis().plain(
        "g_signal_connect_data", device, b"control-lost", callback, None, None, 0
    )
    return int(handler), callback
