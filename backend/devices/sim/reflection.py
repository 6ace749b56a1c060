"""Rays from camera pixels by way of a mirror to a screen, in double precision."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from backend.devices.sim.lcd_layout import LcdLayout, bow_mm
from backend.devices.sim.mirrors import Mirror, Outline, Surface
from backend.numerics.camera_model import Pinhole, rays

_NEWTON_STEPS = 20
_CLOSE_MM = 1e-10
_MARGIN_PX = 3.0


@dataclass(frozen=True)
class Reflected:
    """What the rays of a camera's pixel centres meet; NaN where they miss the mirror by more than a few pixels.

    Lengths in the mirror's frame, in [mm].
    """

    points_mm: Float64[np.ndarray, "h w 3"]
    """On the mirror."""
    slopes: Float64[np.ndarray, "h w 2"]
    """dz/dx and dz/dy there."""
    inside_mm: Float64[np.ndarray, "h w"]
    """Distance from the mirror's edge, positive on it; -inf far outside."""
    shares: Float64[np.ndarray, "h w 2"]
    """Position in the pattern, in [0, 1] on the screen; NaN where the ray leaves away from the screen."""
    incidence: Float64[np.ndarray, "h w"]
    """Cosine of the angle at which the ray meets the screen."""


def reflect(
    towards: Float64[np.ndarray, "n 3"], slopes: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 3"]:
    """Reflect directions at a surface z(x, y) of given slopes: d - 2 (d.n) n.

    Examples
    --------
    >>> reflect(np.array([[0.6, 0.0, -0.8]]), np.zeros((1, 2)))
    array([[0.6, 0. , 0.8]])
    """
    normals = np.column_stack([-slopes, np.ones(len(slopes))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    along = np.einsum("ij,ij->i", towards, normals)
    return np.asarray(towards - 2.0 * along[:, None] * normals)


def meet(
    surface: Surface, origin_mm: Float64[np.ndarray, "3"], towards: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]:
    """Return where rays from one point meet a surface z(x, y), to 1e-10 mm, and its slopes there.

    Newton's method from the plane z = 0. It converges for surfaces that no ray touches at a grazing angle.
    """
    along = -origin_mm[2] / towards[:, 2]
    slopes = np.zeros((len(towards), 2))
    for _ in range(_NEWTON_STEPS):
        points = origin_mm + along[:, None] * towards
        relief = surface.relief(points[:, 0], points[:, 1])
        slopes = np.column_stack([relief.slope_x, relief.slope_y])
        above = points[:, 2] - relief.height_mm
        step = above / (towards[:, 2] - np.einsum("ij,ij->i", slopes, towards[:, :2]))
        along -= step
        if not np.abs(above).max(initial=0.0) > _CLOSE_MM:
            break
    return np.asarray(origin_mm + along[:, None] * towards), slopes


def see(
    layout: LcdLayout, mirror: Mirror, screen_mm: tuple[float, float], screen_bow_mm: float
) -> Reflected:
    """Follow the ray of every pixel's centre over the mirror to the screen."""
    width, height = layout.camera.width_px, layout.camera.height_px
    towards = _pixel_directions(layout)
    origin = layout.mirror_from_camera.t_mm
    near = _near(mirror.outline, origin, towards, layout)
    points, slopes = meet(mirror.surface, origin, towards[near])
    shares, incidence = _on_screen(
        layout, points, reflect(towards[near], slopes), screen_mm, screen_bow_mm
    )
    inside = mirror.outline.inside_mm(points[:, 0], points[:, 1])

    def spread(values: Float64[np.ndarray, "m k"], fill: float) -> Float64[np.ndarray, "h w k"]:
        full = np.full((height * width, values.shape[1]), fill)
        full[near] = values
        return full.reshape(height, width, values.shape[1])

    return Reflected(
        points_mm=spread(points, np.nan),
        slopes=spread(slopes, np.nan),
        inside_mm=spread(inside[:, None], -np.inf)[..., 0],
        shares=spread(shares, np.nan),
        incidence=spread(incidence[:, None], np.nan)[..., 0],
    )


def _pixel_directions(layout: LcdLayout) -> Float64[np.ndarray, "n 3"]:
    """Return unit directions of all pixels in the mirror's frame, row by row."""
    model = layout.camera
    y, x = np.mgrid[: model.height_px, : model.width_px]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    camera = Pinhole(model.K, model.distortion, model.width_px, model.height_px)
    directions = np.column_stack([rays(pixels, camera), np.ones(len(pixels))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(directions @ layout.mirror_from_camera.R.T)


def _near(
    outline: Outline,
    origin: Float64[np.ndarray, "3"],
    towards: Float64[np.ndarray, "n 3"],
    layout: LcdLayout,
) -> Bool[np.ndarray, "n"]:
    """Choose the rays that may meet the mirror: a bulging one is met beside where its plane is."""
    pixel_mm = np.linalg.norm(origin) / layout.camera.K[0, 0]
    margin = _MARGIN_PX * pixel_mm + 0.05 * outline.width_mm
    down = towards[:, 2] < -1e-3
    along = np.where(down, -origin[2] / np.where(down, towards[:, 2], -1.0), 0.0)
    x, y = (origin[k] + along * towards[:, k] for k in (0, 1))
    return np.asarray(down & (outline.inside_mm(x, y) > -margin))


def _on_screen(
    layout: LcdLayout,
    points: Float64[np.ndarray, "n 3"],
    towards: Float64[np.ndarray, "n 3"],
    screen_mm: tuple[float, float],
    bow: float,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n"]]:
    pose = layout.screen_from_mirror
    start, way = points @ pose.R.T + pose.t_mm, towards @ pose.R.T
    meets = way[:, 2] > 1e-6
    along = np.where(meets, -start[:, 2] / np.where(meets, way[:, 2], 1.0), np.nan)
    for _ in range(_NEWTON_STEPS if bow else 0):
        x = (start[:, 0] + along * way[:, 0]) / screen_mm[0] + 0.5
        behind = start[:, 2] + along * way[:, 2] - bow_mm(x, bow)
        slope = -4.0 * bow * (2.0 * x - 1.0) / screen_mm[0]
        along = along - behind / (way[:, 2] - slope * way[:, 0])
    hit = start + along[:, None] * way
    return hit[:, :2] / np.asarray(screen_mm) + 0.5, np.where(meets, way[:, 2], np.nan)
