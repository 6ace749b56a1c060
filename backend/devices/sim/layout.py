"""Where the simulated cameras and the projector stand, and how they see."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from backend.devices.sim.config import SimulatedRigConfig
from backend.domain.rig import PinholeModel, Pose

# Real lenses aren't centred on their sensors: as shares of the width.
_DECENTRE = {"left": (0.003, -0.002), "right": (-0.002, 0.0025), "projector": (0.0, 0.0)}


@dataclass(frozen=True)
class View:
    """A camera or projector in the rig's frame: +X right, +Y down, +Z towards the scene, origin between the cameras."""

    model: PinholeModel
    device_from_rig: Pose

    @property
    def position_mm(self) -> Float[np.ndarray, "3"]:
        """Centre of projection in the rig's frame, in [mm]."""
        return np.asarray(-self.device_from_rig.R.T @ self.device_from_rig.t_mm)


@dataclass(frozen=True)
class Layout:
    """All views of a rig."""

    cameras: Mapping[str, View]
    projector: View


def layout(config: SimulatedRigConfig) -> Layout:
    """Place the devices of a configuration; all look at (0, 0, distance)."""
    half = config.baseline_mm / 2
    positions = {"left": (-half, 0.0, 0.0), "right": (half, 0.0, 0.0)}
    cameras = {
        name: _view(
            name, positions[name], config, config.camera_focal_per_width, config.camera_distortion
        )
        for name in list(positions)[: config.cameras]
    }
    projector = _view(
        "projector",
        (0.0, -config.projector_above_mm, 0.0),
        config,
        config.projector_focal_per_width,
        config.projector_distortion,
    )
    return Layout(cameras, projector)


def _view(
    name: str,
    position_mm: tuple[float, float, float],
    config: SimulatedRigConfig,
    focal_per_width: float,
    distortion: tuple[float, ...],
) -> View:
    width, height = config.projector_size if name == "projector" else config.size
    focal = focal_per_width * width
    off_x, off_y = _DECENTRE[name]
    K = np.array(
        [
            [focal, 0.0, (width - 1) / 2 + off_x * width],
            [0.0, focal, (height - 1) / 2 + off_y * width],
            [0.0, 0.0, 1.0],
        ]
    )
    model = PinholeModel(width, height, K, np.array(distortion, np.float64))
    target = np.array([0.0, 0.0, config.distance_mm])
    return View(model, looking_at(np.array(position_mm), target))


def looking_at(
    position_mm: Float[np.ndarray, "3"],
    target_mm: Float[np.ndarray, "3"],
    *,
    down: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Pose:
    """Return the pose of a device that looks at a target with its x axis level."""
    z = (target_mm - position_mm) / np.linalg.norm(target_mm - position_mm)
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ position_mm)


def relative(to: Pose, of: Pose) -> Pose:
    """Return to_from_of for two poses that share their source frame: `to` after the inverse of `of`."""
    R = to.R @ of.R.T
    return Pose(R, to.t_mm - R @ of.t_mm)
