"""Where camera, mirror and screen of the simulated mirror rig stand."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from backend.devices.sim.layout import looking_at
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.domain.rig import PinholeModel, Pose, ScreenModel

_DECENTRE = (0.003, -0.002)
"""Real lenses aren't centred on their sensors: as shares of the width."""
_BENT_COLUMNS = 129
_DOWN_IN_MIRROR = (0.0, -1.0, 0.0)
"""The mirror's +Y is up."""


@dataclass(frozen=True)
class LcdLayout:
    """The rig in the camera's frame, which is the world: +X right, +Y down, +Z forward."""

    camera: PinholeModel
    mirror_from_camera: Pose
    screen_from_camera: Pose
    screen_from_mirror: Pose


def lcd_layout(config: SimulatedLcdConfig) -> LcdLayout:
    """Place camera below and screen above the mirror's normal, both facing the mirror."""
    up = np.deg2rad(config.angle_deg)
    camera_mm = config.camera_distance_mm * np.array([0.0, -np.sin(up), np.cos(up)])
    camera = looking_at(camera_mm, np.array([*config.aim_mm, 0.0]), down=_DOWN_IN_MIRROR)
    screen = _screen(config, up)
    mirror_from_camera = _inverse(camera)
    return LcdLayout(
        camera=_pinhole(config),
        mirror_from_camera=mirror_from_camera,
        screen_from_camera=_after(screen, mirror_from_camera),
        screen_from_mirror=screen,
    )


def screen_model(config: SimulatedLcdConfig) -> ScreenModel:
    """Return the screen's shape: four corners, or a grid if it is bent."""
    columns = 2 if config.screen_bow_mm == 0 else _BENT_COLUMNS
    y, x = np.meshgrid([0.0, 1.0], np.linspace(0.0, 1.0, columns), indexing="ij")
    shares = np.column_stack([x.ravel(), y.ravel()])
    flat_mm = (shares - 0.5) * config.screen_size_mm
    return ScreenModel(
        shares, np.column_stack([flat_mm, bow_mm(shares[:, 0], config.screen_bow_mm)])
    )


def bow_mm(share_x: Float[np.ndarray, "n"], bow: float) -> Float64[np.ndarray, "n"]:
    """Return a bent screen's z: its edges stand before its middle, towards the viewer."""
    return np.asarray(-bow * (2.0 * share_x - 1.0) ** 2, np.float64)


def _screen(config: SimulatedLcdConfig, up: float) -> Pose:
    centre = config.screen_distance_mm * np.array([0.0, np.sin(up), np.cos(up)])
    # Its viewer stands at the mirror and looks along its +Z, upright.
    z = centre / np.linalg.norm(centre)
    x = np.array([-1.0, 0.0, 0.0])
    R = _turned(*np.deg2rad(config.screen_tilt_deg)) @ np.stack([x, np.cross(z, x), z])
    moved = centre + config.screen_offset_mm[0] * R[0] + config.screen_offset_mm[1] * R[1]
    return Pose(R, -R @ moved)


def _turned(about_x: float, about_y: float) -> Float64[np.ndarray, "3 3"]:
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    first = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    second = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return np.asarray(second @ first)


def _inverse(pose: Pose) -> Pose:
    return Pose(pose.R.T, -pose.R.T @ pose.t_mm)


def _after(second: Pose, first: Pose) -> Pose:
    return Pose(second.R @ first.R, second.R @ first.t_mm + second.t_mm)


def _pinhole(config: SimulatedLcdConfig) -> PinholeModel:
    width, height = config.size
    focal = config.camera_focal_per_width * width
    x, y = (width - 1) / 2 + _DECENTRE[0] * width, (height - 1) / 2 + _DECENTRE[1] * width
    K = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
    return PinholeModel(width, height, K, np.array(config.camera_distortion))
