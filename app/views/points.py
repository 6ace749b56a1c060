"""Points of a cloud: what they can be coloured by, how large to draw them, and which one a click hits."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.client import PointsPreview, ScalarOfPoints
from app.palette import paint

Array = NDArray[Any]

_SAMPLE = 4000
_TRIES = 160
_ENOUGH = 0.2
"""A plane through fewer than this share of the points is no table."""
_NEAR_SHARE = 0.006
"""How near a point has to be to a plane, as a share of the cloud's size."""
_PERCENT = (0.5, 99.5)


@dataclass(frozen=True)
class Mode:
    """One way to colour the points."""

    name: str
    unit: str
    colormap: str
    low: float
    high: float
    values: Array | None
    """None: the cloud's own colour."""


@dataclass(frozen=True)
class Ground:
    """The plane that heights are counted from: up is the unit normal, towards the cameras."""

    up: Array
    offset_mm: float
    is_table: bool
    """True if the plane was found in the points; False: it is the farthest depth."""

    def heights_mm(self, points_mm: Array) -> Array:
        """Return each point's height."""
        return np.asarray(points_mm @ self.up - self.offset_mm, dtype=np.float32)


def find_ground(points_mm: Array, towards_viewer: Array) -> Ground:
    """Find the table in a cloud: the plane that most points lie on and few below.

    Parameters
    ----------
    points_mm
        n x 3.
    towards_viewer
        Unit vector from the scene towards the cameras: used where there is no table.

    Notes
    -----
    Random sampling of three points with a fixed seed, so that every browser gets the same picture. It only turns
    and colours the picture; no result depends on it.
    """
    rng = np.random.default_rng(0)
    some = points_mm[rng.permutation(len(points_mm))[:_SAMPLE]].astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    fallback = _farthest(some, towards_viewer)
    if len(some) < 50:
        return fallback
    near_mm = _NEAR_SHARE * float(np.linalg.norm(np.ptp(some, axis=0)))
    best, best_count = fallback, _ENOUGH * len(some)
    for a, b, c in some[rng.integers(0, len(some), (_TRIES, 3))]:
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < near_mm**2:
            continue
        up = normal / length * np.sign(normal @ towards_viewer or 1.0)
        heights = (some - a) @ up
        on, below = np.abs(heights) < near_mm, heights < -near_mm
        score = np.count_nonzero(on) - 2.0 * np.count_nonzero(below)
        if score > best_count and up @ towards_viewer > 0.3:
            best, best_count = _refined(some[on], up), score
    return best


def _refined(on_plane: Array, up: Array) -> Ground:
    centre = on_plane.mean(axis=0)
    normal = np.linalg.svd(on_plane - centre, full_matrices=False)[2][2]
    normal *= np.sign(normal @ up)
    return Ground(normal, float(centre @ normal), is_table=True)


def _farthest(points_mm: Array, up: Array) -> Ground:
    along = points_mm @ up
    return Ground(
        np.asarray(up, np.float64),
        float(np.percentile(along, 0.5)) if along.size else 0.0,
        is_table=False,
    )


def modes(cloud: PointsPreview, ground: Ground) -> dict[str, Mode]:
    """Return the ways to colour a cloud, in the order of the menu."""
    heights = ground.heights_mm(cloud.points_mm)
    title = (
        "Height above the largest flat surface"
        if ground.is_table
        else "Height above the farthest point"
    )
    ways = {"Height": Mode(title, "mm", "turbo", *_ends(heights), heights)}
    if cloud.colour is not None:
        ways["Intensity"] = Mode("Picture's brightness", "", "gray", 0.0, 255.0, None)
    depth = cloud.points_mm[:, 2]
    ways["Depth"] = Mode("Distance along the camera's axis", "mm", "viridis", *_ends(depth), depth)
    return ways | {s.title: _scalar_mode(s) for s in cloud.scalars}


def _scalar_mode(scalar: ScalarOfPoints) -> Mode:
    high = scalar.high if scalar.high > scalar.low else scalar.low + 1.0
    return Mode(scalar.title, scalar.unit, "viridis", scalar.low, high, scalar.values)


def _ends(values: Array) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, _PERCENT) if finite.size else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


def colours(cloud: PointsPreview, mode: Mode) -> Array:
    """Return n x 3 uint8."""
    if mode.values is None:
        assert cloud.colour is not None, "only a cloud with a colour offers this mode"
        return cloud.colour
    return paint(mode.values, mode.low, mode.high, mode.colormap)


def spacing_mm(points_mm: Array) -> float:
    """Return about how far neighbours are apart: the size to draw points with."""
    if len(points_mm) < 2:
        return 1.0
    low, high = np.percentile(points_mm, [2, 98], axis=0)
    extent = np.sort(high - low)[1:]
    return float(np.sqrt(max(extent[0] * extent[1], 1e-6) / len(points_mm)))


def hit(points_mm: Array, origin_mm: Array, direction: Array, tolerance: float) -> int | None:
    """Return the point that a ray hits, None if it passes all of them.

    Parameters
    ----------
    tolerance
        Largest angle between the ray and the way to the point, as distance per distance.
    """
    along = (points_mm - origin_mm) @ direction
    off = np.linalg.norm(points_mm - origin_mm - along[:, None] * direction, axis=1)
    near = (along > 0) & (off < tolerance * along)
    if not near.any():
        return None
    # Of all points near the ray the first one hides the others.
    cost = np.where(near, along + 20.0 * off, np.inf)
    return int(np.argmin(cost))
