"""How far a measured cloud is from the truth, where the truth is known: completeness, outliers, error."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int16, Int64, Real

from backend.numerics.errors import NumericsError

DEFINITION = (
    "Base: pixels of the reference camera that the projector lights and every camera used sees, "
    "without those within 2 px of an occlusion or shadow edge (counted apart). "
    "Error: distance between the point and the true surface along the same pixel's ray; a point between "
    "pixels has a ray of its own there. "
    "Outlier: accepted with error > 0.5 mm. "
    "Completeness: share of the base with a point that is no outlier, at most half a pixel's diagonal "
    "(0.71 px) from the pixel's centre: a point at a pixel's centre counts for that pixel alone, and any "
    "other for at least one; outlier share: outliers among the points accepted in the base; rms, mean, "
    "standard deviation and median of the distance: over the points that are no outliers. "
    "Over-exposed: share of the base that the method gave up as saturated."
)
"""What the figures mean, for the report's help."""

FOOTPRINT_PX = 0.5**0.5
"""A point counts for the pixels whose centres are this near: no place in a picture is farther from the nearest."""


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
    std_mm: float
    """Standard deviation of their absolute values, in [mm]: rms² = mean² + std²."""
    over_exposed_share: float = float("nan")
    """Share of the base that was given up as saturated; NaN if nobody told."""


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
    pixel_x: Real[np.ndarray, "n"],
    pixel_y: Real[np.ndarray, "n"],
    truth: Truth,
    *,
    over_exposed: Bool[np.ndarray, "h w"] | None = None,
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
        Where the reference camera sees each point, in [px]; between pixels, too, as edges lie there.
    truth
        The true surface.
    over_exposed
        True where a pixel was given up as saturated; None: not known.
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
        If a point lies outside the picture.

    Notes
    -----
    With the ray's unit vector d and the true point q the signed error of a point p is
    :math:`(p - q) \cdot d`: a point that its method put slightly off the ray isn't charged for that.
    Between pixels q comes from the four pixels around: the ray's slopes and 1/z, which is linear in the picture
    where the surface is plane, each interpolated bilinearly.

    A point belongs to the pixel whose centre is nearest (its part, in the base or not), and makes every pixel
    complete whose centre is at most :math:`\sqrt{1/2}` px away, half the diagonal of a pixel. Less, and a point
    at the corner of four pixels would count for none of them; more, and it would count for a pixel that it
    doesn't touch. So a cloud whose points lie farther apart than the pixels is incomplete, as it should be.

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
    place = _Place.of(pixel_x, pixel_y, truth.part.shape)
    error_mm = _errors(points_mm, place, truth)
    complete = _footprints(place, np.abs(error_mm) <= outlier_mm, truth.part.shape)
    base, part = truth.base, truth.part.reshape(-1)[place.home]
    accepted = np.isfinite(error_mm)
    counted = accepted & base.reshape(-1)[place.home]

    def figures(pixels: Bool[np.ndarray, "h w"], own: Bool[np.ndarray, "n"]) -> Score:
        share = float("nan")
        if over_exposed is not None and pixels.any():
            share = float(over_exposed[pixels].mean())
        return _score(error_mm[own], complete[pixels], share, outlier_mm)

    parts = {
        name: figures(base & (truth.part == index), counted & (part == index))
        for index, name in enumerate(truth.part_names)
    }
    edge = truth.lit_and_seen & truth.edge_band
    finite = np.isfinite(points_mm).all(axis=1)
    return Scores(
        total=figures(base, counted),
        parts={name: found for name, found in parts.items() if found.base},
        edge_base=int(edge.sum()),
        edge_accepted=int((accepted & edge.reshape(-1)[place.home]).sum()),
        stray=int((finite & ~truth.lit_and_seen.reshape(-1)[place.home]).sum()),
    )


