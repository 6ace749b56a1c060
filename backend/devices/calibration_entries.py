"""The calibration in a rig file: how its devices see, what its screen is, and where they all are.

::

    calibration:
      cameras:
        camera: {width_px: 1280, height_px: 960, K: [[3712, 0, 643], [0, 3712, 477], [0, 0, 1]]}
      screen:
        width_px: 1920
        height_px: 1080
        pixel_pitch_mm: 0.2767
        R: [[-1, 0, 0], [0, 0.866, 0.5], [0, 0.5, -0.866]]
        t_mm: [0, -250.9, 456.6]

Every pose is `x_device = R x_world + t_mm`, as OpenCV has it; the world is the reference camera's frame unless that
camera's pose says otherwise. Three digits do for R: the rotation next to it is taken.
"""

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from backend.domain.rig import PinholeModel, Pose, RigCalibration, ScreenModel
from backend.numerics.pinhole import DISTORTION_SIZES

_Vector = tuple[float, float, float]
_Matrix = tuple[_Vector, _Vector, _Vector]
ScreenPoint = Annotated[
    tuple[float, float, float, float, float], "x and y in the pattern, 0 to 1; x, y, z in mm"
]

_SAME_PLACE_MM = 1e-6
_EXACT, _ROUNDED = 1e-6, 2e-3
"""By how much rows may fail to be orthonormal: as a program writes them, or a person with three digits."""
_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


class CalibrationPart(BaseModel):
    """Base: nothing that isn't named here."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _rotates(value: _Matrix) -> _Matrix:
    R = np.array(value)
    deviation = np.abs(R @ R.T - np.eye(3)).max()
    if deviation > _ROUNDED or np.linalg.det(R) < 0:
        raise ValueError("it is no rotation: its rows have to be orthonormal and right-handed")
    if deviation <= _EXACT:
        return value  # to the last bit: calibrations are compared by it
    u, _, vt = np.linalg.svd(R)
    first, second, third = (u @ vt).tolist()
    return tuple(first), tuple(second), tuple(third)


class ViewEntry(CalibrationPart):
    """How a calibrated device sees, and where it is."""

    width_px: int = Field(gt=0)
    height_px: int = Field(gt=0)
    K: _Matrix
    distortion: tuple[float, ...] = (0.0,) * 5
    R: _Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    t_mm: _Vector = (0.0, 0.0, 0.0)

    _is_rotation = field_validator("R")(_rotates)

    @field_validator("distortion")
    @classmethod
    def _of_opencv(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in DISTORTION_SIZES:
            known = ", ".join(map(str, DISTORTION_SIZES))
            raise ValueError(f"it has {len(value)} coefficients, OpenCV's sets have {known}")
        return value

    @property
    def model(self) -> PinholeModel:
        """Intrinsics."""
        return PinholeModel(
            self.width_px, self.height_px, np.array(self.K), np.array(self.distortion)
        )

    @property
    def device_from_world(self) -> Pose:
        """Extrinsics."""
        return Pose(np.array(self.R), np.array(self.t_mm))


class PoseEntry(CalibrationPart):
    """Where something is that doesn't see."""

    R: _Matrix
    t_mm: _Vector

    _is_rotation = field_validator("R")(_rotates)

    @property
    def device_from_world(self) -> Pose:
        """The pose."""
        return Pose(np.array(self.R), np.array(self.t_mm))


