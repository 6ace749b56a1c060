"""Solids built by numpy: boxes, cylinders, plates with holes, grids, a plaster bust.

Local frame of every shape: x right, y up, z towards the viewer, in mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

RIG_FROM_LOCAL = np.diag([1.0, -1.0, -1.0])
"""The rig's frame has y down and z away from the devices."""


@dataclass(frozen=True)
class Mesh:
    """Triangles, counter-clockwise seen from outside, with a normal per corner for smooth shading."""

    vertices_mm: Float[np.ndarray, "n_vertices 3"]
    triangles: Int32[np.ndarray, "n_triangles 3"]
    corner_normals: Float32[np.ndarray, "n_triangles 3 3"]

    def moved(
        self,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        *,
        turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> "Mesh":
        """Turn about the local x, then y, then z axis, then move by (x, y, z) in [mm]."""
        R = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
        return self.transformed(R, np.array([x, y, z], np.float64))

    def transformed(self, R: Float[np.ndarray, "3 3"], t_mm: Float[np.ndarray, "3"]) -> "Mesh":
        """Apply x -> R x + t to the vertices and R to the normals."""
        return Mesh(
            self.vertices_mm @ R.T + t_mm,
            self.triangles,
            (self.corner_normals @ R.T.astype(np.float32)).astype(np.float32),
        )


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Put several meshes into one; they may overlap."""
    offsets = np.cumsum([0] + [len(mesh.vertices_mm) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices_mm for mesh in meshes]),
        np.concatenate(
            [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=False)]
        ).astype(np.int32),
        np.concatenate([mesh.corner_normals for mesh in meshes]),
    )


def face_normals(
    vertices_mm: Float[np.ndarray, "n_vertices 3"], triangles: Int32[np.ndarray, "n_triangles 3"]
) -> Float[np.ndarray, "n_triangles 3"]:
    """Return the unit normals of triangles; 0 for those without area."""
    a, b, c = (vertices_mm[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Float[np.ndarray, "n_triangles 3"] = normals / np.where(lengths > 0, lengths, 1.0)
    return unit


def flat(
    vertices_mm: Float[np.ndarray, "n_vertices 3"], triangles: Int32[np.ndarray, "n_triangles 3"]
) -> Mesh:
    """Make a mesh whose facets are seen as facets."""
    normals = face_normals(vertices_mm, triangles)
    return Mesh(
        vertices_mm, triangles, np.repeat(normals[:, None, :], 3, axis=1).astype(np.float32)
    )


def smooth(
    vertices_mm: Float[np.ndarray, "n_vertices 3"], triangles: Int32[np.ndarray, "n_triangles 3"]
) -> Mesh:
    """Make a mesh whose normals are the area-weighted means around each vertex."""
    a, b, c = (vertices_mm[triangles[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    per_corner = np.repeat(weighted, 3, axis=0)
    sums = np.column_stack(
        [
            np.bincount(triangles.ravel(), per_corner[:, axis], minlength=len(vertices_mm))
            for axis in range(3)
        ]
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    normals = sums / np.where(lengths > 0, lengths, 1.0)
    return Mesh(vertices_mm, triangles, normals[triangles].astype(np.float32))


def convex(points_mm: Float[np.ndarray, "n 3"]) -> Mesh:
    """Make the convex hull of points, with flat facets."""
    hull = ConvexHull(points_mm)
    triangles = hull.simplices.astype(np.int32)
    inward = (face_normals(points_mm, triangles) * hull.equations[:, :3]).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return flat(points_mm, triangles)


def box(width: float, height: float, depth: float, *, chamfer: float = 0.0) -> Mesh:
    """Make a box around the origin, its edges broken by a chamfer, in [mm]."""
    half = np.array([width, height, depth]) / 2
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    if chamfer <= 0:
        return convex(signs * half)
    cut = [signs * (half - chamfer * (1 - np.eye(3)[axis])) for axis in range(3)]
    return convex(np.concatenate(cut))


def prism(outline_mm: Float[np.ndarray, "n 2"], depth: float) -> Mesh:
    """Extrude a convex outline in x, y along z, centred, in [mm]."""
    front, back = (
        np.column_stack([outline_mm, np.full(len(outline_mm), z)]) for z in (depth / 2, -depth / 2)
    )
    return convex(np.concatenate([front, back]))


def grid(points_mm: Float[np.ndarray, "rows columns 3"], *, closed: bool = False) -> Mesh:
    """Make a smooth surface through a grid of points; `closed` joins the last column to the first.

    It is seen from outside where rows run down and columns run to the right.
    """
    rows, columns, _ = points_mm.shape
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    if closed:
        index = np.column_stack([index, index[:, :1]])
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = np.concatenate(
        [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)]
    )
    return smooth(points_mm.reshape(-1, 3).astype(np.float64), triangles)


def _ring(radius: float, n: int) -> Float[np.ndarray, "n 2"]:
    angle = np.arange(n) * 2 * np.pi / n
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def turned(profile_mm: Float[np.ndarray, "n 2"], *, segments: int = 160) -> Mesh:
    """Turn a profile of (radius, z), from the back to the front, about the z axis: smooth round, flat at corners."""
    pieces = []
    for (r0, z0), (r1, z1) in pairwise(profile_mm):
        back = np.column_stack([_ring(r0, segments), np.full(segments, z0)])
        front = np.column_stack([_ring(r1, segments), np.full(segments, z1)])
        pieces.append(grid(np.stack([front, back]), closed=True))
    # The normals of each piece are those of its own cone: `grid` never averages over a corner.
    return join(pieces)


def turned_smooth(profile_mm: Float[np.ndarray, "n 2"], *, segments: int = 160) -> Mesh:
    """Turn a profile as `turned` does, smooth along the profile too."""
    rings = [np.column_stack([_ring(r, segments), np.full(segments, z)]) for r, z in profile_mm]
    return grid(np.stack(rings[::-1]), closed=True)


def cylinder(radius: float, length: float, *, chamfer: float = 0.0, segments: int = 160) -> Mesh:
    """Make a closed cylinder along z, centred, in [mm]."""
    h = length / 2
    tiny = 1e-3
    profile = [(tiny, -h), (radius - chamfer, -h)]
    if chamfer > 0:
        profile += [(radius, -h + chamfer), (radius, h - chamfer)]
    else:
        profile += [(radius, h)]
    return turned(np.array([*profile, (radius - chamfer, h), (tiny, h)]), segments=segments)


def sphere(radius: float, *, segments: int = 720) -> Mesh:
    """Make a sphere around the origin, in [mm]; 720 segments stay within 0.1 um per mm radius^2 / 100."""
    polar = np.linspace(1e-4, np.pi - 1e-4, segments // 2 + 1)[:, None]
    around = (np.arange(segments) * 2 * np.pi / segments)[None, :]
    points = radius * np.stack(
        [
            np.sin(polar) * np.sin(around),
            np.broadcast_to(np.cos(polar), (polar.size, around.size)),
            np.sin(polar) * np.cos(around),
        ],
        -1,
    )
    return grid(points, closed=True)


def plate(
    width: float,
    height: float,
    thickness: float,
    holes: Sequence[tuple[float, float, float]] = (),
    *,
    segments: int = 96,
) -> Mesh:
    """Make a plate in x, y, centred, with round through holes (x, y, radius), in [mm].

    Each hole needs a column of the plate of its own: the plate is cut midway between neighbouring holes in x.
    """
    if not holes:
        return box(width, height, thickness)
    ordered = sorted(holes)
    middles = [(a[0] + b[0]) / 2 for a, b in pairwise(ordered)]
    cuts = [-width / 2, *middles, width / 2]
    pieces = [
        _holed_cell(left, right, height, thickness, hole, segments)
        for (left, right), hole in zip(pairwise(cuts), ordered, strict=True)
    ]
    return join([*pieces, *_rim(width, height, thickness)])


def _holed_cell(
    left: float,
    right: float,
    height: float,
    thickness: float,
    hole: tuple[float, float, float],
    segments: int,
) -> Mesh:
    x, y, radius = hole
    circle = _ring(1.0, segments)
    # The corners have to be among the directions, or the cell's corners are cut off.
    corners = np.array(
        [(cx - x, cy - y) for cx in (left, right) for cy in (-height / 2, height / 2)]
    )
    angles = np.concatenate([np.arctan2(p[:, 1], p[:, 0]) for p in (circle, corners)])
    angles.sort()
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    with np.errstate(divide="ignore"):
        reach_x = np.where(directions[:, 0] > 0, right - x, left - x) / directions[:, 0]
        reach_y = np.where(directions[:, 1] > 0, height / 2 - y, -height / 2 - y) / directions[:, 1]
    outer = directions * np.minimum(np.abs(reach_x), np.abs(reach_y))[:, None] + (x, y)
    inner = directions * radius + (x, y)
    n, z = len(angles), np.full((len(angles), 1), thickness / 2)
    front = grid(np.stack([np.hstack([inner, z]), np.hstack([outer, z])]), closed=True)
    back = grid(np.stack([np.hstack([outer, -z]), np.hstack([inner, -z])]), closed=True)
    wall = grid(np.stack([np.hstack([inner, -z]), np.hstack([inner, z])]), closed=True)
    assert n >= segments
    return join([front, back, wall])


def _rim(width: float, height: float, thickness: float) -> list[Mesh]:
    outline = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2)
    sides = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        corners = np.array(
            [[*a, thickness / 2], [*b, thickness / 2], [*a, -thickness / 2], [*b, -thickness / 2]]
        )
        sides.append(flat(corners, np.array([[0, 2, 1], [1, 2, 3]], np.int32)))
    return sides


def bump(
    distance: Float[np.ndarray, "..."], width: float | Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Return a Gaussian bump of height 1 over a distance."""
    return np.asarray(np.exp(-0.5 * (distance / width) ** 2))
