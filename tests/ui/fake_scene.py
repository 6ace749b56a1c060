"""Plausible results of a scan that never took place: test equipment for the user interface.

A table with a bright bust, three blocks and a dark book, seen by two cameras. Nothing here is measured or
computed by the application; the pictures only have to look like what the real stages make.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

FOCAL_IN_WIDTHS = 1.9
BASELINE_MM = 180.0
DISTANCE_MM = 700.0
CAMERAS = ("left", "right")
PERIODS = 70.0
EXPOSURES_MS = (8.333333, 33.333333, 125.0)


@dataclass(frozen=True)
class Scene:
    """What two cameras of this size would see."""

    width_px: int
    height_px: int

    @cached_property
    def toe_in_rad(self) -> float:
        """Angle between the optical axes of the two cameras."""
        return 2.0 * float(np.arctan(0.5 * BASELINE_MM / DISTANCE_MM))

    def intrinsics(self) -> Array:
        """Return the intrinsic matrix that both cameras have."""
        f = FOCAL_IN_WIDTHS * self.width_px
        return np.array(
            [[f, 0, (self.width_px - 1) / 2], [0, f, (self.height_px - 1) / 2], [0, 0, 1.0]]
        )

    def right_from_left(self) -> tuple[Array, Array]:
        """Return R and t of the right camera."""
        c, s = np.cos(self.toe_in_rad), np.sin(self.toe_in_rad)
        R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        half = self.toe_in_rad / 2
        centre = BASELINE_MM * np.array([np.cos(half), 0.0, np.sin(half)])
        return R, -R @ centre

    def points_mm(self, camera: str) -> Array:
        """Return the surface point that each pixel of a camera sees, in the left camera's frame."""
        return self._seen[camera][0]

    def albedo(self, camera: str) -> Array:
        """Return the albedo at each pixel."""
        return self._seen[camera][1]

    @cached_property
    def _seen(self) -> dict[str, tuple[Array, Array]]:
        return {camera: self._look(camera) for camera in CAMERAS}

    def _look(self, camera: str) -> tuple[Array, Array]:
        v, u = np.mgrid[0 : self.height_px, 0 : self.width_px].astype(np.float64)
        K = self.intrinsics()
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
        origin = np.zeros(3)
        if camera == "right":
            R, t = self.right_from_left()
            rays, origin = rays @ R, -R.T @ t
        depth = np.full(u.shape, DISTANCE_MM)
        for _ in range(12):  # the surface is a height above the table: walk along the ray
            points = origin + rays * depth[..., None]
            height, _ = _surface(points)
            depth += (DISTANCE_MM + 25.0 - height - points[..., 2]) / rays[..., 2]
        points = origin + rays * depth[..., None]
        return points, _surface(points)[1]

    def white(self, camera: str, exposure_ms: float) -> Array:
        """Return a picture of the white field."""
        rng = np.random.default_rng(7 + len(camera))
        gray = 5.6 * exposure_ms * self.albedo(camera) * self._shading(camera) + 4.0
        gray = gray + rng.normal(0.0, 1.2 + 0.05 * np.sqrt(np.maximum(gray, 0.0)))
        return np.clip(gray, 0, 255).astype(np.uint8)

    def _shading(self, camera: str) -> Array:
        points = self.points_mm(camera)
        normal: Array = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
        return np.asarray(0.45 + 0.55 * np.abs(normal[..., 2]))

    def code(self, camera: str) -> Array:
        """Return the projector's column, 0..1, that lights each pixel."""
        points = self.points_mm(camera)
        x = (points[..., 0] - 0.5 * BASELINE_MM) / points[..., 2]
        return np.clip(0.5 + 0.95 * (x + 0.13), 0.0, 1.0)

    def absolute_phase_rad(self, camera: str) -> Array:
        """Return the unwrapped phase, NaN where there is none."""
        phase = 2.0 * np.pi * PERIODS * self.code(camera)
        return np.asarray(np.where(self.reasons(camera) == 0, phase, np.nan), dtype=np.float32)

    def wrapped_phase_rad(self, camera: str) -> Array:
        """Return the wrapped phase."""
        phase = 2.0 * np.pi * PERIODS * self.code(camera)
        return np.asarray(np.angle(np.exp(1j * phase)), dtype=np.float32)

    def modulation_gray(self, camera: str) -> Array:
        """Return the amplitude of the fringes."""
        return (90.0 * self.albedo(camera) ** 0.3 * self._shading(camera)).astype(np.float32)

    def reasons(self, camera: str) -> Array:
        """Return why a pixel has no phase, as bits."""
        rng = np.random.default_rng(3)
        albedo = self.albedo(camera)
        dark = (albedo < 0.1) & (rng.random(albedo.shape) < 0.04)
        bright = (albedo > 0.8) & (rng.random(albedo.shape) < 0.002)
        edge = np.hypot(*np.gradient(self.points_mm(camera)[..., 2])) > 6.0
        return np.asarray(dark * 1 + bright * 2 + edge * 4, dtype=np.uint8)

    def exposure_index(self, camera: str) -> Array:
        """Return which exposure serves each pixel, 1 is the shortest."""
        albedo = self.albedo(camera)
        return np.select([albedo > 0.6, albedo > 0.2], [1, 2], 3).astype(np.uint8)


def _surface(points: Array) -> tuple[Array, Array]:
    """Return height above the table [mm] and albedo of the scene at x, y."""
    x, y = points[..., 0] - 0.5 * BASELINE_MM * 0.35, points[..., 1]
    height, albedo = np.zeros_like(x), np.full_like(x, 0.36)
    r = np.hypot(x + 60.0, (y + 5.0) * 0.85)
    dome = np.sqrt(np.maximum(55.0**2 - r**2, 0.0))
    features = 5.0 * np.cos(0.32 * (x + 60.0)) * np.cos(0.28 * y) * (r < 45.0)
    height, albedo = np.where(r < 55, dome + features, height), np.where(r < 55, 0.85, albedo)
    for cx, cy, size, tall in (
        (50.0, -45.0, 18.0, 40.0),
        (85.0, 0.0, 14.0, 25.0),
        (45.0, 20.0, 11.0, 15.0),
    ):
        inside = (np.abs(x - cx) < size) & (np.abs(y - cy) < size)
        height, albedo = np.where(inside, tall, height), np.where(inside, 0.62, albedo)
    book = (np.abs(x - 62.0) < 55.0) & (np.abs(y - 62.0) < 22.0)
    return np.where(book, 12.0, height), np.where(book, 0.05, albedo)


@cache
def scene(width_px: int = 640, height_px: int = 480) -> Scene:
    """Return the scene, made once."""
    return Scene(width_px, height_px)
