"""How far a measured cloud is from the truth, where the truth is known: completeness, outliers, error."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, Integer

from backend.numerics.errors import NumericsError

DEFINITION = (
    "Base: pixels of the reference camera that the projector lights and every camera used sees, "
    "without those within 2 px of an occlusion or shadow edge (counted apart). "
    "Error: distance between the point and the true surface along the same pixel's ray. "
    "Outlier: accepted with error > 0.5 mm. "
    "Completeness: share of the base with a point that is no outlier; outlier share: outliers among "
    "the points accepted in the base; rms, mean and median: over the points that are no outliers."
)
"""What the figures mean, for the report's help."""


@dataclass(frozen=True)
class Truth:
    """The true surface behind every pixel of the reference camera, in its frame."""

    points_mm: Float32[np.ndarray, "h w 3"]
    """Where the ray of the pixel's centre hits the surface; NaN where it hits nothing."""
    normals: Float32[np.ndarray, "h w 3"]
    """Unit normal there, towards the camera; NaN where there is no surface."""
    lit_and_seen: Bool[np.ndarray, "h w"]
    """The projector lights the point and every camera used sees it."""
    edge_band: Bool[np.ndarray, "h w"]
    """Within 2 px of an occlusion or shadow edge; counted apart."""
    part: Int16[np.ndarray, "h w"]
    """Index into `part_names`; -1 where there is no surface."""
    part_names: tuple[str, ...]

    @property
    def base(self) -> Bool[np.ndarray, "h w"]:
        """The pixels that completeness is counted over."""
        base: Bool[np.ndarray, "h w"] = self.lit_and_seen & ~self.edge_band
        return base


class Score(NamedTuple):
    """Figures of one cloud, or of one part of it. Shares in [0, 1], NaN where there is nothing to count."""

    base: int
    """Pixels that completeness is counted over."""
    accepted: int
    """Points that the cloud has there."""
    completeness: float
    """Share of the base with a point whose error is at most the outlier limit."""
    outlier_share: float
    """Share of the accepted points whose error is above the outlier limit."""
    rms_mm: float
    """Root mean square of the errors that are no outliers, in [mm]."""
    mean_mm: float
    """Mean of their absolute values, in [mm]."""
    median_mm: float
    """Median of their absolute values, in [mm]."""
    bias_mm: float
    """Mean of the signed errors, in [mm]; positive: behind the surface."""


@dataclass(frozen=True)
class Scores:
    """A cloud against the truth, as a whole and per part of the scene."""

    total: Score
    parts: dict[str, Score]
    edge_base: int
    """Pixels lit and seen, but within 2 px of an edge."""
    edge_accepted: int
    """Points there; not in the figures above."""
    stray: int
    """Points on pixels that aren't both lit and seen by all; not in the figures above."""


def score(
    points_mm: Float[np.ndarray, "n 3"],
    pixel_x: Integer[np.ndarray, "n"],
    pixel_y: Integer[np.ndarray, "n"],
    truth: Truth,
    *,
    outlier_mm: float = 0.5,
) -> Scores:
    r"""Compare a cloud with the true surface.

    How completeness and error are counted: base = pixels of the reference camera that the
    projector lights and every camera used sees, without those within 2 px of an occlusion or
    shadow edge (counted apart); error = distance between the point and the true surface along
    the same pixel's ray; outlier = accepted with error > 0.5 mm.

    Parameters
    ----------
    points_mm
        Measured points in the reference camera's frame, in [mm]. Points that aren't finite count as missing.
    pixel_x, pixel_y
        The pixel of the reference camera that each point belongs to; at most one point per pixel.
    truth
        The true surface.
    outlier_mm
        Errors above it make a point an outlier, in [mm].

    Returns
    -------
    total
        Figures over the whole base.
    parts
        The same for each part of the scene that has pixels in the base, in the scene's order.
    edge_base, edge_accepted, stray
        What is counted apart.

    Raises
    ------
    NumericsError
        If a pixel lies outside the picture, or two points share one.

    Notes
    -----
    With the ray's unit vector d and the true point q the signed error of a point p is
    :math:`(p - q) \cdot d`: a point that its method put slightly off the ray isn't charged for that.

    Examples
    --------
    A wall at 700 mm, two pixels, one point 0.1 mm behind it:

    >>> wall = np.float32([[[0, 0, 700], [1, 0, 700]]])
    >>> truth = Truth(wall, np.zeros_like(wall), np.ones((1, 2), bool), np.zeros((1, 2), bool),
    ...               np.zeros((1, 2), np.int16), ("wall",))
    >>> scores = score(np.array([[0, 0, 700.1]]), np.array([0]), np.array([0]), truth)
    >>> scores.total.completeness, round(scores.total.rms_mm, 6)
    (0.5, 0.1)
    """
    error_mm = _error_map(points_mm, pixel_x, pixel_y, truth)
    accepted = np.isfinite(error_mm)
    base = truth.base
    parts = {
        name: _score(error_mm, base & (truth.part == index), outlier_mm)
        for index, name in enumerate(truth.part_names)
    }
    edge = truth.lit_and_seen & truth.edge_band
    finite = np.isfinite(points_mm).all(axis=1)
    return Scores(
        total=_score(error_mm, base, outlier_mm),
        parts={name: part for name, part in parts.items() if part.base},
        edge_base=int(edge.sum()),
        edge_accepted=int((edge & accepted).sum()),
        stray=int((finite & ~truth.lit_and_seen[pixel_y, pixel_x]).sum()),
    )


