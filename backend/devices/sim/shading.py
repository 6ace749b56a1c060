"""How much of the projector's light a camera ray gets from the point it hits.

One kernel serves camera rays and rays mirrored once; it also prepares the shadow rays.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, Int32

from backend.devices.sim.layout import View
from backend.devices.sim.rays import coefficients, distorted
from backend.devices.sim.scene import Scene
from backend.devices.sim.shapes import RIG_FROM_LOCAL, face_normals, join
from backend.numerics.kernels import kernel, row_loop

SHADOW_OFFSET_MM = 0.1
"""Shadow rays start this far off the surface, or float32 makes it shadow itself."""

REFERENCE_MM = 700.0
"""Distance at which the projector's brightness is stated."""


class Surfaces(NamedTuple):
    """A scene as the kernels want it: one mesh in the rig's frame."""

    vertices_mm: Float32[np.ndarray, "n_vertices 3"]
    triangles: Int32[np.ndarray, "n_triangles 3"]
    corner_normals: Float32[np.ndarray, "n_triangles 3 3"]
    face_normals: Float32[np.ndarray, "n_triangles 3"]
    part: Int16[np.ndarray, "n_triangles"]
    materials: Float32[np.ndarray, "n_parts 4"]
    """Albedo, specular, roughness, mirror per part."""


def surfaces(scene: Scene, distance_mm: float) -> Surfaces:
    """Put a scene where the devices look, as one mesh."""
    mesh = join([part.mesh for part in scene.parts])
    mesh = mesh.transformed(RIG_FROM_LOCAL, np.array([0.0, 0.0, distance_mm]))
    counts = [len(part.mesh.triangles) for part in scene.parts]
    materials = [
        (m.albedo, m.specular, m.roughness, m.mirror) for m in (p.material for p in scene.parts)
    ]
    return Surfaces(
        mesh.vertices_mm.astype(np.float32),
        mesh.triangles,
        mesh.corner_normals,
        face_normals(mesh.vertices_mm, mesh.triangles).astype(np.float32),
        np.repeat(np.arange(len(counts), dtype=np.int16), counts),
        np.array(materials, np.float32),
    )


class Lighting(NamedTuple):
    """What the projector's light does at the points that n rays hit. A weight of 0: nothing."""

    point_mm: Float32[np.ndarray, "n 3"]
    normal: Float32[np.ndarray, "n 3"]
    """Towards the ray's origin; NaN without a hit."""
    uv_px: Float32[np.ndarray, "n 2"]
    """The projector pixel that lights the point."""
    lit: Bool[np.ndarray, "n"]
    """The projector's picture falls on the point's front; shadows are entered by the caller."""
    weight: Float32[np.ndarray, "n"]
    """Light back along the ray, relative to a white diffuser facing the projector at the reference distance."""
    ambient: Float32[np.ndarray, "n"]
    """The same for light from everywhere."""
    mirror: Float32[np.ndarray, "n"]
    """Mirror's share at the point."""
    depth_mm: Float32[np.ndarray, "n"]
    """Distance along the projector's axis, for its defocus."""
    part: Int16[np.ndarray, "n"]
    shadow_rays: Float32[np.ndarray, "n 6"]
    """From just above the point to the projector; length 1 reaches it."""


