"""What every camera and every display refuses, real and simulated, in the same words."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import FeatureError, GeometryError, UnsupportedFeature
from backend.devices.protocols import CameraCapabilities, CameraSettings, Range, TriggerSource


def refuse_impossible(camera: str, wanted: CameraSettings, can: CameraCapabilities) -> None:
    """Refuse settings that a camera doesn't have; no pixel format at all is none to refuse.

    Raises
    ------
    FeatureError
        If exposure, gain, pixel format or trigger is not one of its own.
    UnsupportedFeature
        If a region is asked for.
    """
    for feature, value, allowed in (
        ("ExposureTime", wanted.exposure_us, can.exposure_us),
        ("Gain", wanted.gain_db, can.gain_db),
    ):
        if value not in allowed:
            raise FeatureError(
                camera,
                f"{feature} {value:.10g} {allowed.unit} is not within {allowed}; choose another",
            )
    if wanted.pixel_format not in (None, *can.pixel_formats):
        raise FeatureError(
            camera,
            f"PixelFormat {wanted.pixel_format} is not one of {', '.join(can.pixel_formats)}; choose one of them",
        )
    if wanted.trigger not in can.trigger_sources:
        raise FeatureError(
            camera,
            f"TriggerSource {wanted.trigger} is not one of {', '.join(can.trigger_sources)}; choose one of them",
        )
    if wanted.roi is not None:
        raise UnsupportedFeature(
            camera, f"region {wanted.roi} can't be set, the whole sensor is read; leave it out"
        )


def refuse_locked(camera: str, now: CameraSettings, wanted: CameraSettings) -> None:
    """Refuse, for an armed camera, changes that need it disarmed.

    Raises
    ------
    FeatureError
        If pixel format or trigger would change.
    """
    for feature, old, new in (
        ("PixelFormat", now.pixel_format, wanted.pixel_format),
        ("TriggerSource", now.trigger, wanted.trigger),
    ):
        if old != new:
            raise FeatureError(camera, f"{feature} {new} can't be set while armed; disarm first")


def refuse_trigger(camera: str, settings: CameraSettings, *, armed: bool) -> None:
    """Refuse a software trigger that would expose nothing.

    Raises
    ------
    FeatureError
        If the camera isn't armed or waits for a line.
    """
    if not armed:
        raise FeatureError(camera, "can't be triggered while not armed; arm it first")
    if settings.trigger is not TriggerSource.SOFTWARE:
        raise FeatureError(
            camera, f"TriggerSource is {settings.trigger}, not Software; set it before arming"
        )


def fixed_exposure(camera: str, exposure_us: float | None) -> Range:
    """Return the range of a camera whose exposure can't be set, or refuse it if nobody says which it has.

    Raises
    ------
    UnsupportedFeature
        If its exposure isn't known.
    """
    if exposure_us is None:
        raise UnsupportedFeature(
            camera,
            "has no exposure that could be set; say in the rig file which it has, e.g. `exposure_us: 20000`",
        )
    return Range(exposure_us, exposure_us, 0.0, "us")


def refuse_other_sizes(
    display: str, patterns: Sequence[UInt8[np.ndarray, "_ _"]], size: tuple[int, int]
) -> None:
    """Refuse patterns that would have to be scaled.

    Raises
    ------
    GeometryError
        If one hasn't the display's size; the sentence names the first.
    """
    width, height = size
    for index, pattern in enumerate(patterns):
        if pattern.shape != (height, width):
            given = "x".join(map(str, pattern.shape[::-1]))
            raise GeometryError(
                display,
                f"pattern {index} is {given}, the display {width}x{height}; render patterns in the display's size",
            )


def refuse_unloaded(display: str, index: int, loaded: int) -> None:
    """Refuse to show a pattern that isn't loaded.

    Raises
    ------
    FeatureError
        If the number is not one of the loaded ones.
    """
    if not 0 <= index < loaded:
        raise FeatureError(display, f"there is no pattern {index}, {loaded} are loaded; load first")


def refuse_level(display: str, level: int) -> None:
    """Refuse a uniform field of a code that a display of 8 bit doesn't have.

    Raises
    ------
    FeatureError
        If it is not within 0 to 255.
    """
    if not 0 <= level <= 255:
        raise FeatureError(display, f"level {level} is not within 0 to 255; choose another")


def cure_of_silence(trigger: TriggerSource, *, triggered: bool) -> str:
    """Say what to do when no frame comes, after what the camera waits for.

    Parameters
    ----------
    trigger
        What starts its exposures.
    triggered
        Whether it was told by software to expose since it was armed.
    """
    if trigger is TriggerSource.FREE_RUN:
        return "take it again"
    if trigger is not TriggerSource.SOFTWARE:
        return f"it waits for pulses on {trigger}: check its trigger cable, and that the projector is wired to that line"
    return (
        "it was triggered: check its cable, and reconnect the rig"
        if triggered
        else "trigger it first"
    )
