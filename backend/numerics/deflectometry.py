"""What a mirror does to the view of a screen: rays, the surface they meet, and its slopes.

Everything is in the mirror's frame: x right and y up as seen from its front, z towards the viewer, in mm.
Slopes are dz/dx and dz/dy, without unit.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from backend.numerics.errors import MirrorError
from backend.numerics.pinhole import RigidTransform
from backend.numerics.polynomial_terms import derivatives, evaluate, order_of, slope_terms

_NEWTON_STEPS = 30
_NEWTON_MM = 1e-8
"""The next step is far below this: Newton's method doubles the digits."""
_MISSED_MM = 1e-5
_BISQUARE = 4.685
"""Tukey's constant: 95 % efficiency for normal noise."""
_MAD_TO_SIGMA = 1.4826
_FIT_POINTS = 30_000
_FIT_ROUNDS = 50
_LEAST_SPREAD = 1e-9


class View(NamedTuple):
    """What camera and screen offer, in the world's (the camera's) frame."""

    directions: Float64[np.ndarray, "n 3"]
    """Ray of each pixel from the camera's centre, which is the origin; any length."""
    screen_mm: Float64[np.ndarray, "n 3"]
    """Point of the screen that each pixel sees in the mirror."""
    screen_origin_mm: Float64[np.ndarray, "3"]
    """Where the screen's frame has its origin, to which the mirror's distance is measured."""