def light_at(
    rays: Float32[np.ndarray, "n 6"],
    hit_mm: Float32[np.ndarray, "n"],
    triangle: Int32[np.ndarray, "n"],
    barycentric: Float32[np.ndarray, "n 2"],
    scene: Surfaces,
    projector: View,
) -> Lighting:
    r"""Shade what rays hit, before shadows are known.

    Parameters
    ----------
    rays
        Origin and unit direction in the rig's frame.
    hit_mm
        Distance to the first hit, inf where there is none.
    triangle, barycentric
        Where on the mesh that is.
    scene
        The mesh and its materials.
    projector
        Where the light comes from.

    Notes
    -----
    With n.l and n.v the cosines towards light and ray, d the distance from the projector and d0 that of
    reference, the weight is

    .. math:: (\rho + \pi f_s) (n \cdot l) (d_0 / d)^2

    where f_s is a GGX microfacet lobe with Smith's height-correlated shadowing in Hammon's approximation
    and Schlick's Fresnel term. A point off the projector's picture gets weight 0.
    """
    n = len(rays)
    out = Lighting(
        point_mm=np.full((n, 3), np.nan, np.float32),
        normal=np.full((n, 3), np.nan, np.float32),
        uv_px=np.full((n, 2), -1.0, np.float32),
        lit=np.zeros(n, np.bool_),
        weight=np.zeros(n, np.float32),
        ambient=np.zeros(n, np.float32),
        mirror=np.zeros(n, np.float32),
        depth_mm=np.ones(n, np.float32),
        part=np.full(n, -1, np.int16),
        shadow_rays=np.zeros((n, 6), np.float32),
    )
    pose, model = projector.device_from_rig, projector.model
    _shade(
        rays,
        hit_mm,
        triangle,
        barycentric,
        *(scene.triangles, scene.corner_normals, scene.face_normals, scene.part, scene.materials),
        projector.position_mm,
        np.ascontiguousarray(pose.R),
        pose.t_mm,
        np.ascontiguousarray(model.K),
        coefficients(model.distortion),
        model.width_px,
        model.height_px,
        *out,
    )
    return out


@row_loop
def reflectance(nl: Any, nv: Any, nh: Any, vh: Any, material: Any) -> Any:
    """Return pi times the BRDF for the cosines of light, view and half-way vector."""
    albedo, specular, alpha = material[0], material[1], material[2]
    if specular <= 0.0:
        return albedo
    a2 = alpha * alpha
    d = nh * nh * (a2 - 1.0) + 1.0
    distribution = a2 / (d * d)  # times pi
    # Hammon's approximation of G / (4 n.l n.v)
    visibility = 0.5 / (2.0 * nl * nv * (1.0 - alpha) + (nl + nv) * alpha + 1e-6)
    fresnel = specular + (1.0 - specular) * (1.0 - vh) ** 5
    return albedo + distribution * visibility * fresnel


