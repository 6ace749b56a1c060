"""A camera and a projector that look at a tilted plane, and the Gray code frames that the camera sees of it."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import BLACK, WHITE, Gray
from backend.domain.rig import (
    CameraFacts,
    PinholeModel,
    Pose,
    ProjectorFacts,
    RigCalibration,
    RigFacts,
)
from backend.numerics.camera_model import Pinhole, RigidTransform, project, rays

CAMERA_SIZE, PROJECTOR_SIZE = (160, 120), (128, 96)
CODES_X, CODES_Y, BITS = 128, 96, 7
CONVERGENCE_RAD = 0.25


@dataclass(frozen=True)
class Scene:
    """True points and projector positions of every camera pixel."""

    points_mm: np.ndarray
    projector_px: np.ndarray
    """(h, w, 2): x, y, not rounded."""


def pinhole(size: tuple[int, int], focal: float, distortion: tuple[float, ...]) -> PinholeModel:
    width, height = size
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return PinholeModel(width, height, K, np.array(distortion))


@lru_cache(maxsize=1)
def calibration() -> RigCalibration:
    c, s = np.cos(CONVERGENCE_RAD), np.sin(CONVERGENCE_RAD)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return RigCalibration(
        cameras={"main": pinhole(CAMERA_SIZE, 300.0, (-0.1, 0.05, 0.001, -0.001, 0.0))},
        camera_from_world={"main": Pose(np.eye(3), np.zeros(3))},
        reference="main",
        projector=pinhole(PROJECTOR_SIZE, 220.0, (-0.05, 0.0, 0.0, 0.0, 0.0)),
        projector_from_world=Pose(turn, turn @ np.array([-150.0, 0.0, 0.0])),
    )


def devices() -> tuple[Pinhole, Pinhole, RigidTransform]:
    rig = calibration()
    camera, projector, pose = rig.cameras["main"], rig.projector, rig.projector_from_world
    assert projector is not None
    assert pose is not None
    models = [Pinhole(m.K, m.distortion, m.width_px, m.height_px) for m in (camera, projector)]
    return models[0], models[1], RigidTransform(pose.R, pose.t_mm)


@lru_cache(maxsize=1)
def scene() -> Scene:
    """Intersect every pixel's ray with the plane z = 600 + 0.3 x - 0.1 y mm."""
    camera, projector, pose = devices()
    width, height = CAMERA_SIZE
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    slopes = rays(pixels.astype(float), camera)
    depth = 600.0 / (1.0 - 0.3 * slopes[:, 0] + 0.1 * slopes[:, 1])
    points = np.column_stack([slopes, np.ones(len(slopes))]) * depth[:, None]
    position = project(points, projector, pose)
    return Scene(points.reshape(height, width, 3), position.reshape(height, width, 2))


def facts() -> RigFacts:
    width, height = CAMERA_SIZE
    camera = CameraFacts(width, height, 8, 1.0, 100.0, 2.0, 10_000.0, 10.0)
    return RigFacts({"main": camera}, "main", ProjectorFacts(*PROJECTOR_SIZE))


def picture(bit: int, axis: str, *, inverse: bool) -> np.ndarray:
    """Gray level 150 where the projector is bright, 20 where it is dark, 5 outside of its picture."""
    column = np.floor(scene().projector_px[..., 0 if axis == "x" else 1] + 0.5).astype(int)
    code = column ^ (column >> 1)
    bright = ((code >> bit) & 1).astype(bool) != inverse
    return np.where(_on_projector(), np.where(bright, 150, 20), 5).astype(np.uint8)


def _on_projector() -> np.ndarray:
    position = scene().projector_px
    inside = (position > -0.5) & (position < np.array(PROJECTOR_SIZE) - 0.5)
    return np.asarray(inside.all(axis=-1))


def frame(pattern: Gray) -> Frame:
    pixels = picture(pattern.bit, pattern.axis, inverse=pattern.inverse)
    return Frame("main", pattern, None, InMemory(pixels))


def gray_frames(axes: str = "xy", *, inverses: bool = True) -> tuple[Frame, ...]:
    codes = {"x": CODES_X, "y": CODES_Y}
    return tuple(
        frame(Gray(axis=axis, bit=bit, bits=BITS, codes=codes[axis], inverse=inverse))
        for axis in axes
        for bit in reversed(range(BITS))
        for inverse in ((False, True) if inverses else (False,))
    )


def fields() -> tuple[Frame, ...]:
    lit = _on_projector()
    return tuple(
        Frame("main", pattern, None, InMemory(np.where(lit, gray, 5).astype(np.uint8)))
        for pattern, gray in ((WHITE, 150), (BLACK, 20))
    )