def _error_map(
    points_mm: Float[np.ndarray, "n 3"],
    pixel_x: Integer[np.ndarray, "n"],
    pixel_y: Integer[np.ndarray, "n"],
    truth: Truth,
) -> Float[np.ndarray, "h w"]:
    height, width = truth.part.shape
    inside = (pixel_x >= 0) & (pixel_x < width) & (pixel_y >= 0) & (pixel_y < height)
    if not inside.all():
        first = int(np.argmin(inside))
        raise NumericsError(
            f"point {first} belongs to pixel ({pixel_x[first]}, {pixel_y[first]}), outside the"
            f" {width} x {height} picture; score against the truth of the camera that was used"
        )
    flat = pixel_y.astype(np.int64) * width + pixel_x
    if np.unique(flat).size != flat.size:
        raise NumericsError(
            f"{flat.size} points share {np.unique(flat).size} pixels; give at most one point per pixel"
        )
    true_mm = truth.points_mm.reshape(-1, 3)[flat].astype(np.float64)
    rays = true_mm / np.linalg.norm(true_mm, axis=1, keepdims=True)
    errors = np.full(height * width, np.nan)
    errors[flat] = ((points_mm.astype(np.float64) - true_mm) * rays).sum(axis=1)
    return errors.reshape(height, width)


def _score(
    error_mm: Float[np.ndarray, "h w"], base: Bool[np.ndarray, "h w"], outlier_mm: float
) -> Score:
    n_base = int(base.sum())
    errors = error_mm[base]
    errors = errors[np.isfinite(errors)]
    good = errors[np.abs(errors) <= outlier_mm]
    nan = float("nan")
    return Score(
        base=n_base,
        accepted=errors.size,
        completeness=good.size / n_base if n_base else nan,
        outlier_share=1.0 - good.size / errors.size if errors.size else nan,
        rms_mm=float(np.sqrt(np.mean(good**2))) if good.size else nan,
        mean_mm=float(np.mean(np.abs(good))) if good.size else nan,
        median_mm=float(np.median(np.abs(good))) if good.size else nan,
        bias_mm=float(np.mean(good)) if good.size else nan,
    )


def edge_band(
    points_mm: Float32[np.ndarray, "h w 3"],
    normals: Float32[np.ndarray, "h w 3"],
    lit: Bool[np.ndarray, "h w"],
    seen: Bool[np.ndarray, "h w"],
    *,
    width_px: int = 2,
    jump_mm: float = 1.0,
) -> Bool[np.ndarray, "h w"]:
    """Mark the pixels near an occlusion or shadow edge.

    Parameters
    ----------
    points_mm, normals
        True surface behind each pixel, in the reference camera's frame; NaN where there is none.
    lit
        The projector lights the point.
    seen
        The other cameras see the point.
    width_px
        Pixels whose centre is nearer than this (the larger of dx and dy) to an edge are marked, in [px];
        an edge runs midway between two pixels, so 2 marks two pixels on either side.
    jump_mm
        Neighbours whose rays miss each other's tangent plane by more than this (and by more
        than 3 pixel pitches) lie on either side of an occlusion edge, in [mm].

    Returns
    -------
    True within the band. Both pixels beside an edge are in it.

    Notes
    -----
    The tangent planes make the test blind to slope: a steep plane isn't an edge, and neither is a
    crease, because there one of the two planes predicts its neighbour.
    """
    edges = np.zeros(lit.shape, bool)
    surface = np.isfinite(points_mm[..., 2])
    for axis in (0, 1):
        near, far = _neighbours(axis)
        cut = _jump(points_mm, normals, near, far, jump_mm)
        for mask in (surface, lit, seen):
            cut |= mask[near] != mask[far]
        edges[near] |= cut
        edges[far] |= cut
    # Both pixels beside the edge are half a pixel from it already.
    for _ in range(width_px - 1):
        edges = _grown(_grown(edges, 0), 1)
    return edges


def _grown(mask: Bool[np.ndarray, "h w"], axis: int) -> Bool[np.ndarray, "h w"]:
    """Also mark both neighbours along an axis."""
    near, far = _neighbours(axis)
    grown = mask.copy()
    grown[near] |= mask[far]
    grown[far] |= mask[near]
    return grown


def _neighbours(axis: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    whole, head, tail = slice(None), slice(None, -1), slice(1, None)
    return ((head, whole), (tail, whole)) if axis == 0 else ((whole, head), (whole, tail))


def _jump(
    points_mm: Float32[np.ndarray, "h w 3"],
    normals: Float32[np.ndarray, "h w 3"],
    near: tuple[slice, slice],
    far: tuple[slice, slice],
    jump_mm: float,
) -> Bool[np.ndarray, "_h _w"]:
    p, q, n_p, n_q = points_mm[near], points_mm[far], normals[near], normals[far]
    pitch_mm = np.linalg.norm(np.cross(p, q), axis=-1) / np.maximum(
        np.linalg.norm(p, axis=-1), 1e-6
    )
    limit = np.maximum(jump_mm, 3.0 * pitch_mm)
    with np.errstate(invalid="ignore", divide="ignore"):
        off_q = np.abs(1.0 - (p * n_p).sum(-1) / (q * n_p).sum(-1)) * np.linalg.norm(q, axis=-1)
        off_p = np.abs(1.0 - (q * n_q).sum(-1) / (p * n_q).sum(-1)) * np.linalg.norm(p, axis=-1)
        cut: Bool[np.ndarray, "_h _w"] = np.minimum(off_p, off_q) > limit
    return cut
