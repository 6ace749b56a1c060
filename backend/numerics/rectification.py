"""Two cameras turned onto a common plane, so that partners lie in one row, without losing a pixel."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    project,
    ray_lattice,
    rays,
)
from backend.numerics.errors import CalibrationError
from backend.numerics.lattice import Lattice, lattice_positions

_LEAST_FORWARD = 0.17
"""cos 80 deg: a ray further off the common axis would stretch the canvas without end."""
_LARGEST_CANVAS = 4.0
"""Largest canvas in pictures; above, it gets coarser, which costs no accuracy (see `match`)."""


class Canvas(NamedTuple):
    """The part of the rectified plane that one camera covers."""

    x0_px: int
    y0_px: int
    width_px: int
    height_px: int


class Rectification(NamedTuple):
    """Geometry of a camera pair, ready for matching and triangulation.

    Rectified coordinates are x = f X/Z and y = f Y/Z in a frame at the camera's centre that is turned by
    `rectified_from_reference`: X along the line between the cameras, so that partners have equal y.
    """

    rectified_from_reference: Float[np.ndarray, "3 3"]
    focal_px: float
    baseline_mm: float
    """X of the other camera in the rectified frame; negative if it stands on the -X side."""
    reference: Canvas
    other: Canvas
    """Both canvases have the same rows: those that both cameras cover."""
    rays_of_reference: Lattice
    """Pixel of the reference camera -> slopes (x/z, y/z) of its ray in that camera's frame."""
    rectified_of_reference: Lattice
    """Pixel of the reference camera -> rectified x, y."""
    pixel_of_reference: Lattice
    """Canvas of the reference -> its pixel x, y."""
    pixel_of_other: Lattice
    """Canvas of the other camera -> its pixel x, y."""
    other_size_px: tuple[int, int]
    """Width and height of the other camera."""


def rectify(
    reference: Pinhole, other: Pinhole, other_from_reference: RigidTransform
) -> Rectification:
    r"""Lay out a common plane on which everything that both cameras see has its place.

    Parameters
    ----------
    reference
        Camera whose pixels become points.
    other
        Its partner, on any side and of any size.
    other_from_reference
        Pose of the other camera.

    Returns
    -------
    Rotation, focal length, signed baseline, canvases, and the maps between pixels and plane.

    Raises
    ------
    CalibrationError
        If a model or the pose can't be used, the cameras stand at the same place or one
        in front of the other, look more than 80 deg away from each other's direction, or see no common row.

    Notes
    -----
    `cv2.stereoRectify` keeps the picture size and lets both principal points coincide, which on
    converging cameras cuts off a fifth of the common view. Here each canvas is the bounding box of
    all the border pixels of its camera, in rows limited to those of both, so nothing that
    both see is lost. The depth of a pair is

    .. math:: Z = f b / (x_{reference} - x_{other})

    Nothing is resampled here: maps are kept as lattices. The last few geometries are remembered; nobody may write
    to their arrays.
    """
    return _rectified(_Pair(reference, other, other_from_reference))


class _Pair:
    """Two cameras, equal to another pair of the same numbers."""

    def __init__(
        self, reference: Pinhole, other: Pinhole, other_from_reference: RigidTransform
    ) -> None:
        self.reference, self.other = reference, other
        self.other_from_reference = other_from_reference
        self._numbers = tuple(
            value.astype(np.float64).tobytes() if isinstance(value, np.ndarray) else value
            for value in (*reference, *other, *other_from_reference)
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Pair) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)


@lru_cache(maxsize=8)
def _rectified(pair: _Pair) -> Rectification:
    reference, other, other_from_reference = pair.reference, pair.other, pair.other_from_reference
    check_pinhole(reference, "the reference camera")
    check_pinhole(other, "the other camera")
    check_transform(other_from_reference, "the other camera")
    turn, baseline_mm = _common_frame(other_from_reference)
    turn_other = turn @ other_from_reference.R.T
    focal = float(max(reference.K[0, 0], reference.K[1, 1], other.K[0, 0], other.K[1, 1]))
    borders = [
        _border(reference, turn, "the reference camera"),
        _border(other, turn_other, "the other camera"),
    ]
    focal *= _size_factor(focal, borders, (reference, other))
    canvases = _canvases([focal * border for border in borders])
    seen = ray_lattice(reference)
    return Rectification(
        rectified_from_reference=turn,
        focal_px=focal,
        baseline_mm=baseline_mm,
        reference=canvases[0],
        other=canvases[1],
        rays_of_reference=seen,
        rectified_of_reference=_rectifying(seen, turn, focal),
        pixel_of_reference=_unrectifying(reference, turn, focal, canvases[0]),
        pixel_of_other=_unrectifying(other, turn_other, focal, canvases[1]),
        other_size_px=(other.width_px, other.height_px),
    )