class Surface(NamedTuple):
    """A mirror's surface: z as a polynomial in x and y."""

    coefficients: Float64[np.ndarray, "_terms"]
    """In [mm], in the order of `polynomial_terms.powers`: 1 x x^2 y xy y^2 ..."""

    @property
    def order(self) -> int:
        """Order of the polynomial."""
        return order_of(self.coefficients.size)

    def heights(
        self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n"]:
        """Return z in [mm]."""
        return evaluate(self.coefficients, x, y)

    def slopes(
        self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n 2"]:
        """Return dz/dx and dz/dy."""
        by_x, by_y = derivatives(self.coefficients)
        return np.stack([evaluate(by_x, x, y), evaluate(by_y, x, y)], axis=1)


def plane() -> Surface:
    """Return z = 0, as a polynomial of order 2."""
    return Surface(np.zeros(6))


def paraboloid(focal_x_mm: float, focal_y_mm: float) -> Surface:
    """Return z = x^2 / (4 f_x) + y^2 / (4 f_y); positive focal lengths are concave.

    Examples
    --------
    >>> paraboloid(500.0, 250.0).coefficients.tolist()
    [0.0, 0.0, 0.0005, 0.0, 0.0, 0.001]
    """
    return Surface(np.array([0.0, 0.0, 0.25 / focal_x_mm, 0.0, 0.0, 0.25 / focal_y_mm]))


def intersect(
    origin_mm: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "n 3"],
    surface: Surface,
    start_mm: Float[np.ndarray, "n"] | None = None,
) -> Float64[np.ndarray, "n 3"]:
    """Follow rays to the surface, by Newton's method; the error is below a nanometre.

    Parameters
    ----------
    origin_mm
        Where all rays start.
    directions
        Their directions, any length.
    surface
        What they meet.
    start_mm
        Heights to start from; None: 0.

    Returns
    -------
    Points in [mm]; NaN for rays that run along the surface or don't meet it.
    """
    heights = np.zeros(len(directions)) if start_mm is None else start_mm.astype(np.float64)
    along_x, along_y, along_z = np.ascontiguousarray(directions.T, np.float64)
    # A ray along the mirror divides by zero and becomes NaN, as it should.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        scale = (heights - origin_mm[2]) / along_z
        for _ in range(_NEWTON_STEPS):
            x, y = origin_mm[0] + scale * along_x, origin_mm[1] + scale * along_y
            slopes = surface.slopes(x, y)
            above = origin_mm[2] + scale * along_z - surface.heights(x, y)
            scale -= above / (along_z - slopes[:, 0] * along_x - slopes[:, 1] * along_y)
            np.abs(above, out=above)
            if not np.nanmax(above, initial=0.0) > _NEWTON_MM:
                break
        points = np.stack(
            [origin_mm[k] + scale * along for k, along in enumerate((along_x, along_y, along_z))],
            axis=1,
        )
        missed = ~(above <= _MISSED_MM) | ~(scale > 0)
    points[missed] = np.nan
    return points


def reflection_slopes(
    points_mm: Float[np.ndarray, "n 3"],
    camera_mm: Float[np.ndarray, "3"],
    screen_mm: Float[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 2"]:
    r"""Return the slopes that reflect camera and screen into one another.

    Notes
    -----
    The normal halves the angle between the directions to camera and screen:
    :math:`n \parallel s/|s| + c/|c|`, slopes :math:`(-n_x/n_z, -n_y/n_z)`.
    """
    to_screen = screen_mm - points_mm
    to_camera = camera_mm - points_mm
    to_screen /= np.linalg.norm(to_screen, axis=1, keepdims=True)
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    normal = to_screen + to_camera
    return np.asarray(-normal[:, :2] / normal[:, 2:])


class SlopeFit(NamedTuple):
    """A polynomial surface fitted to slopes."""

    surface: Surface
    weights: Float64[np.ndarray, "n 2"]
    """What each slope counted, 0 for outliers."""


def fit_slopes(
    points_mm: Float[np.ndarray, "n 3"],
    slopes: Float[np.ndarray, "n 2"],
    *,
    order: int = 2,
    robust: bool = True,
    weights: Float[np.ndarray, "n 2"] | None = None,
    rounds: int = _FIT_ROUNDS,
) -> SlopeFit:
    """Fit one polynomial surface to slopes in x and y together; its height at the origin is 0.

    Parameters
    ----------
    points_mm, slopes
        Finite points of the surface and their slopes.
    order
        Of the polynomial, >= 2; 2 is a paraboloid with tilt.
    robust
        Tukey's bisquare weights instead of equal ones: what isn't the mirror's (edges, dirt) doesn't count.
    weights
        Weights to start from, of an earlier fit.
    rounds
        Most rounds of new weights.
    """
    by_x, by_y = slope_terms(points_mm[:, 0], points_mm[:, 1], order)
    scale = 1.0 / np.maximum(np.sqrt((by_x**2 + by_y**2).mean(axis=0)), 1e-300)
    by_x, by_y = by_x[:, 1:] * scale[1:], by_y[:, 1:] * scale[1:]
    w = np.ones(slopes.shape) if weights is None else weights.astype(np.float64)
    found = np.zeros(by_x.shape[1])
    for _ in range(rounds if robust else 1):
        weighted_x, weighted_y = by_x * w[:, :1], by_y * w[:, 1:]
        normal = weighted_x.T @ by_x + weighted_y.T @ by_y
        right = weighted_x.T @ slopes[:, 0] + weighted_y.T @ slopes[:, 1]
        before, found = found, np.linalg.lstsq(normal, right, rcond=1e-13)[0]
        residual = slopes - np.stack([by_x @ found, by_y @ found], axis=1)
        if not robust or np.abs(found - before).max() <= 1e-7 * np.abs(found).max():
            break
        w = _bisquare(residual)
    coefficients = np.concatenate([[0.0], found * scale[1:]])
    return SlopeFit(Surface(coefficients), w)


def _bisquare(residual: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    # From zero, not from the median: a first fit that dirt has moved would leave no pixel near zero.
    spread = _MAD_TO_SIGMA * np.median(np.abs(residual), axis=0)
    # Simulated slopes may fit to rounding: without a floor nothing but rounding would decide.
    u = residual / (_BISQUARE * np.maximum(spread, _LEAST_SPREAD))
    return np.asarray(np.where(np.abs(u) < 1, (1 - u * u) ** 2, 0.0))


@dataclass(frozen=True)
class Alignment:
    """What is adjusted so that the measured slopes fit: the mirror's tilt, and its distance if that is known."""

    point_mm: Float64[np.ndarray, "2"]
    """Where, in x and y of the mirror, the fitted surface gets the slopes below."""
    slopes: Float64[np.ndarray, "2"]
    """The design's slopes there."""
    distance_mm: float | None = None
    """Measured from the origin of the screen's frame to `measured_mm`; None: the distance stays."""
    measured_mm: Float64[np.ndarray, "3"] | None = None
    """Point of the mirror that the distance was measured to; None: its origin."""


class MirrorSlopes(NamedTuple):
    """The slopes of a mirror, point by point."""

    points_mm: Float64[np.ndarray, "n 3"]
    """Where the pixels' rays meet the fitted surface; NaN where they don't or the screen isn't known."""
    slopes: Float64[np.ndarray, "n 2"]
    fit: Surface
    """The polynomial that the slopes follow, through the origin's height of the start."""
    mirror_from_world: RigidTransform
    """The pose, after alignment."""
    tilt_rad: float
    """By how much alignment turned the mirror in all."""


_MOST_ROUNDS = 20
_SETTLED = 1e-9


def solve_slopes(
    view: View,
    mirror_from_world: RigidTransform,
    start: Surface,
    *,
    order: int = 2,
    robust: bool = True,
    alignment: Alignment | None = None,
) -> MirrorSlopes:
    """Find surface and slopes in turn: where rays meet the surface says the slopes, they say the surface.

    Parameters
    ----------
    view
        Rays and the points of the screen that they end at.
    mirror_from_world
        The mirror's pose; with `alignment` only a start.
    start
        Surface to start from; the result doesn't depend on it unless it is far off.
    order, robust
        Of the polynomial that stands for the surface, see `fit_slopes`.
    alignment
        What of the pose is adjusted; None: nothing.

    Raises
    ------
    MirrorError
        If fewer than ten rays meet the mirror and see the screen, or the iteration doesn't settle.

    Notes
    -----
    A point that is wrong by dz moves its slopes by about dz / (2 d) times the sine of the view's angle, so
    two or three rounds settle. Turning the mirror about the alignment's point and moving it along the line to the
    camera leaves the camera's picture of it as it is, to first order.
    """
    pose = mirror_from_world
    usable = np.isfinite(view.screen_mm).all(axis=1) & np.isfinite(view.directions).all(axis=1)
    _require_points(usable, "see both mirror and screen")
    chosen = np.flatnonzero(usable)
    chosen = chosen[:: max(1, chosen.size // _FIT_POINTS)]
    sample = View(view.directions[chosen], view.screen_mm[chosen], view.screen_origin_mm)
    surface, weights = start, np.ones((chosen.size, 2))
    for _ in range(_MOST_ROUNDS):
        points, slopes = _slopes_of(sample, pose, surface)
        met = np.isfinite(slopes).all(axis=1)
        _require_points(met, "meet the mirror's surface")
        # Weights carry over from round to round, so that each round needs a few steps only.
        fit = fit_slopes(
            points[met], slopes[met], order=order, robust=robust, weights=weights[met], rounds=5
        )
        weights[met] = fit.weights
        before, surface = surface, _through_start(fit.surface, start)
        change = _change(before, surface, points[met])
        if alignment is not None:
            surface, pose, turned_rad, moved = _aligned(surface, pose, alignment, view)
            change = max(change, turned_rad, moved)
        if change < _SETTLED:
            break
    else:
        raise MirrorError(
            f"surface and slopes don't settle (they still change by {change:.2g} after {_MOST_ROUNDS} rounds): "
            "check the poses of screen and mirror"
        )
    points, slopes = _slopes_of(view, pose, surface)
    tilt_rad = _angle(pose.R @ mirror_from_world.R.T)
    return MirrorSlopes(points, slopes, surface, pose, tilt_rad)


def follow_deviation(
    view: View, found: MirrorSlopes, deviation_mm: Float[np.ndarray, "n"]
) -> MirrorSlopes:
    r"""Move the points from the fitted polynomial to the surface itself, and find their slopes anew.

    Parameters
    ----------
    view
        As given to `solve_slopes`.
    found
        Its result, or that of this function.
    deviation_mm
        Height of the surface above the polynomial at each pixel's point; NaN: the point stays.

    Notes
    -----
    A point at height h above the polynomial lies on its ray :math:`h / (d_z - s \cdot d_{xy})` farther: exact for
    a surface that is parallel to the polynomial, else to second order in h over its lateral scale.
    """
    pose = found.mirror_from_world
    along = view.directions @ pose.R.T
    base = intersect(pose.t_mm, along, found.fit)
    steep = found.fit.slopes(base[:, 0], base[:, 1])
    facing = along[:, 2] - (steep * along[:, :2]).sum(axis=1)
    points = base + (np.nan_to_num(deviation_mm) / facing)[:, None] * along
    slopes = reflection_slopes(points, pose.t_mm, view.screen_mm @ pose.R.T + pose.t_mm)
    return found._replace(points_mm=points, slopes=slopes)


def _slopes_of(
    view: View, pose: RigidTransform, surface: Surface
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]:
    camera_mm = pose.t_mm
    points = intersect(camera_mm, view.directions @ pose.R.T, surface)
    return points, reflection_slopes(points, camera_mm, view.screen_mm @ pose.R.T + pose.t_mm)


def _through_start(fit: Surface, start: Surface) -> Surface:
    """Slopes don't tell heights: the start does, at the origin."""
    coefficients = fit.coefficients.copy()
    coefficients[0] = start.coefficients[0]
    return Surface(coefficients)


def _change(before: Surface, after: Surface, points: Float[np.ndarray, "n 3"]) -> float:
    few = points[:: max(1, len(points) // 1000)]
    x, y = few[:, 0], few[:, 1]
    return float(np.abs(after.slopes(x, y) - before.slopes(x, y)).max())


def _aligned(
    surface: Surface, pose: RigidTransform, alignment: Alignment, view: View
) -> tuple[Surface, RigidTransform, float, float]:
    """Turn the mirror so that the fitted normal is the design's, and bring it to the measured distance."""
    at = alignment.point_mm
    slopes = surface.slopes(at[:1], at[1:])[0]
    pivot = np.array([at[0], at[1], surface.heights(at[:1], at[1:])[0]])
    turn = _rotation(_normal(slopes), _normal(alignment.slopes))
    # Points turn about the pivot; the frame stays with the mirror.
    pose = RigidTransform(turn @ pose.R, turn @ (pose.t_mm - pivot) + pivot)
    turned = Surface(surface.coefficients.copy())
    turned.coefficients[1] += alignment.slopes[0] - slopes[0]
    turned.coefficients[surface.order + 1] += alignment.slopes[1] - slopes[1]
    turned.coefficients[0] += pivot[2] - turned.heights(at[:1], at[1:])[0]
    moved = 0.0
    if alignment.distance_mm is not None:
        scale = _distance_scale(pose, alignment, view)
        moved = abs(scale - 1.0)
        pose = RigidTransform(pose.R, pivot + scale * (pose.t_mm - pivot))
    return turned, pose, _angle(turn), moved


def _normal(slopes: Float[np.ndarray, "2"]) -> Float64[np.ndarray, "3"]:
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    return np.asarray(normal / np.linalg.norm(normal))


def _rotation(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes one unit vector to another (not its opposite)."""
    v, c = np.cross(start, end), float(start @ end)
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + c))


def _angle(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle of a rotation in [rad], exact for small ones."""
    return float(2 * np.arcsin(min(1.0, np.linalg.norm(rotation - np.eye(3)) / np.sqrt(8))))


def _distance_scale(pose: RigidTransform, alignment: Alignment, view: View) -> float:
    """Find by what the way from the pivot to the camera is stretched so that the measured distance comes out."""
    at = alignment.point_mm
    measured = np.zeros(3) if alignment.measured_mm is None else alignment.measured_mm
    pivot = np.array([at[0], at[1], 0.0])
    screen = pose.R @ view.screen_origin_mm + pose.t_mm
    along, offset = pose.t_mm - pivot, screen - measured
    # |offset + k along| = distance: the root nearest to 0.
    a, b = along @ along, offset @ along
    c = offset @ offset - alignment.distance_mm**2 if alignment.distance_mm else 0.0
    inside = b * b - a * c
    if inside < 0 or b == 0:
        raise MirrorError(
            f"the mirror can't be {alignment.distance_mm:g} mm from the screen on the camera's line of sight: "
            "measure the distance again"
        )
    return float(1.0 - c / (b + np.sign(b) * np.sqrt(inside)))


def _require_points(usable: Bool[np.ndarray, "n"], what: str) -> None:
    if np.count_nonzero(usable) < 10:
        raise MirrorError(
            f"only {np.count_nonzero(usable)} of {usable.size} pixels {what}: "
            "check the mask, the screen's pose and the mirror's pose"
        )