def point_errors(
    points_mm: Float[np.ndarray, "n 3"],
    pixel_x: Real[np.ndarray, "n"],
    pixel_y: Real[np.ndarray, "n"],
    truth: Truth,
) -> tuple[Int64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Return each point's nearest pixel (counted row by row) and its signed error in [mm], as `score` has them.

    Raises
    ------
    NumericsError
        If a point lies outside the picture.
    """
    place = _Place.of(pixel_x, pixel_y, truth.part.shape)
    return place.home, _errors(points_mm, place, truth)


class _Place(NamedTuple):
    """Where points lie in the picture."""

    x: Float64[np.ndarray, "n"]
    y: Float64[np.ndarray, "n"]
    home: Int64[np.ndarray, "n"]
    """The nearest pixel, counted row by row."""

    @classmethod
    def of(
        cls, x: Real[np.ndarray, "n"], y: Real[np.ndarray, "n"], shape: tuple[int, ...]
    ) -> "_Place":
        """Find the pixels, or say which point has none."""
        height, width = shape
        column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        if not inside.all():
            first = int(np.argmin(inside))
            raise NumericsError(
                f"point {first} belongs to pixel ({x[first]}, {y[first]}), outside the"
                f" {width} x {height} picture; score against the truth of the camera that was used"
            )
        return cls(x.astype(np.float64), y.astype(np.float64), row * width + column)


def _errors(
    points_mm: Float[np.ndarray, "n 3"], place: _Place, truth: Truth
) -> Float64[np.ndarray, "n"]:
    """Return the signed distance of each point behind the true surface, along its own ray."""
    true_mm = truth.points_mm.reshape(-1, 3)[place.home].astype(np.float64)
    between = np.flatnonzero((np.rint(place.x) != place.x) | (np.rint(place.y) != place.y))
    if between.size:
        interpolated = _between_pixels(place.x[between], place.y[between], truth.points_mm)
        # Beside a hole there is nothing to interpolate with; such points aren't in the base anyway.
        known = np.isfinite(interpolated).all(axis=1)
        true_mm[between[known]] = interpolated[known]
    rays = true_mm / np.linalg.norm(true_mm, axis=1, keepdims=True)
    return np.asarray(((points_mm.astype(np.float64) - true_mm) * rays).sum(axis=1))


def _between_pixels(
    x: Float64[np.ndarray, "n"],
    y: Float64[np.ndarray, "n"],
    surface_mm: Float32[np.ndarray, "h w 3"],
) -> Float64[np.ndarray, "n 3"]:
    """Intersect the rays of places between pixels with the surface; NaN beside pixels without one."""
    height, width = surface_mm.shape[:2]
    left, top = (
        np.clip(np.floor(v).astype(np.int64), 0, max(size - 2, 0))
        for v, size in ((x, width), (y, height))
    )
    slopes_and_nearness = np.zeros((x.size, 3))
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - right - (x - left)) * np.abs(1 - down - (y - top))
        row, column = np.minimum(top + down, height - 1), np.minimum(left + right, width - 1)
        corner = surface_mm[row, column].astype(np.float64)
        corner[:, 2] = 1.0 / corner[:, 2]
        corner[:, :2] *= corner[:, 2:]
        slopes_and_nearness += np.where(weight[:, None] > 0, weight[:, None] * corner, 0.0)
    slopes_x, slopes_y, nearness = slopes_and_nearness.T
    return np.column_stack([slopes_x, slopes_y, np.ones(x.size)]) / nearness[:, None]


def _footprints(
    place: _Place, good: Bool[np.ndarray, "n"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "h w"]:
    """Mark the pixels whose centres are near a good point."""
    height, width = shape
    complete = np.zeros(shape, np.bool_)
    x, y = place.x[good], place.y[good]
    column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            near = np.hypot(column + right - x, row + down - y) <= FOOTPRINT_PX + 1e-6
            at_x, at_y = column[near] + right, row[near] + down
            inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
            complete[at_y[inside], at_x[inside]] = True
    return complete


def _score(
    error_mm: Float64[np.ndarray, "m"],
    complete: Bool[np.ndarray, "k"],
    over_exposed_share: float,
    outlier_mm: float,
) -> Score:
    """Describe the accepted points of a part by their errors, and its base by what is complete."""
    distance_mm = np.abs(error_mm)
    is_good = distance_mm <= outlier_mm
    good, signed = distance_mm[is_good], error_mm[is_good]
    nan = float("nan")
    return Score(
        base=complete.size,
        accepted=error_mm.size,
        completeness=float(complete.mean()) if complete.size else nan,
        outlier_share=1.0 - good.size / error_mm.size if error_mm.size else nan,
        rms_mm=float(np.sqrt(np.mean(good**2))) if good.size else nan,
        mean_mm=float(np.mean(good)) if good.size else nan,
        median_mm=float(np.median(good)) if good.size else nan,
        bias_mm=float(np.mean(signed)) if good.size else nan,
        std_mm=float(np.std(good)) if good.size else nan,
        over_exposed_share=over_exposed_share,
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
