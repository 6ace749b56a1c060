"""A GenICam camera's features by their standard names (SFNC), and by older names where a camera has only those.

Which library reads the camera's description doesn't matter here: each brings its `Features`.
"""

from contextlib import suppress

import numpy as np
from jaxtyping import UInt8, UInt16
from pydantic import Field

from backend.devices.drivers.sfnc_features import Features
from backend.devices.drivers.sfnc_overruling import (
    LeftOn,
    overrule,
    overrule_sequencer,
    overrule_trigger,
    told,
)
from backend.devices.errors import FeatureError, UnsupportedFeature
from backend.devices.options import DeviceOptions
from backend.devices.protocols import CameraCapabilities, CameraSettings, Range, TriggerSource
from backend.devices.refusals import fixed_exposure

MONO_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
_COLOUR_CHANNELS = {"RGB8": 3, "BGR8": 3, "RGBa8": 4, "BGRa8": 4}
_GREEN = 1
"""In every colour format above."""
_EXPOSURES = ("ExposureTime", "ExposureTimeAbs")
_GAINS = ("Gain", "GainAbs")
_RAW_GAIN = "GainRaw"
_READOUT_S = 0.004
"""Assumed of cameras that don't tell it."""


class SfncOptions(DeviceOptions):
    """What every GenICam camera may be told in a rig file."""

    pixel_format: str | None = None
    """SFNC PixelFormat to open with, e.g. Mono12; None: what the camera is set to."""
    region: tuple[int, int, int, int] | None = None
    """Left, top, width, height in [px] of what is read of the sensor; None: what the camera is set to."""
    exposure_us: float | None = Field(None, gt=0)
    """Exposure in [us] of a camera that has one but no feature to set it; else refused."""
    gain_db_per_step: float | None = Field(None, gt=0)
    """How many dB a step of GainRaw is, where a camera has no gain in dB; None: such a gain stays as it is."""
    colour: bool = False
    """Whether to take the green channel of a colour camera that has no monochrome format. Its neighbours are
    interpolated, so edges move by parts of a pixel: for demonstration only."""


