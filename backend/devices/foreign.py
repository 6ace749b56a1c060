"""Devices of packages from outside: what they make of the protocols is looked at before anybody relies on it."""

import inspect
import logging
from collections.abc import Iterator
from contextlib import contextmanager

from backend.devices.errors import DriverFailed
from backend.devices.protocols import (
    Camera,
    CameraCapabilities,
    CameraSettings,
    Device,
    DeviceInfo,
    Frame,
    LinkState,
    ProjectorCapabilities,
)
from backend.domain.errors import UnglareError

log = logging.getLogger(__name__)

_OURS = "backend."


def misfit(made: object, protocol: type) -> str:
    """Say which part of a device can't be used as its protocol says; empty if all can. Nothing is called."""
    for name, wanted in inspect.getmembers_static(protocol):
        if name.startswith("_"):
            continue
        has = inspect.getattr_static(made, name, None)
        if isinstance(wanted, property):
            if inspect.isfunction(has):
                return f"{name} is a method, not a property"
        elif inspect.isfunction(wanted):
            problem = _call_problem(getattr(made, name, None), wanted)
            if problem:
                return f"{name} {problem}"
    return ""


def _call_problem(method: object, wanted: object) -> str:
    if not callable(method):
        return "can't be called"
    assert inspect.isfunction(wanted)
    try:
        signature = inspect.signature(method)
    except (TypeError, ValueError):  # compiled code doesn't tell
        return ""
    parameters = list(inspect.signature(wanted).parameters)[1:]
    try:
        signature.bind(*parameters)
    except TypeError:
        return f"doesn't take ({', '.join(parameters)})"
    return ""


def refuse_other_types(device: Device) -> None:
    """Refuse what an opened device says of itself if it isn't what its protocol says.

    Raises
    ------
    DriverFailed
        Naming the first.
    """
    camera = isinstance(device, Camera)
    expected: dict[str, type] = {
        "info": DeviceInfo,
        "state": LinkState,
        "capabilities": CameraCapabilities if camera else ProjectorCapabilities,
    }
    if camera:
        expected["settings"] = CameraSettings
    for name, kind in expected.items():
        found = getattr(device, name)
        if not isinstance(found, kind):
            raise DriverFailed(
                device.name,
                f"its driver's {name} is a {type(found).__name__}, not a {kind.__name__}; mend or update the driver",
            )


def refuse_other_frame(camera: str, frame: object) -> None:
    """Refuse what `get_frame` returned if it is no frame.

    Raises
    ------
    DriverFailed
        Naming the camera.
    """
    if not isinstance(frame, Frame):
        raise DriverFailed(
            camera,
            f"its driver's get_frame returned a {type(frame).__name__}, not a Frame; mend or update the driver",
        )


@contextmanager
def named(device: Device, doing: str) -> Iterator[None]:
    """Make whatever a driver from outside raises in this block a sentence with its device's name.

    Raises
    ------
    DriverFailed
        In place of what isn't an expected error. Of our own drivers that is a defect, and stays one.
    """
    try:
        yield
    except UnglareError:
        raise
    except Exception as error:
        if is_ours(device):
            raise
        raise failure(device.name, doing, error) from error


def is_ours(device: object) -> bool:
    """Tell whether a device's driver is one of the application's own."""
    return type(device).__module__.startswith(_OURS)


def failure(device: str, doing: str, error: BaseException) -> DriverFailed:
    """Say that a driver from outside failed; its traceback goes to the log."""
    log.error("The driver of %s failed in %s.", device, doing, exc_info=error)
    words = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".: ")
    return DriverFailed(
        device,
        f"its driver failed in {doing} with {words}; see the log, and try it by `unglare rigs conform`",
    )
