"""Surfaces seen exactly by cameras and projector, for the tests of geometry: shadow and occlusion included."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from backend.numerics.camera_model import Pinhole, RigidTransform, compose, inverse, project, rays

LENS = (-0.12, 0.15, 1e-3, -5e-4, 0.02)
"""A lens that moves the corners by some pixels."""
PROJECTOR_LENS = (-0.05, 0.02, 5e-4, 2e-4, 0.0)

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Origin (3) and directions (n, 3) to the factor of the direction at the first hit; NaN for none."""


def plane(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    normal = PLANE_NORMAL
    return np.asarray(((np.array([0.0, 0.0, 700.0]) - origin) @ normal) / (directions @ normal))


PLANE_NORMAL = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
SPHERE_CENTRE, SPHERE_RADIUS = np.array([0.0, 0.0, 760.0]), 120.0


def sphere(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    offset = origin - SPHERE_CENTRE
    a, b = (directions**2).sum(axis=1), directions @ offset
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - a * (offset @ offset - SPHERE_RADIUS**2))
        return np.asarray((-b - root) / a)


def step(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A plate at 680 mm left of x = 3 mm, in front of a wall at 720 mm."""
    near, far = ((depth - origin[2]) / directions[:, 2] for depth in (680.0, 720.0))
    left_of_edge = (origin + near[:, None] * directions)[:, 0] < 3.0
    return np.asarray(np.where(left_of_edge, near, far))


def camera(width_px: int = 640, height_px: int = 480, lens: tuple[float, ...] = LENS) -> Pinhole:
    focal = 1.9 * width_px
    K = np.array([[focal, 0, width_px / 2 + 2], [0, 1.001 * focal, height_px / 2 - 5], [0, 0, 1]])
    return Pinhole(K, np.array(lens), width_px, height_px)


def projector(lens: tuple[float, ...] = PROJECTOR_LENS) -> Pinhole:
    K = np.array([[1.75 * 1280, 0, 640], [0, 1.75 * 1280, 500], [0, 0, 1.0]])
    return Pinhole(K, np.array(lens), 1280, 800)


def looking_from(
    x_mm: float, y_mm: float, *, roll_rad: float = 0.0, target_mm: float = 700.0
) -> RigidTransform:
    """Pose device_from_world of a device at (x, y, 0) that looks at (0, 0, target)."""
    centre = np.array([x_mm, y_mm, 0.0])
    forward = np.array([0.0, 0.0, target_mm]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    roll, _ = cv2.Rodrigues(np.array([0.0, 0.0, roll_rad]))
    R = roll @ np.stack([right, np.cross(forward, right), forward])
    return RigidTransform(R, -R @ centre)


LEFT, RIGHT = looking_from(-90, 0, roll_rad=0.01), looking_from(90, 0, roll_rad=-0.02)
PROJECTOR = looking_from(0, -40)


class View(NamedTuple):
    """What one camera sees, without noise."""

    u_px: np.ndarray
    v_px: np.ndarray
    points_mm: np.ndarray
    """In the camera's frame."""

    def noisy(self, sigma_px: float, seed: int) -> np.ndarray:
        noise = np.random.default_rng(seed).normal(scale=sigma_px, size=self.u_px.shape)
        return (self.u_px + noise).astype(np.float32)


def view(
    surface: Surface,
    device: Pinhole,
    pose: RigidTransform,
    *,
    light: Pinhole | None = None,
    light_pose: RigidTransform = PROJECTOR,
) -> View:
    """See a surface; pixels that the projector doesn't light are NaN."""
    light = light or projector()
    shape = (device.height_px, device.width_px)
    y, x = np.mgrid[: shape[0], : shape[1]]
    slopes = rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(float), device)
    directions = np.column_stack([slopes, np.ones(len(slopes))])
    eye = inverse(pose)
    depth = surface(eye.t_mm, directions @ eye.R.T)
    world = eye.t_mm + depth[:, None] * (directions @ eye.R.T)
    uv = project(world, light, light_pose)
    lit = (
        (uv >= 0).all(axis=1) & (uv[:, 0] <= light.width_px - 1) & (uv[:, 1] <= light.height_px - 1)
    )
    lit &= ~hidden(surface, world, inverse(light_pose).t_mm)
    uv[~lit] = np.nan
    points = np.where(lit[:, None], directions * depth[:, None], np.nan)
    return View(uv[:, 0].reshape(shape), uv[:, 1].reshape(shape), points.reshape(*shape, 3))


def hidden(surface: Surface, world_mm: np.ndarray, eye_mm: np.ndarray) -> np.ndarray:
    """Tell which points have the surface itself between them and the eye."""
    return ~(surface(eye_mm, world_mm - eye_mm) > 1 - 1e-6)


def seen_by_other(
    surface: Surface,
    reference: View,
    pose: RigidTransform,
    other: Pinhole,
    other_pose: RigidTransform,
) -> np.ndarray:
    """Tell which reference pixels show a lit point that the other camera sees, not at its border."""
    points = reference.points_mm.reshape(-1, 3)
    eye = inverse(pose)
    pixels = project(points, other, compose(other_pose, eye))
    size = np.array([other.width_px, other.height_px])
    inside = ((pixels >= 1) & (pixels <= size - 2)).all(axis=1)
    world = points @ eye.R.T + eye.t_mm
    return (inside & ~hidden(surface, world, inverse(other_pose).t_mm)).reshape(
        reference.u_px.shape
    )