def _common_frame(other_from_reference: RigidTransform) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Return the rotation into the rectified frame and the signed baseline."""
    centre = -other_from_reference.R.T @ other_from_reference.t_mm
    length = float(np.linalg.norm(centre))
    if length < 1e-6:
        raise CalibrationError(
            f"the two cameras stand {length:g} mm apart; depth needs a baseline, check the calibration"
        )
    along = centre / length
    # Keep pictures upright: x to the right, or downwards if the cameras stand one above the other.
    side = 1.0 if along[int(np.argmax(np.abs(along[:2])))] > 0 else -1.0
    along = side * along
    axis = np.array([0.0, 0.0, 1.0]) + other_from_reference.R[2]
    forward = axis - (axis @ along) * along
    if np.linalg.norm(forward) < 0.1:
        raise CalibrationError(
            "the cameras look along the line between them or against each other; partners can't be"
            " found there, check the calibration"
        )
    forward /= np.linalg.norm(forward)
    return np.stack([along, np.cross(forward, along), forward]), side * length


def _border(camera: Pinhole, turn: Float[np.ndarray, "3 3"], name: str) -> Float[np.ndarray, "n 2"]:
    """Return the rectified slopes along the border, every fourth pixel: the canvas has a margin of 1 px."""
    x = np.append(np.arange(0, camera.width_px - 1, 4), camera.width_px - 1)
    y = np.append(np.arange(0, camera.height_px - 1, 4), camera.height_px - 1)
    top, left = np.zeros_like(x), np.zeros_like(y)
    edges = [(x, top), (x, top + camera.height_px - 1), (left, y), (left + camera.width_px - 1, y)]
    pixels = np.concatenate([np.stack(edge, axis=1) for edge in edges]).astype(np.float64)
    slopes = rays(pixels, camera)
    directions = np.column_stack([slopes, np.ones(len(slopes))])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ turn.T
    if not (directions[:, 2] > _LEAST_FORWARD).all():
        raise CalibrationError(
            f"{name} sees more than 80 deg away from the common direction of view; turn the"
            " cameras towards each other or check the calibration"
        )
    return np.asarray(directions[:, :2] / directions[:, 2:])


def _size_factor(
    focal_px: float, borders: list[Float[np.ndarray, "_n 2"]], cameras: tuple[Pinhole, Pinhole]
) -> float:
    sizes = [float(np.prod(np.ptp(focal_px * border, axis=0))) for border in borders]
    pictures = [camera.width_px * camera.height_px for camera in cameras]
    excess = max(size / picture for size, picture in zip(sizes, pictures, strict=True))
    return min(1.0, float(np.sqrt(_LARGEST_CANVAS / excess)))


def _canvases(borders_px: list[Float[np.ndarray, "_n 2"]]) -> tuple[Canvas, Canvas]:
    low = [np.floor(border.min(axis=0)).astype(int) - 1 for border in borders_px]
    high = [np.ceil(border.max(axis=0)).astype(int) + 1 for border in borders_px]
    y0, y1 = max(low[0][1], low[1][1]), min(high[0][1], high[1][1])
    if y1 <= y0:
        raise CalibrationError(
            "the two cameras see no common row; turn them towards the same scene or check the calibration"
        )
    first, second = (
        Canvas(int(low[i][0]), int(y0), int(high[i][0] - low[i][0] + 1), int(y1 - y0 + 1))
        for i in (0, 1)
    )
    return first, second


def _rectifying(seen: Lattice, turn: Float[np.ndarray, "3 3"], focal_px: float) -> Lattice:
    x, y = seen.nodes
    turned = np.tensordot(turn, np.stack([x, y, np.ones_like(x)]), axes=1)
    return seen._replace(nodes=np.ascontiguousarray(focal_px * turned[:2] / turned[2]))


def _unrectifying(
    camera: Pinhole, turn: Float[np.ndarray, "3 3"], focal_px: float, canvas: Canvas
) -> Lattice:
    x, y = lattice_positions(canvas.width_px, canvas.height_px)
    grid = np.stack(np.meshgrid(x + canvas.x0_px, y + canvas.y0_px), axis=-1).reshape(-1, 2)
    directions = np.column_stack([grid, np.full(len(grid), focal_px)]) @ turn
    nodes = project(directions, camera).T.reshape(2, y.size, x.size)
    return Lattice(np.ascontiguousarray(nodes), canvas.width_px, canvas.height_px)
