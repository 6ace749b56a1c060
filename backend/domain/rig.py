"""What a method may know of a rig: its facts, and its calibration. Both are `given` to every method."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class PinholeModel:
    """A camera or projector as OpenCV models it, pixel centres at integers."""

    width_px: int
    height_px: int
    K: Float[np.ndarray, "3 3"]
    """Intrinsic matrix in [px]."""
    distortion: Float[np.ndarray, "n_coefficients"] = field(default_factory=lambda: np.zeros(5))
    """OpenCV's k1 k2 p1 p2 k3 (or a longer set in OpenCV's order), no unit."""


@dataclass(frozen=True)
class Pose:
    """A rigid transform x_to = R x_from + t."""

    R: Float[np.ndarray, "3 3"]
    t_mm: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class ScreenModel:
    """A display as a measured surface: where points of the pattern lie, in the screen's own frame.

    Four corners describe a flat screen; between points the surface is interpolated.
    Frame: +X to the right and +Y down on the screen as its viewer sees it, +Z away from the viewer, in mm.
    """

    shares: Float[np.ndarray, "n 2"]
    """Position in the pattern, x and y in [0, 1], of every known point."""
    points_mm: Float[np.ndarray, "n 3"]
    """The same points on the surface."""


@dataclass(frozen=True)
class RigCalibration:
    """Where the rig's devices are and how they see; whatever of it the rig has.

    The world is the reference camera's frame unless `camera_from_world` says otherwise:
    +Z forward, +X right, +Y down, in mm.
    """

    cameras: Mapping[str, PinholeModel]
    camera_from_world: Mapping[str, Pose]
    reference: str
    """Name of the reference camera: one point per pixel of this camera."""
    projector: PinholeModel | None = None
    projector_from_world: Pose | None = None
    screen: ScreenModel | None = None
    """The display of a rig that looks at its screen through the part."""
    screen_from_world: Pose | None = None
    mirror_from_world: Pose | None = None
    """Frame of the mirror under test: origin at its middle, +X right and +Y up as seen from its front, +Z towards the viewer."""


@dataclass(frozen=True)
class CameraFacts:
    """What is known of a camera before it takes a picture."""

    width_px: int
    height_px: int
    bit_depth: int
    exposure_min_ms: float
    exposure_max_ms: float
    black_level_gray: float
    full_well_e: float
    """Electrons at full scale, at gain 0 dB."""
    read_noise_e: float
    """Standard deviation of a dark pixel, in electrons."""
    gain_max_db: float = 0.0

    @property
    def full_scale_gray(self) -> float:
        """The largest gray level, 255 for 8 bit."""
        return float(2**self.bit_depth - 1)


@dataclass(frozen=True)
class ProjectorFacts:
    """What is known of the projector (or screen)."""

    width_px: int
    height_px: int
    frame_period_ms: float | None = None
    """Exposures are multiples of this; None: the projector's light is steady or unknown."""
    gamma: float = 1.0
    """Light is proportional to (code/255)**gamma; 1 means linear or not known."""


@dataclass(frozen=True)
class RigFacts:
    """Sizes, ranges and noise of a rig: always there, whether it is hardware, simulated or a folder of files."""

    cameras: Mapping[str, CameraFacts]
    reference: str
    projector: ProjectorFacts | None = None