class SfncControls:
    """One camera's exposure, gain, format and trigger, through its features.

    Parameters
    ----------
    camera
        Its name in the rig.
    features
        Its features.
    options
        What the rig file says.
    buffered_frames
        How many frames the library lets wait in free run.
    hardware_timestamp
        Whether frames come with a time of the camera's clock.
    """

    def __init__(
        self,
        camera: str,
        features: Features,
        options: SfncOptions,
        *,
        buffered_frames: int,
        hardware_timestamp: bool,
    ) -> None:
        self._camera = camera
        self._features = features
        self._options = options
        self._buffered_frames = buffered_frames
        self._hardware_timestamp = hardware_timestamp
        self._exposure = self._gain = self._raw_gain = ""
        """Names of its features; known after `prepare`."""
        self.left_on = LeftOn((), ())
        """What a viewer left behind; known after `prepare`."""

    def _find_names(self) -> None:
        """See how it calls exposure and gain: some have neither as long as something else sets them."""
        self._exposure = self._first(_EXPOSURES)
        self._gain = next((n for n in _GAINS if self._is_in_db(n)), "")
        known = self._gain or not self._options.gain_db_per_step
        self._raw_gain = "" if known else self._first((_RAW_GAIN,))

    def _first(self, names: tuple[str, ...]) -> str:
        return next((name for name in names if self._features.has(name)), "")

    def _is_in_db(self, name: str) -> bool:
        """SFNC leaves the unit of a gain to the vendor; one that isn't told is dB by custom."""
        return self._features.has(name) and self._features.unit(name) in ("", "dB", "DB", "db")

    # ------------------------------------------------------------ before the first frame

    def prepare(self) -> None:
        """Overrule what else was set before us: automatics off, one trigger per frame, a format that we read."""
        features = self._features
        # A former owner that was killed left it running, and most cameras lock their settings meanwhile.
        with suppress(Exception):  # one that stands still may refuse to be stopped
            features.run("AcquisitionStop")
        self.left_on = overrule_sequencer(self._camera, features)
        for name, value in (
            ("AcquisitionMode", "Continuous"), ("ExposureMode", "Timed"), ("GainSelector", "All"),
        ):  # fmt: skip
            self._set_if_possible(name, value)
        self.left_on += overrule(self._camera, features)
        self._find_names()
        self._choose_format()
        self._read_region()
        for selector in features.choices("TriggerSelector"):  # another one may hold frames back
            features.set_text("TriggerSelector", selector)
            self._set_if_possible("TriggerMode", "Off")
        self._set_if_possible("TriggerSelector", "FrameStart")
        self._set_if_possible("TriggerActivation", "RisingEdge")
        self.left_on += overrule_trigger(self._camera, features)
        self._set_trigger(self._sources()[0])

    def _choose_format(self) -> None:
        formats, wanted = self._formats(), self._options.pixel_format
        now = self._features.text("PixelFormat")
        if wanted is None:
            wanted = now if now in formats else formats[0]
        if wanted not in formats:
            raise FeatureError(
                self._camera,
                f"PixelFormat {wanted} is not one of {', '.join(formats)}; choose one of them",
            )
        if wanted != now:
            self._features.set_text("PixelFormat", wanted)

    def _set_if_possible(self, name: str, value: str) -> None:
        if value in self._features.choices(name) and self._features.text(name) != value:
            self._features.set_text(name, value)

    def _read_region(self) -> None:
        region = self._options.region
        if region is None:
            return
        left, top, width, height = region
        for name, value in (
            ("OffsetX", 0), ("OffsetY", 0), ("Width", width), ("Height", height), ("OffsetX", left), ("OffsetY", top),
        ):  # fmt: skip
            if not self._features.has(name):
                if value:
                    raise UnsupportedFeature(self._camera, f"has no {name}; leave the region out")
                continue
            low, high, step = self._features.bounds(name)
            allowed = Range(low, high, step, "px")
            if value not in allowed or allowed.nearest(value) != value:
                raise FeatureError(
                    self._camera,
                    f"{name} {value} of region {list(region)} is not within {allowed} in steps of {step:g}; choose another",
                )
            if self._features.number(name) != value:
                self._set_region(name, value)

    def _set_region(self, name: str, value: int) -> None:
        try:
            self._features.set_number(name, value)
        except Exception as error:
            now = self._features.number(
                name
            )  # fails where the camera is gone: then that is what is told
            raise FeatureError(
                self._camera,
                f"{name} stays at {now:g}, {value} of region {list(self._options.region or ())} is"
                f" refused ({' '.join(str(error).split())}); leave the region out, or set it in the vendor's viewer",
            ) from error

    def notes(self) -> tuple[str, ...]:
        """Say what was set otherwise than found, and what its owner should know of; after `prepare`."""
        return (*self.left_on.corrected, *told(self._camera, self._features))

    # ------------------------------------------------------------ what it can

    def capabilities(self) -> CameraCapabilities:
        """Return what the camera can be set to, as it is prepared."""
        width_px, height_px = (round(self._features.number(n)) for n in ("Width", "Height"))
        return CameraCapabilities(
            sensor_size=(width_px, height_px),
            pixel_formats=self._formats(),
            exposure_us=self._exposure_range(),
            gain_db=self._gain_range(),
            trigger_sources=self._sources(),
            hardware_timestamp=self._hardware_timestamp,
            min_frame_period_s=self._readout_s(),
            buffered_frames=self._buffered_frames,
        )

    def _formats(self) -> tuple[str, ...]:
        there = self._features.choices("PixelFormat")
        formats = tuple(name for name in there if name in MONO_BITS)
        if not formats and self._options.colour:
            formats = tuple(name for name in there if name in _COLOUR_CHANNELS)
        if not formats:
            known = ", ".join(MONO_BITS)
            raise UnsupportedFeature(
                self._camera,
                f"its pixel formats ({', '.join(there)}) are none of {known}; use a monochrome camera, or `colour: true` for demonstration",
            )
        return formats

    def _exposure_range(self) -> Range:
        if self._exposure:
            return Range(*self._features.bounds(self._exposure), "us")
        return fixed_exposure(self._camera, self._options.exposure_us)

    def _gain_range(self) -> Range:
        if self._gain:
            return Range(*self._features.bounds(self._gain), "dB")
        if self._raw_gain:
            low, high, step = self._features.bounds(self._raw_gain)
            per_step = self._db_per_step()
            return Range(0.0, (high - low) * per_step, step * per_step, "dB")
        return Range(0.0, 0.0, 0.0, "dB")

    def _db_per_step(self) -> float:
        return self._options.gain_db_per_step or 0.0

    def _sources(self) -> tuple[TriggerSource, ...]:
        modes = self._features.choices("TriggerMode")
        there = set(self._features.choices("TriggerSource")) if "On" in modes else set()
        free_run = TriggerSource.FREE_RUN
        sources = tuple(s for s in TriggerSource if s.value in there and s is not free_run)
        return (*sources, free_run) if "Off" in modes or not sources else sources

    def _readout_s(self) -> float:
        known = self._features.has("SensorReadoutTime")
        return self._features.number("SensorReadoutTime") * 1e-6 if known else _READOUT_S

    # ------------------------------------------------------------ settings

    def read(self) -> CameraSettings:
        """Return the settings in force."""
        features, exposure_us = self._features, self._options.exposure_us or 0.0
        return CameraSettings(
            exposure_us=features.number(self._exposure) if self._exposure else exposure_us,
            gain_db=self._read_gain(),
            pixel_format=features.text("PixelFormat"),
            trigger=self._read_trigger(),
        )

    def _read_gain(self) -> float:
        if self._raw_gain:
            low, _, _ = self._features.bounds(self._raw_gain)
            return (self._features.number(self._raw_gain) - low) * self._db_per_step()
        return self._features.number(self._gain) if self._gain else 0.0

    def _read_trigger(self) -> TriggerSource:
        features = self._features
        if "On" not in features.choices("TriggerMode") or features.text("TriggerMode") != "On":
            return TriggerSource.FREE_RUN
        return TriggerSource(features.text("TriggerSource"))

    def apply(self, wanted: CameraSettings, now: CameraSettings) -> CameraSettings:
        """Set what differs and return what holds then; what is refused leaves everything as it was."""
        try:
            self._change(wanted, now)
        except BaseException:
            with suppress(Exception):  # the first error says what is wrong
                self._change(now, wanted)
            raise
        return self.read()

    def _change(self, wanted: CameraSettings, now: CameraSettings) -> None:
        if wanted.pixel_format not in (None, now.pixel_format):
            self._features.set_text("PixelFormat", str(wanted.pixel_format))
        if wanted.trigger is not now.trigger:
            self._set_trigger(wanted.trigger)
        if wanted.exposure_us != now.exposure_us:
            self._set_nearest(self._exposure, wanted.exposure_us)
        if wanted.gain_db != now.gain_db:
            self._set_gain(wanted.gain_db)

    def _set_gain(self, gain_db: float) -> None:
        if not self._raw_gain:
            self._set_nearest(self._gain, gain_db)
            return
        low, _, _ = self._features.bounds(self._raw_gain)
        self._set_nearest(self._raw_gain, low + gain_db / self._db_per_step())

    def _set_nearest(self, name: str, value: float) -> None:
        """Set a number to the value next to the wanted one that the camera has: it may refuse those between."""
        self._features.set_number(name, Range(*self._features.bounds(name)).nearest(value))

    def _set_trigger(self, trigger: TriggerSource) -> None:
        self._set_if_possible("TriggerMode", "Off")  # while it is on, some lock the source
        if trigger is TriggerSource.FREE_RUN:
            return
        self._features.set_text("TriggerSource", trigger.value)
        self._features.set_text("TriggerMode", "On")


def bits_of(pixel_format: str) -> int:
    """Return the significant bits of a format that `SfncControls` offers."""
    return MONO_BITS.get(pixel_format, 8)


def gray_of(
    data: UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."],
    width_px: int,
    height_px: int,
    pixel_format: str,
) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | None:
    """Copy a picture out of a buffer's samples: monochrome as it is, of colours the green; None if it holds fewer."""
    channels = _COLOUR_CHANNELS.get(pixel_format, 1)
    flat = data.reshape(-1)
    if flat.size < width_px * height_px * channels:
        return None
    picture = flat[: width_px * height_px * channels].reshape(height_px, width_px, channels)
    return picture[:, :, _GREEN if channels > 1 else 0].copy()
