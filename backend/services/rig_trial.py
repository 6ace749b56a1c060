"""Try a rig out: who its devices are, one white frame of each camera, and what looks wrong."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from backend.devices.errors import DeviceError
from backend.devices.protocols import Camera, DeviceInfo, Frame, Notes, Remarks, Rig
from backend.domain.patterns import BLACK, WHITE
from backend.domain.rig import RigCalibration, RigFacts
from backend.jobs.control import JobControl
from backend.jobs.device_threads import DeviceThreads
from backend.jobs.rendering import render
from backend.jobs.rigs import Owner
from backend.jobs.shooting import Shooter
from backend.services.context import Context

_EXPOSURE_MS = 30.0
_LEAST_LIGHT = 1.5
"""The white field has to be so many times as bright as the black one for the light to count as seen."""


@dataclass(frozen=True)
class TriedDevice:
    """One device of a rig."""

    name: str
    who: str
    abilities: str


@dataclass(frozen=True)
class TestFrame:
    """What a camera made of the white field."""

    camera: str
    width_px: int
    height_px: int
    bits: int
    exposure_ms: float
    mean_gray: float
    brightest_gray: float
    saturated_share: float
    dark_mean_gray: float
    """Mean of the black field, for comparison."""


@dataclass(frozen=True)
class RigTrial:
    """What was found."""

    name: str
    info: str
    devices: tuple[TriedDevice, ...]
    frames: tuple[TestFrame, ...]
    calibration: str
    problems: tuple[str, ...]
    """One sentence each; empty: all is well."""
    notes: tuple[str, ...] = ()
    """What the devices were found set to, a sentence each: nothing that is wrong now."""

    def document(self) -> dict[str, Any]:
        """Write it as JSON values."""
        return {"rig": self.name, "ok": not self.problems, **asdict(self)}


def try_rig(
    context: Context,
    name: str,
    options: Mapping[str, Any],
    *,
    who: str = "rigs check",
    control: JobControl | None = None,
) -> RigTrial:
    """Open a rig and take a white and a black frame with every camera; `who` owns it meanwhile.

    Raises
    ------
    CancelledError
        If `control` is stopped.
    UnglareError
        If the rig can't be opened, is busy, or a device fails: the sentence names it.
    """
    control = control or JobControl()
    with context.rigs.lease(name, options, Owner("", "check", who), control) as lease:
        return lease.call(lambda rig: _try(name, rig, lease.threads, control))


def _try(name: str, rig: Rig, threads: DeviceThreads, control: JobControl) -> RigTrial:
    facts, calibration = rig.facts(), rig.calibration()
    devices = tuple(_devices(rig))
    try:
        frames = _frames(rig, facts, threads, control)
    except DeviceError as error:
        return RigTrial(
            name,
            _who(rig.info),
            devices,
            (),
            _calibration_words(calibration),
            (error.sentence, *_remarks(rig)),
            tuple(_notes(rig)),
        )
    return RigTrial(
        name=name,
        info=_who(rig.info),
        devices=devices,
        frames=frames,
        calibration=_calibration_words(calibration),
        problems=(*_remarks(rig), *_problems(facts, calibration, frames)),
        notes=tuple(_notes(rig)),
    )


def _remarks(rig: Rig) -> Iterator[str]:
    """Return what the devices found doubtful when they were opened."""
    for device in (rig.projector, *rig.cameras.values()):
        if isinstance(device, Remarks):
            yield from device.remarks


def _notes(rig: Rig) -> Iterator[str]:
    """Return what the devices were found set to when they were opened."""
    for device in (rig.projector, *rig.cameras.values()):
        if isinstance(device, Notes):
            yield from device.notes


def _devices(rig: Rig) -> Iterator[TriedDevice]:
    for camera in rig.cameras.values():
        can = camera.capabilities
        width_px, height_px = can.sensor_size
        formats = ", ".join(can.pixel_formats)
        exposure = f"{can.exposure_us.min / 1000:g} to {can.exposure_us.max / 1000:g} ms"
        yield TriedDevice(
            camera.name, _who(camera.info), f"{width_px}x{height_px} px, {formats}, {exposure}"
        )
    projector = rig.projector
    width_px, height_px = projector.capabilities.size
    refresh = projector.capabilities.refresh_hz
    rate = f", {refresh:g} Hz" if refresh else ""
    yield TriedDevice(projector.name, _who(projector.info), f"{width_px}x{height_px} px{rate}")


def _who(info: DeviceInfo) -> str:
    words = [info.vendor, info.model, info.serial]
    return " ".join(word for word in words if word)


def _frames(
    rig: Rig, facts: RigFacts, threads: DeviceThreads, control: JobControl
) -> tuple[TestFrame, ...]:
    low_ms = max(c.exposure_min_ms for c in facts.cameras.values())
    high_ms = min(c.exposure_max_ms for c in facts.cameras.values())
    exposure_ms = float(np.clip(_EXPOSURE_MS, low_ms, high_ms))
    with Shooter(rig, control, threads) as shooter:
        width_px, height_px = shooter.projector_size
        shooter.load([render(p, width_px=width_px, height_px=height_px) for p in (WHITE, BLACK)])
        white, black = (
            shooter.take(i, exposure_ms=exposure_ms, gain_db=0.0, cameras=list(rig.cameras))
            for i in (0, 1)
        )
    return tuple(_test_frame(c, white[n], black[n]) for n, c in rig.cameras.items())


def _test_frame(camera: Camera, white: Frame, black: Frame) -> TestFrame:
    height_px, width_px = white.data.shape
    return TestFrame(
        camera=camera.name,
        width_px=width_px,
        height_px=height_px,
        bits=white.bits,
        exposure_ms=white.exposure_us / 1000.0,
        mean_gray=float(white.data.mean()),
        brightest_gray=float(white.data.max()),
        saturated_share=float((white.data >= 2**white.bits - 2).mean()),
        dark_mean_gray=float(black.data.mean()),
    )


def _problems(
    facts: RigFacts, calibration: RigCalibration | None, frames: tuple[TestFrame, ...]
) -> Iterator[str]:
    for frame in frames:
        told = facts.cameras[frame.camera]
        if (frame.width_px, frame.height_px) != (told.width_px, told.height_px):
            yield (
                f"Camera {frame.camera!r} delivers {frame.width_px}x{frame.height_px} px but says "
                f"{told.width_px}x{told.height_px} px: correct the rig's facts."
            )
        if frame.bits != told.bit_depth:
            yield (
                f"Camera {frame.camera!r} delivers {frame.bits} bits but says {told.bit_depth}: "
                "correct the rig's facts or its pixel format."
            )
        yield from _light_problems(frame, told.black_level_gray)
    if calibration is not None:
        yield from _calibration_problems(facts, calibration)


def _light_problems(frame: TestFrame, black_level_gray: float) -> Iterator[str]:
    white = frame.mean_gray - black_level_gray
    black = max(frame.dark_mean_gray - black_level_gray, 0.25)
    if white < _LEAST_LIGHT * black:
        yield (
            f"Camera {frame.camera!r} doesn't see the projector: the white field has {frame.mean_gray:.1f} gray, "
            f"the black one {frame.dark_mean_gray:.1f}; open the lens cap or the iris, or aim the projector."
        )
    if frame.saturated_share > 0.5:
        yield (
            f"Camera {frame.camera!r} is saturated on {frame.saturated_share:.0%} of its picture at "
            f"{frame.exposure_ms:.1f} ms: close the iris or dim the light."
        )


def _calibration_problems(facts: RigFacts, calibration: RigCalibration) -> Iterator[str]:
    for name, model in calibration.cameras.items():
        told = facts.cameras.get(name)
        if told is not None and (model.width_px, model.height_px) != (
            told.width_px,
            told.height_px,
        ):
            yield (
                f"The calibration of camera {name!r} is for {model.width_px}x{model.height_px} px, the camera has "
                f"{told.width_px}x{told.height_px} px: calibrate again at this size."
            )


def _calibration_words(calibration: RigCalibration | None) -> str:
    if calibration is None:
        return "not calibrated: scans end with the phase, without points"
    names = [*calibration.cameras, *(["projector"] if calibration.projector else [])]
    return f"calibrated: {', '.join(names)}"
