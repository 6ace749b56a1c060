"""A rig put together from single devices: any cameras, any projector."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from backend.devices.dlpc350_protocol import COLUMN_PITCH_BY_ROW_PITCH
from backend.devices.errors import RigConfigError
from backend.devices.opening import open_all
from backend.devices.protocols import (
    Camera,
    DeviceInfo,
    Projector,
    SequenceProjector,
    TriggerSource,
)
from backend.domain.rig import CameraFacts, ProjectorFacts, RigCalibration, RigFacts

_PITCH_TOLERANCE = 0.1


@dataclass(frozen=True)
class SensorFacts:
    """What a camera's data sheet or a measurement says, and the camera itself doesn't."""

    bit_depth: int | None = None
    """None: as the camera's pixel format says."""
    black_level_gray: float = 0.0
    """What a dark pixel reads, at the camera's depth."""
    full_well_e: float = 10_000.0
    """Electrons at full scale, at gain 0 dB."""
    read_noise_e: float = 10.0


@dataclass(frozen=True)
class CameraLimits:
    """What a camera shall not be used beyond, though it could; None: as far as it goes."""

    longest_exposure_ms: float | None = None
    largest_gain_db: float | None = None


class AssembledRig:
    """A `Rig` of devices that are made already, and closed again with it.

    Parameters
    ----------
    name
        Name under which the rig is opened.
    cameras
        By name; the first is the reference.
    projector
        Projector or screen.
    sensors
        What is known of each camera's sensor; sizes and ranges are read from the devices.
    calibration
        Where the devices are, if that is known.
    trigger_lines
        The line of each camera that the projector's trigger output drives.
    limits
        What each camera shall not be used beyond.
    snap_exposures
        Whether exposures are to be whole frame periods of the projector.
    calibrated_px
        Width and height that cameras and `projector` were calibrated at, by name.
    """

    def __init__(
        self,
        name: str,
        cameras: Mapping[str, Camera],
        projector: Projector,
        *,
        sensors: Mapping[str, SensorFacts],
        gamma: float = 1.0,
        calibration: RigCalibration | None = None,
        trigger_lines: Mapping[str, TriggerSource] | None = None,
        limits: Mapping[str, CameraLimits] | None = None,
        snap_exposures: bool = True,
        calibrated_px: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        self._name = name
        self._cameras = dict(cameras)
        self._projector = projector
        self._sensors = dict(sensors)
        self._gamma = gamma
        self._calibration = calibration
        self._trigger_lines = dict(trigger_lines or {})
        self._limits = dict(limits or {})
        self._snap_exposures = snap_exposures
        self._calibrated_px = dict(calibrated_px or {})

    @property
    def name(self) -> str:
        """Name under which it is opened."""
        return self._name

    @property
    def info(self) -> DeviceInfo:
        """Say what it is put together from."""
        models = [d.info.model or d.name for d in (*self._cameras.values(), self._projector)]
        return DeviceInfo("", " + ".join(models))

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""
        return self._cameras

    @property
    def projector(self) -> Projector:
        """The projector or screen."""
        return self._projector

    @property
    def trigger_lines(self) -> Mapping[str, TriggerSource]:
        """The wired cameras, and which line of each is."""
        return self._trigger_lines

    @property
    def is_hardware_timed(self) -> bool:
        """Whether bursts run by the projector's clock: every camera is wired, and the projector runs sequences."""
        wired = set(self._cameras) <= set(self._trigger_lines)
        return wired and isinstance(self._projector, SequenceProjector)

    def open(self) -> None:
        """Open every device; when one refuses, the others are closed again."""
        open_all((self._projector, *self._cameras.values()))

    def close(self) -> None:
        """Close every device."""
        for device in (*self._cameras.values(), self._projector):
            device.close()

    def __enter__(self) -> "AssembledRig":
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def facts(self) -> RigFacts:
        """Return sizes and ranges as the devices tell them, noise as the rig's owner measured it."""
        self._refuse_other_sizes()
        self._refuse_square_pixels()
        cameras = {name: self._camera_facts(name) for name in self._cameras}
        can = self._projector.capabilities
        # A pattern of a sequence is complete within the exposure, whatever that is: no grid is needed.
        on_grid = self._snap_exposures and can.refresh_hz and not self.is_hardware_timed
        period_ms = 1000.0 / can.refresh_hz if on_grid and can.refresh_hz else None
        gamma = 1.0 if can.linear else self._gamma
        return RigFacts(cameras, next(iter(cameras)), ProjectorFacts(*can.size, period_ms, gamma))

    def calibration(self) -> RigCalibration | None:
        """Return the calibration that was handed in."""
        return self._calibration

    def _refuse_other_sizes(self) -> None:
        """Refuse a calibration of another size: points from it would look right and be wrong."""
        sizes = {name: camera.capabilities.sensor_size for name, camera in self._cameras.items()}
        sizes["projector"] = self._projector.capabilities.size
        for name, calibrated in self._calibrated_px.items():
            if sizes[name] != calibrated:
                (width, height), (now_width, now_height) = calibrated, sizes[name]
                raise RigConfigError(
                    f"{name}: the calibration is for {width}x{height} px, the device has {now_width}x{now_height};"
                    " calibrate it at the size in use, or use it at the size it was calibrated at"
                )

    def _refuse_square_pixels(self) -> None:
        """Refuse the calibration of a projector for pixels that it hasn't: points from it would be stretched."""
        model = self._calibration.projector if self._calibration else None
        if model is None or self._projector.capabilities.pixel_layout != "diamond":
            return
        ratio = float(model.K[1, 1] / model.K[0, 0])
        if abs(ratio / COLUMN_PITCH_BY_ROW_PITCH - 1.0) > _PITCH_TOLERANCE:
            raise RigConfigError(
                f"{self._projector.name}: the calibration has focal lengths of {model.K[0, 0]:.0f} columns and"
                f" {model.K[1, 1]:.0f} rows, but its columns are twice as far apart as its rows; calibrate it with patterns"
                " of its own size"
            )

    def _camera_facts(self, name: str) -> CameraFacts:
        can, sensor = self._cameras[name].capabilities, self._sensors[name]
        line = self._trigger_lines.get(name)
        if line is not None and line not in can.trigger_sources:
            there = ", ".join(can.trigger_sources)
            raise RigConfigError(
                f"{name}: the camera has no trigger line {line}, it has {there}; correct trigger_line"
            )
        width_px, height_px = can.sensor_size
        shortest_us, longest_us = self._exposures_us(name)
        gain_db = self._limits.get(name, CameraLimits()).largest_gain_db
        return CameraFacts(
            width_px=width_px,
            height_px=height_px,
            bit_depth=self._bit_depth(name),
            exposure_min_ms=shortest_us / 1000.0,
            exposure_max_ms=longest_us / 1000.0,
            black_level_gray=sensor.black_level_gray,
            full_well_e=sensor.full_well_e,
            read_noise_e=sensor.read_noise_e,
            gain_max_db=can.gain_db.max if gain_db is None else min(gain_db, can.gain_db.max),
        )

    def _bit_depth(self, name: str) -> int:
        said, pixel_format = (
            self._sensors[name].bit_depth,
            self._cameras[name].settings.pixel_format,
        )
        digits = re.search(r"\d+", pixel_format or "")
        delivered = int(digits[0]) if digits else said or 8
        if said not in (None, delivered):
            raise RigConfigError(
                f"{name}: the camera delivers {pixel_format}, {delivered} bits, and its sensor entry says bit_depth {said};"
                " leave bit_depth out, or choose another pixel_format"
            )
        return delivered

    def _exposures_us(self, name: str) -> tuple[float, float]:
        """Return the shortest and the longest exposure that device, wiring and owner allow."""
        can, limit_ms = self._cameras[name].capabilities.exposure_us, None
        if name in self._limits:
            limit_ms = self._limits[name].longest_exposure_ms
        least_us = self._projector.capabilities.min_exposure_us if self.is_hardware_timed else 0.0
        longest_us = can.max if limit_ms is None else min(can.max, 1000.0 * limit_ms)
        shortest_us = max(can.min, least_us)
        if shortest_us > longest_us:
            raise RigConfigError(
                f"{name}: exposures have to be at least {shortest_us / 1000:g} ms, but the rig file allows"
                f" {longest_us / 1000:g} ms; raise its limit"
            )
        return shortest_us, longest_us