@kernel
def _shade(
    rays: Any,
    hit: Any,
    tri: Any,
    bary: Any,
    triangles: Any,
    corner_normals: Any,
    face_n: Any,
    tri_part: Any,
    materials: Any,
    light: Any,
    R: Any,
    t: Any,
    K: Any,
    dist: Any,
    width: Any,
    height: Any,
    point: Any,
    normal: Any,
    uv: Any,
    lit: Any,
    weight: Any,
    ambient: Any,
    mirror: Any,
    depth: Any,
    part: Any,
    shadow: Any,
) -> None:
    n_triangles = triangles.shape[0]
    for i in numba.prange(rays.shape[0]):
        if not np.isfinite(hit[i]) or tri[i] < 0 or tri[i] >= n_triangles:
            continue
        k = tri[i]
        b1, b2 = bary[i, 0], bary[i, 1]
        b0 = 1.0 - b1 - b2
        px = rays[i, 0] + np.float64(hit[i]) * rays[i, 3]
        py = rays[i, 1] + np.float64(hit[i]) * rays[i, 4]
        pz = rays[i, 2] + np.float64(hit[i]) * rays[i, 5]
        gx, gy, gz = face_n[k, 0], face_n[k, 1], face_n[k, 2]
        side = -1.0 if gx * rays[i, 3] + gy * rays[i, 4] + gz * rays[i, 5] > 0 else 1.0
        gx, gy, gz = side * gx, side * gy, side * gz
        nx = side * (
            b0 * corner_normals[k, 0, 0]
            + b1 * corner_normals[k, 1, 0]
            + b2 * corner_normals[k, 2, 0]
        )
        ny = side * (
            b0 * corner_normals[k, 0, 1]
            + b1 * corner_normals[k, 1, 1]
            + b2 * corner_normals[k, 2, 1]
        )
        nz = side * (
            b0 * corner_normals[k, 0, 2]
            + b1 * corner_normals[k, 1, 2]
            + b2 * corner_normals[k, 2, 2]
        )
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < 1e-6:
            nx, ny, nz, length = gx, gy, gz, 1.0
        nx, ny, nz = nx / length, ny / length, nz / length
        nv = -(nx * rays[i, 3] + ny * rays[i, 4] + nz * rays[i, 5])
        point[i, 0], point[i, 1], point[i, 2] = px, py, pz
        normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
        part[i] = tri_part[k]
        material = materials[tri_part[k]]
        mirror[i] = material[3]
        ambient[i] = material[0] + material[1]
        ox = px + SHADOW_OFFSET_MM * gx
        oy = py + SHADOW_OFFSET_MM * gy
        oz = pz + SHADOW_OFFSET_MM * gz
        lx, ly, lz = light[0] - ox, light[1] - oy, light[2] - oz
        shadow[i, 0], shadow[i, 1], shadow[i, 2] = ox, oy, oz
        shadow[i, 3], shadow[i, 4], shadow[i, 5] = lx, ly, lz
        lx, ly, lz = light[0] - px, light[1] - py, light[2] - pz
        d2 = lx * lx + ly * ly + lz * lz
        d = np.sqrt(d2)
        lx, ly, lz = lx / d, ly / d, lz / d
        nl = nx * lx + ny * ly + nz * lz
        if nl <= 0.0 or gx * lx + gy * ly + gz * lz <= 0.0 or nv <= 0.0:
            continue
        qx = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        qy = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        qz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        if qz <= 1.0:
            continue
        xd, yd = distorted(qx / qz, qy / qz, dist)
        u = K[0, 0] * xd + K[0, 2]
        v = K[1, 1] * yd + K[1, 2]
        if u < -0.5 or v < -0.5 or u > width - 0.5 or v > height - 0.5:
            continue
        hx, hy, hz = lx - rays[i, 3], ly - rays[i, 4], lz - rays[i, 5]
        h = np.sqrt(hx * hx + hy * hy + hz * hz)
        nh = (nx * hx + ny * hy + nz * hz) / h
        vh = (lx * hx + ly * hy + lz * hz) / h
        uv[i, 0], uv[i, 1] = u, v
        lit[i] = True
        depth[i] = qz
        weight[i] = reflectance(nl, nv, nh, vh, material) * nl * (REFERENCE_MM * REFERENCE_MM / d2)


def facet_weight(
    point_mm: Float32[np.ndarray, "n 3"],
    normal: Float32[np.ndarray, "n 3"],
    direction: Float32[np.ndarray, "n 3"],
    materials: Float32[np.ndarray, "n 4"],
    light_mm: Float[np.ndarray, "3"],
) -> Float32[np.ndarray, "n"]:
    """Return the weight, as in `light_at`, of points lit from a position (the projector's mirror image)."""
    weight = np.zeros(len(point_mm), np.float32)
    _facet_weight(point_mm, normal, direction, materials, light_mm, weight)
    return weight


@kernel
def _facet_weight(
    point: Any, normal: Any, direction: Any, materials: Any, light: Any, weight: Any
) -> None:
    for i in numba.prange(point.shape[0]):
        d2, nl, nv = 0.0, 0.0, 0.0
        for k in range(3):
            step = light[k] - point[i, k]
            d2 += step * step
            nl += step * normal[i, k]
            nv -= direction[i, k] * normal[i, k]
        d = np.sqrt(d2)
        nl /= d
        if nl <= 0.0 or nv <= 0.0:
            continue
        h2, nh, vh = 0.0, 0.0, 0.0
        for k in range(3):
            half = (light[k] - point[i, k]) / d - direction[i, k]
            h2 += half * half
            nh += half * normal[i, k]
            vh -= half * direction[i, k]
        h = np.sqrt(h2)
        brdf = reflectance(nl, nv, nh / h, vh / h, materials[i])
        weight[i] = brdf * nl * (REFERENCE_MM * REFERENCE_MM / d2)