class ScreenEntry(PoseEntry):
    """The display that is seen in a mirror, and where it is.

    Its frame: +X to the right and +Y down on the screen as its viewer sees it, +Z away from him; the origin is in the
    middle of the picture where `pixel_pitch_mm` tells its shape.
    """

    width_px: int | None = Field(None, gt=0)
    height_px: int | None = Field(None, gt=0)
    pixel_pitch_mm: float | None = Field(None, ge=0.001, le=100)
    """From one pixel to the next: a flat screen."""
    points: tuple[ScreenPoint, ...] | None = Field(None, min_length=3)
    """Measured points of one that isn't flat, in its frame; four corners describe any flat one."""

    @model_validator(mode="after")
    def _has_one_shape(self) -> "ScreenEntry":
        sized = self.width_px is not None and self.height_px is not None
        if (self.pixel_pitch_mm is None) == (self.points is None):
            raise ValueError("give either pixel_pitch_mm, of a flat screen, or measured points")
        if self.pixel_pitch_mm is not None and not sized:
            raise ValueError("with pixel_pitch_mm it needs width_px and height_px")
        if self.points is not None and np.ptp(np.array(self.points)[:, :2], axis=0).min() < 1e-6:
            raise ValueError(
                "its points lie on one line of the pattern: give some apart in x and in y"
            )
        return self

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Size of the display that it holds for; None: any."""
        if self.width_px is None or self.height_px is None:
            return None
        return self.width_px, self.height_px

    @property
    def model(self) -> ScreenModel:
        """Its shape."""
        if self.points is not None:
            table = np.array(self.points, np.float64)
            return ScreenModel(table[:, :2], table[:, 2:])
        width_px, height_px = self.size_px or (0, 0)
        size_mm = (self.pixel_pitch_mm or 0.0) * np.array([width_px, height_px])
        return ScreenModel(_CORNERS, _flat(_CORNERS, size_mm))


def _flat(
    shares: Float64[np.ndarray, "n 2"], size_mm: Float64[np.ndarray, "2"]
) -> Float64[np.ndarray, "n 3"]:
    return np.column_stack([(shares - 0.5) * size_mm, np.zeros(len(shares))])


class CalibrationEntry(CalibrationPart):
    """Where all devices are; the world is the reference camera's frame if its pose is left out."""

    cameras: dict[str, ViewEntry]
    projector: ViewEntry | None = None
    screen: ScreenEntry | None = None
    """Of a rig that looks at its display through the part: methods for mirrors."""
    mirror: PoseEntry | None = None
    """Where the part is held; without it scans find its pose by its outline or markers. Frame: origin in its middle, +X
    to the right and +Y up as seen from its front, +Z towards the viewer."""

    @model_validator(mode="after")
    def _stand_apart(self) -> "CalibrationEntry":
        places = {name: _place_mm(view) for name, view in self.views()}
        for one, other in combinations(places, 2):
            if np.linalg.norm(places[one] - places[other]) < _SAME_PLACE_MM:
                raise ValueError(
                    f"{one} and {other} stand at the same place, so there would be no depth: give R and t_mm of one"
                )
        return self

    def views(self) -> Iterator[tuple[str, ViewEntry]]:
        """Return what sees or projects, by name."""
        yield from self.cameras.items()
        if self.projector is not None:
            yield "projector", self.projector

    @property
    def sizes_px(self) -> Mapping[str, tuple[int, int]]:
        """Sizes that the devices were calibrated at, by name; the screen's as the projector's."""
        sizes = {name: (view.width_px, view.height_px) for name, view in self.views()}
        if self.screen is not None and self.screen.size_px is not None:
            sizes.setdefault("projector", self.screen.size_px)
        return sizes

    def calibration(self, reference: str) -> RigCalibration:
        """Return it as methods get it."""
        return RigCalibration(
            cameras={name: view.model for name, view in self.cameras.items()},
            camera_from_world={name: view.device_from_world for name, view in self.cameras.items()},
            reference=reference,
            projector=self.projector.model if self.projector else None,
            projector_from_world=self.projector.device_from_world if self.projector else None,
            screen=self.screen.model if self.screen else None,
            screen_from_world=self.screen.device_from_world if self.screen else None,
            mirror_from_world=self.mirror.device_from_world if self.mirror else None,
        )


def _place_mm(view: ViewEntry) -> Float64[np.ndarray, "3"]:
    pose = view.device_from_world
    return np.asarray(-pose.R.T @ pose.t_mm, np.float64)


# from calibrations


def entry_of(
    calibration: RigCalibration, display_px: tuple[int, int] | None = None
) -> CalibrationEntry:
    """Write a calibration as a rig file has it; a flat screen by its pitch if the display's size is known."""
    views = {
        name: view_of(model, calibration.camera_from_world[name])
        for name, model in calibration.cameras.items()
    }
    projector, at = calibration.projector, calibration.projector_from_world
    screen, there = calibration.screen, calibration.screen_from_world
    held = calibration.mirror_from_world
    return CalibrationEntry(
        cameras=views,
        projector=view_of(projector, at) if projector is not None and at is not None else None,
        screen=_screen_of(screen, there, display_px) if screen and there else None,
        mirror=PoseEntry.model_validate(pose_of(held)) if held else None,
    )


def view_of(model: PinholeModel, pose: Pose) -> ViewEntry:
    """Write how a device sees, and where it is."""
    return ViewEntry.model_validate(
        {
            "width_px": model.width_px,
            "height_px": model.height_px,
            "K": model.K.tolist(),
            "distortion": model.distortion.ravel().tolist(),
            **pose_of(pose),
        }
    )


def pose_of(pose: Pose) -> dict[str, tuple[object, ...]]:
    """Write where something is."""
    return {"R": tuple(map(tuple, pose.R.tolist())), "t_mm": tuple(pose.t_mm.ravel().tolist())}


def _screen_of(screen: ScreenModel, pose: Pose, display_px: tuple[int, int] | None) -> ScreenEntry:
    pitch_mm = _even_pitch_mm(screen, display_px) if display_px else None
    if display_px is None or pitch_mm is None:
        points = np.column_stack([screen.shares, screen.points_mm]).tolist()
        return ScreenEntry.model_validate({"points": points, **pose_of(pose)})
    width_px, height_px = display_px
    size = {"width_px": width_px, "height_px": height_px, "pixel_pitch_mm": pitch_mm}
    return ScreenEntry.model_validate({**size, **pose_of(pose)})


def _even_pitch_mm(screen: ScreenModel, display_px: tuple[int, int]) -> float | None:
    """Return the pitch of a flat screen with square pixels and the origin in its middle; None for any other."""
    width_mm, width_share = np.ptp(screen.points_mm[:, 0]), np.ptp(screen.shares[:, 0])
    pitch_mm = float(width_mm / width_share) / display_px[0]
    flat = _flat(screen.shares, pitch_mm * np.array(display_px))
    return pitch_mm if np.allclose(screen.points_mm, flat, rtol=0, atol=1e-9) else None
