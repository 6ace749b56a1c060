"""A scene before a rig's lenses, ray-cast once and kept: opening the same rig again costs nothing."""

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.kept import Kept
from backend.devices.sim.layout import Layout, View, layout
from backend.devices.sim.rays import pixel_rays, project
from backend.devices.sim.scenes import scene
from backend.devices.sim.shading import SHADOW_OFFSET_MM, Lighting, surfaces
from backend.devices.sim.transport import Caster, Transport, cast
from backend.numerics.scoring import Truth, edge_band

_GEOMETRY = (
    *("scene", "cameras", "size", "projector_size", "samples"),
    *("baseline_mm", "distance_mm", "projector_above_mm"),
    *("camera_focal_per_width", "projector_focal_per_width"),
    *("camera_distortion", "projector_distortion"),
)
"""Settings that a cast depends on."""


class World:
    """What every camera sees of a scene and of the projector's light, and the truth behind it."""

    def __init__(self, config: SimulatedRigConfig) -> None:
        self.layout: Layout = layout(config)
        self._parts = scene(config.scene)
        self._caster = Caster(surfaces(self._parts, config.distance_mm), self.layout.projector)
        self.transports: dict[str, Transport] = {
            name: cast(self._caster, camera, config.samples)
            for name, camera in self.layout.cameras.items()
        }
        self._truths: dict[tuple[str, tuple[str, ...]], Truth] = {}
        self._lock = threading.Lock()

    def truth(self, reference: str, cameras: Sequence[str]) -> Truth:
        """Return the truth at the pixel centres of a camera; computed once."""
        key = (reference, tuple(sorted(cameras)))
        with self._lock:
            if key not in self._truths:
                self._truths[key] = self._truth(reference, key[1])
            return self._truths[key]

    def _truth(self, reference: str, cameras: tuple[str, ...]) -> Truth:
        view = self.layout.cameras[reference]
        height, width = view.model.height_px, view.model.width_px
        rays, _ = pixel_rays(view, range(height))
        found, _ = self._caster.light(rays)
        others = [self.layout.cameras[name] for name in cameras if name != reference]
        seen = np.ones(height * width, np.bool_) & (found.part >= 0)
        for other in others:
            seen &= self._seen(found, other)
        pose = view.device_from_rig
        R, t = pose.R.astype(np.float32), pose.t_mm.astype(np.float32)
        points = (found.point_mm @ R.T + t).reshape(height, width, 3)
        normals = (found.normal @ R.T).reshape(height, width, 3)
        lit, seen = found.lit.reshape(height, width), seen.reshape(height, width)
        return Truth(
            points_mm=points,
            normals=normals,
            lit_and_seen=lit & seen,
            edge_band=edge_band(points, normals, lit, seen),
            part=found.part.reshape(height, width),
            part_names=tuple(part.name for part in self._parts.parts),
        )

    def _seen(self, found: Lighting, camera: View) -> Bool[np.ndarray, "n"]:
        seen = np.zeros(len(found.part), np.bool_)
        pixel = np.flatnonzero(found.part >= 0)
        start = found.point_mm[pixel] + SHADOW_OFFSET_MM * found.normal[pixel]
        _, _, inside = project(start, camera)
        towards = camera.position_mm.astype(np.float32) - start
        facing = (towards * found.normal[pixel]).sum(axis=1) > 0
        rays = np.hstack([start, towards]).astype(np.float32)
        seen[pixel] = inside & facing & ~self._caster.blocked(rays)
        return seen


_worlds = Kept[World](most=3)


def world(config: SimulatedRigConfig) -> World:
    """Return the world of a configuration, cast now or, if one of the last few was like it, before.

    Raises
    ------
    RigConfigError
        If the scene's mesh or material table can't be read.
    """
    key = (*(getattr(config, name) for name in _GEOMETRY), _stamps(config.scene))
    return _worlds.get(key, lambda: World(config))


def _stamps(scene_name: str) -> tuple[int, ...]:
    """Return the times of change of a mesh scene's files, so that an edited file is read again."""
    _, is_mesh, rest = scene_name.partition("mesh:")
    files = [Path(name) for name in rest.split("?")] if is_mesh else []
    return tuple(file.stat().st_mtime_ns for file in files if file.is_file())
