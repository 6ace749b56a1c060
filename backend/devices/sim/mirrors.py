"""Mirrors of the simulated rig: their surface, slope and outline.

Frame of a mirror: origin at its middle, +X right and +Y up as seen from its front, +Z towards the viewer, in mm.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import RectBivariateSpline

from backend.devices.errors import RigConfigError
from backend.devices.sim.lcd_config import SimulatedLcdConfig

SCENES = ("mirror-flat", "mirror-parabola", "mirror-dent", "mirror-dent-flat", "mirror-freeform")
_DENT_UM = 5.0


class Relief(NamedTuple):
    """A surface at some places."""

    height_mm: Float64[np.ndarray, "n"]
    slope_x: Float64[np.ndarray, "n"]
    slope_y: Float64[np.ndarray, "n"]


@runtime_checkable
class Surface(Protocol):
    """A surface z(x, y)."""

    def relief(self, x_mm: Float64[np.ndarray, "n"], y_mm: Float64[np.ndarray, "n"]) -> Relief:
        """Return height and slopes."""
        ...


@dataclass(frozen=True)
class Paraboloid:
    """z = x^2 / 4 fx + y^2 / 4 fy; infinite focal lengths make a plane."""

    focal_x_mm: float
    focal_y_mm: float

    def relief(self, x_mm: Float64[np.ndarray, "n"], y_mm: Float64[np.ndarray, "n"]) -> Relief:
        """Return height and slopes."""
        slope_x, slope_y = x_mm / (2.0 * self.focal_x_mm), y_mm / (2.0 * self.focal_y_mm)
        return Relief(0.5 * (x_mm * slope_x + y_mm * slope_y), slope_x, slope_y)


PLANE = Paraboloid(np.inf, np.inf)


@dataclass(frozen=True)
class Dent:
    """z = -depth (1 - r^2/R^2)^3 within R: height, slope and curvature are continuous."""

    depth_mm: float
    radius_mm: float
    x_mm: float
    y_mm: float

    def relief(self, x_mm: Float64[np.ndarray, "n"], y_mm: Float64[np.ndarray, "n"]) -> Relief:
        """Return height and slopes."""
        dx, dy = x_mm - self.x_mm, y_mm - self.y_mm
        inner = np.maximum(1.0 - (dx**2 + dy**2) / self.radius_mm**2, 0.0)
        steep = 6.0 * self.depth_mm / self.radius_mm**2 * inner**2
        return Relief(-self.depth_mm * inner**3, steep * dx, steep * dy)


@dataclass(frozen=True)
class HeightMap:
    """A cubic spline through heights on a grid: curvature is continuous."""

    spline: RectBivariateSpline

    def relief(self, x_mm: Float64[np.ndarray, "n"], y_mm: Float64[np.ndarray, "n"]) -> Relief:
        """Return height and slopes."""
        return Relief(
            self.spline.ev(y_mm, x_mm),
            self.spline.ev(y_mm, x_mm, dy=1),
            self.spline.ev(y_mm, x_mm, dx=1),
        )


@dataclass(frozen=True)
class Together:
    """One surface on top of another."""

    below: Surface
    above: Surface

    def relief(self, x_mm: Float64[np.ndarray, "n"], y_mm: Float64[np.ndarray, "n"]) -> Relief:
        """Return height and slopes."""
        both = zip(self.below.relief(x_mm, y_mm), self.above.relief(x_mm, y_mm), strict=True)
        return Relief(*(a + b for a, b in both))


@dataclass(frozen=True)
class Outline:
    """Where a mirror ends."""

    width_mm: float
    height_mm: float
    round: bool

    def inside_mm(
        self, x_mm: Float[np.ndarray, "..."], y_mm: Float[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """Return the distance to the edge, positive inside."""
        if self.round:
            return np.asarray(self.width_mm / 2 - np.hypot(x_mm, y_mm))
        across = self.width_mm / 2 - np.abs(x_mm)
        return np.asarray(np.minimum(across, self.height_mm / 2 - np.abs(y_mm)))


@dataclass(frozen=True)
class Mirror:
    """A mirror under test."""

    surface: Surface
    outline: Outline


def mirror(config: SimulatedLcdConfig) -> Mirror:
    """Make the mirror of a configuration.

    Raises
    ------
    RigConfigError
        If there is no such scene, or its file holds no heights.
    """
    check_mirror(config.scene)
    outline = Outline(
        config.mirror_width_mm,
        config.mirror_width_mm if config.outline == "circle" else config.mirror_height_mm,
        config.outline == "circle",
    )
    if config.scene.startswith("mirror:"):
        outline = Outline(config.mirror_width_mm, config.mirror_height_mm, round=False)
        heights_mm = heights_of(Path(config.scene.removeprefix("mirror:")))
        return Mirror(_dented(height_map(heights_mm, outline), config), outline)
    if config.scene == "mirror-freeform":
        return Mirror(_dented(height_map(freeform_mm(outline), outline), config), outline)
    flat = config.scene in ("mirror-flat", "mirror-dent-flat")
    base = PLANE if flat else Paraboloid(config.focal_x_mm, config.focal_y_mm)
    return Mirror(_dented(base, config), outline)


def check_mirror(scene: str) -> None:
    """Refuse a scene that isn't one; whether a file can be read shows when it is.

    Raises
    ------
    RigConfigError
        If it isn't.
    """
    if scene not in SCENES and not scene.startswith("mirror:"):
        raise RigConfigError(
            f"simulated rig: there is no mirror {scene!r}; choose {', '.join(SCENES)} or mirror:FILE"
        )


def _dented(surface: Surface, config: SimulatedLcdConfig) -> Surface:
    usual = _DENT_UM if "dent" in config.scene.partition(":")[0] else 0.0
    depth_um = usual if config.dent_depth_um is None else config.dent_depth_um
    if depth_um == 0:
        return surface
    return Together(surface, Dent(1e-3 * depth_um, config.dent_diameter_mm / 2, *config.dent_at_mm))


def freeform_mm(outline: Outline) -> Float64[np.ndarray, "h w"]:
    """Return the built-in height map: a bowl with astigmatism, coma and a ripple, from the top row down."""
    y, x = np.meshgrid(np.linspace(1, -1, 181), np.linspace(-1, 1, 181), indexing="ij")
    scale = outline.width_mm / 150.0
    shape = 0.9 * (x**2 + y**2) + 0.12 * (x**2 - y**2) + 0.08 * x * y
    coma_and_ripple = 0.05 * x * (x**2 + y**2) + 0.002 * np.sin(9.0 * x + 4.0 * y)
    return np.asarray(scale * (shape + coma_and_ripple))


def height_map(heights_mm: Float[np.ndarray, "h w"], outline: Outline) -> HeightMap:
    """Lay heights over the outline's rectangle, first row at the top, first and last at its edges."""
    rows, columns = heights_mm.shape
    y = np.linspace(-outline.height_mm / 2, outline.height_mm / 2, rows)
    x = np.linspace(-outline.width_mm / 2, outline.width_mm / 2, columns)
    return HeightMap(RectBivariateSpline(y, x, heights_mm[::-1], s=0))


def heights_of(file: Path) -> Float64[np.ndarray, "h w"]:
    """Read a grid of heights in [mm], at least 4 x 4.

    Raises
    ------
    RigConfigError
        If the file can't be read, isn't a grid of numbers, or has holes.
    """
    try:
        text = file.suffix.lower() == ".csv"
        heights = np.loadtxt(file, delimiter=",", ndmin=2) if text else np.load(file)
        heights = np.asarray(heights, np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise RigConfigError(
            f"simulated rig: {file} can't be read as heights ({error}); give a .npy or .csv grid in mm"
        ) from error
    holes = not bool(np.isfinite(heights).all())
    if heights.ndim != 2 or min(heights.shape) < 4 or holes:
        size = "x".join(map(str, heights.shape))
        raise RigConfigError(
            f"simulated rig: {file} holds {size} heights{' with holes' if holes else ''};"
            " give a grid of 4x4 or more finite numbers in mm"
        )
    return heights
