"""A mirror before the rig, its rays followed once and kept: opening the same rig again costs nothing."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from backend.devices.sim.kept import Kept
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.devices.sim.lcd_layout import LcdLayout, lcd_layout
from backend.devices.sim.lcd_light import Footprints, footprints
from backend.devices.sim.mirrors import mirror
from backend.devices.sim.reflection import Reflected, see
from backend.numerics.mirror_scoring import MirrorTruth
from backend.numerics.pinhole import RigidTransform
from backend.numerics.scoring import Truth, edge_band

_GEOMETRY = (
    *("scene", "size", "screen_size", "pixel_pitch_mm", "focal_x_mm", "focal_y_mm", "outline"),
    *("mirror_width_mm", "mirror_height_mm", "dent_depth_um", "dent_diameter_mm", "dent_at_mm"),
    *("camera_distance_mm", "screen_distance_mm", "angle_deg", "aim_mm", "screen_tilt_deg"),
    *("screen_offset_mm", "screen_bow_mm", "camera_focal_per_width", "camera_distortion"),
    *("viewing_loss", "surround_share"),
)
"""Settings that the rays and their weights depend on."""


class LcdWorld:
    """What every pixel sees, and the truth behind it."""

    def __init__(self, config: SimulatedLcdConfig) -> None:
        self.layout: LcdLayout = lcd_layout(config)
        self.seen: Reflected = see(
            self.layout, mirror(config), config.screen_size_mm, config.screen_bow_mm
        )
        self._coverage = self._covered()
        self.footprints: Footprints = footprints(self.seen, self._coverage, config)

    def _covered(self) -> Float64[np.ndarray, "h w"]:
        """Return the share of each pixel on the mirror, by the distance of its centre from the edge."""
        pixel_mm = np.linalg.norm(self.layout.mirror_from_camera.t_mm) / self.layout.camera.K[0, 0]
        return np.asarray(np.clip(0.5 + self.seen.inside_mm / pixel_mm, 0.0, 1.0))

    def mirror_truth(self) -> MirrorTruth:
        """Return slopes and heights in the mirror's frame."""
        on_mirror = self._coverage >= 1
        shares = np.nan_to_num(self.seen.shares, nan=-1.0)
        sees = ((shares >= 0) & (shares <= 1)).all(axis=2)
        pose = self.layout.mirror_from_camera
        return MirrorTruth(
            points_mm=np.where(on_mirror[..., None], self.seen.points_mm, np.nan),
            slopes=np.where(on_mirror, np.moveaxis(self.seen.slopes, 2, 0), np.nan),
            seen=on_mirror & sees,
            mirror_from_camera=RigidTransform(pose.R, pose.t_mm),
        )

    def truth(self) -> Truth:
        """Return the same as points in the camera's frame, as clouds are compared with."""
        exact = self.mirror_truth()
        pose = self.layout.mirror_from_camera
        points = ((exact.points_mm - pose.t_mm) @ pose.R).astype(np.float32)
        normals = (exact.normals @ pose.R).astype(np.float32)
        there = np.isfinite(points[..., 0])
        return Truth(
            points_mm=points,
            normals=normals,
            lit_and_seen=exact.seen,
            edge_band=edge_band(points, normals, there, there),
            part=np.where(there, 0, -1).astype(np.int16),
            part_names=("mirror",),
        )


_worlds = Kept[LcdWorld](most=3)


def lcd_world(config: SimulatedLcdConfig) -> LcdWorld:
    """Return the world of a configuration, made now or, if one of the last few was like it, before.

    Raises
    ------
    RigConfigError
        If the mirror's file can't be read.
    """
    file = Path(config.scene.partition(":")[2] or ".")
    stamp = file.stat().st_mtime_ns if file.is_file() else 0  # an edited file is read again
    key = (*(getattr(config, name) for name in _GEOMETRY), stamp)
    return _worlds.get(key, lambda: LcdWorld(config))
