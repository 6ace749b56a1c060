"""What a device refuses or fails at: one sentence with the device's name, the value and the way out."""

# ruff: noqa: N818 - DeviceBusy, DeviceTimeout and so on say it; those are the names drivers use elsewhere too

from backend.domain.errors import InvalidSettingError, NotFoundError, UnglareError


class DeviceError(UnglareError):
    """A device can't do what it was asked; the sentence starts with its name.

    Parameters
    ----------
    device
        Name of the device as the rig knows it, e.g. `left`.
    problem
        The rest of the sentence: what, which value, what to do.
    """

    status = 502
    retryable = False
    """Whether taking the same shot again may help, without anybody touching the rig."""

    def __init__(self, device: str, problem: str) -> None:
        super().__init__(f"{device}: {problem}", details={"device": device})
        self.device = device


class DeviceNotFound(DeviceError):
    """Nothing answers at the address or serial number. Check cable, power and the rig's file."""

    status = 404


class DeviceBusy(DeviceError):
    """Somebody else controls the device (a second program, a second projector page). Close it there."""

    status = 409
    retryable = True


class DeviceDisconnected(DeviceError):
    """Control was lost in the middle of work; `reconnect` before anything else."""


class DeviceTimeout(DeviceError, TimeoutError):
    """The device didn't answer in time, e.g. a frame was never delivered."""

    retryable = True


class DeviceStalled(DeviceError):
    """The driver doesn't return from a call. The scan ends, the rig is opened anew with the next one."""


class DriverFailed(DeviceError):
    """A driver from outside raised what it shouldn't, or isn't what its protocol says. Mend or update it."""


class FeatureError(DeviceError, ValueError):
    """A setting is out of range, not one of the choices, or locked; the sentence names what is allowed."""

    status = 422


class UnsupportedFeature(FeatureError):
    """The device doesn't have this feature at all. Look at its capabilities first."""


class IncompleteFrame(DeviceError):
    """A frame arrived with parts missing. Take the shot again."""

    retryable = True


class OutOfSync(DeviceError):
    """A camera's frame doesn't show what it was taken for, again and again: the display lags, tears or drops patterns."""


class GeometryError(DeviceError):
    """A pattern doesn't fit the display pixel by pixel: scaled, resized, or on another screen."""

    status = 422


class RigNotFoundError(NotFoundError):
    """No rig of that name, no such module or factory. The sentence lists the names there are."""


class RigConfigError(InvalidSettingError):
    """A rig's option is unknown or its value can't be used. The sentence names the option and its range."""
