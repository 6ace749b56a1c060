"""Which projector pixels light each camera pixel, and how strongly: cast once, used for every frame.

A frame then is: the projected picture sampled at each pixel's projector coordinate, times its weight,
plus what arrives over one mirror, plus ambient light.

Mirrors work both ways, one bounce each. *Seen in a mirror*: a camera ray that hits a mirror is reflected,
and what it hits then is lit by the projector. *Lit by a mirror*: flat mirror facets throw the projected
picture on other surfaces; the light seems to come from the projector's mirror image behind the facet.
Curved mirrors are seen in but throw no light (no caustics).
"""

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32

from backend.devices.sim.layout import View
from backend.devices.sim.rays import pixel_rays, project
from backend.devices.sim.shading import (
    REFERENCE_MM,
    SHADOW_OFFSET_MM,
    Lighting,
    Surfaces,
    facet_weight,
    light_at,
)

_CHUNK = 1 << 18
"""Rays per cast: bounds memory at any picture size."""


class Bounces(NamedTuple):
    """Light over a mirror, for the pixels that get any; a pixel may occur several times."""

    pixel: Int32[np.ndarray, "n"]
    """Index into the flattened picture, ascending in a `Transport`."""
    u_px: Float32[np.ndarray, "n"]
    v_px: Float32[np.ndarray, "n"]
    weight: Float32[np.ndarray, "n"]
    depth_mm: Float32[np.ndarray, "n"]


@dataclass(frozen=True)
class Transport:
    """Everything between projector and one camera, per pixel and sample of the pixel."""

    u_px: Float32[np.ndarray, "samples h w"]
    v_px: Float32[np.ndarray, "samples h w"]
    """Projector pixel that lights what is seen."""
    weight: Float32[np.ndarray, "samples h w"]
    """0: not lit, not in the projector's picture, or nothing there. Samples add up to the pixel."""
    depth_mm: Float32[np.ndarray, "samples h w"]
    """Distance along the projector's axis."""
    ambient: Float32[np.ndarray, "h w"]
    bounces: Bounces


class Caster:
    """A scene that rays can be cast into."""

    def __init__(self, scene: Surfaces, projector: View) -> None:
        # 0.6 s and 100 MB: only when a simulated rig is opened. Its type stubs are wrong: Any.
        o3d: Any = importlib.import_module("open3d")
        self.surfaces = scene
        self.projector = projector
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(scene.vertices_mm), self._tensor(scene.triangles.astype(np.uint32))
        )

    def light(self, rays: Float32[np.ndarray, "n 6"]) -> tuple[Lighting, Int32[np.ndarray, "n"]]:
        """Cast rays and shade what they hit, shadows included. Also return the triangle hit, -1 for none."""
        hit_mm, triangle, barycentric = self.first_hit(rays)
        lighting = light_at(rays, hit_mm, triangle, barycentric, self.surfaces, self.projector)
        candidates = np.flatnonzero(lighting.lit)
        dark = candidates[self.blocked(lighting.shadow_rays[candidates])]
        lighting.lit[dark] = False
        lighting.weight[dark] = 0.0
        return lighting, triangle

    def first_hit(
        self, rays: Float32[np.ndarray, "n 6"]
    ) -> tuple[Float32[np.ndarray, "n"], Int32[np.ndarray, "n"], Float32[np.ndarray, "n 2"]]:
        """Return distance in ray lengths (inf: none), triangle (-1: none) and barycentric coordinates."""
        hits = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays)))
        return (
            hits["t_hit"].numpy(),
            hits["primitive_ids"].numpy().astype(np.int32),
            hits["primitive_uvs"].numpy(),
        )

    def blocked(
        self, rays: Float32[np.ndarray, "n 6"]
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Tell which rays hit something before they are one length long."""
        if not len(rays):
            return np.zeros(0, bool)
        blocked: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = self._scene.test_occlusions(
            self._tensor(np.ascontiguousarray(rays)), 0.0, 0.9999
        ).numpy()
        return blocked


def cast(caster: Caster, camera: View, samples: int) -> Transport:
    """Trace a camera's pixels, `samples` (a square number) rays each.

    Notes
    -----
    About 1 us per ray on two cores, plus as much again for each mirror facet that throws light.
    """
    height, width = camera.model.height_px, camera.model.width_px
    u, v, weight, depth = (np.empty((samples, height * width), np.float32) for _ in range(4))
    ambient = np.zeros(height * width, np.float32)
    facets = mirror_facets(caster.surfaces, caster.projector)
    bounces: list[Bounces] = []
    for sample, offset in enumerate(_offsets(samples)):
        for rows in _row_chunks(height, width):
            rays, vignetting = pixel_rays(camera, rows, offset)
            part = slice(rows.start * width, rows.stop * width)
            share = vignetting / samples
            lighting, triangle = caster.light(rays)
            u[sample, part], v[sample, part] = lighting.uv_px.T
            weight[sample, part] = lighting.weight * share
            depth[sample, part] = lighting.depth_mm
            ambient[part] += lighting.ambient * share
            found = [_seen_in_mirror(caster, rays, lighting, ambient[part], share)]
            found += [_lit_by_mirror(caster, rays, lighting, triangle, f, share) for f in facets]
            bounces += [b._replace(pixel=b.pixel + np.int32(part.start)) for b in found]
    shape = (samples, height, width)
    return Transport(
        u.reshape(shape),
        v.reshape(shape),
        weight.reshape(shape),
        depth.reshape(shape),
        ambient.reshape(height, width),
        _merged(bounces),
    )


def _offsets(samples: int) -> list[tuple[float, float]]:
    n = round(samples**0.5)
    steps = (np.arange(n) + 0.5) / n - 0.5
    return [(float(x), float(y)) for y in steps for x in steps]


def _row_chunks(height: int, width: int) -> Iterator[range]:
    rows = max(1, _CHUNK // width)
    for start in range(0, height, rows):
        yield range(start, min(start + rows, height))


def _merged(bounces: list[Bounces]) -> Bounces:
    merged = Bounces(*(np.concatenate(arrays) for arrays in zip(*bounces, strict=True)))
    keep = merged.weight > 1e-5
    kept = Bounces(*(array[keep] for array in merged))
    order = np.argsort(kept.pixel, kind="stable")
    return Bounces(*(array[order] for array in kept))


def _seen_in_mirror(
    caster: Caster,
    rays: Float32[np.ndarray, "n 6"],
    lighting: Lighting,
    ambient: Float32[np.ndarray, "n"],
    share: Float32[np.ndarray, "n"],
) -> Bounces:
    """Follow the rays that hit mirrors once more; adds the ambient light they find to `ambient`."""
    pixel = np.flatnonzero(lighting.mirror > 0)
    normal, direction = lighting.normal[pixel], rays[pixel, 3:]
    reflected = direction - 2 * (direction * normal).sum(axis=1, keepdims=True) * normal
    onward = np.hstack([lighting.point_mm[pixel] + SHADOW_OFFSET_MM * normal, reflected])
    second, _ = caster.light(onward.astype(np.float32))
    factor = lighting.mirror[pixel] * share[pixel]
    ambient[pixel] += second.ambient * factor
    lit = second.weight > 0
    return Bounces(
        pixel[lit].astype(np.int32),
        second.uv_px[lit, 0],
        second.uv_px[lit, 1],
        (second.weight * factor)[lit],
        second.depth_mm[lit],
    )


class Facet(NamedTuple):
    """A flat mirror that throws the projector's picture."""

    triangles: Int32[np.ndarray, "n"]
    point_mm: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    radius_mm: float
    """Of a circle around `point_mm` that holds it all."""
    image_mm: Float[np.ndarray, "3"]
    """The projector's mirror image."""
    mirror: float


def mirror_facets(scene: Surfaces, projector: View, *, min_area_mm2: float = 60.0) -> list[Facet]:
    """Find the flat mirror facets that face the projector, by common normal and plane."""
    mirror = scene.materials[scene.part, 3]
    candidates = np.flatnonzero(mirror > 0)
    corners = scene.vertices_mm[scene.triangles[candidates]].astype(np.float64)
    normals = scene.face_normals[candidates].astype(np.float64)
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    heights = (normals * corners[:, 0]).sum(axis=1)
    real = areas > 1e-6
    keys = np.round(np.column_stack([normals * 500, heights * 10, mirror[candidates]]))
    _, group = np.unique(keys[real], axis=0, return_inverse=True)
    facets = []
    for index in np.flatnonzero(np.bincount(group, areas[real]) >= min_area_mm2):
        members = np.flatnonzero(real)[group == index]
        facet = _facet(candidates[members], corners[members], normals[members], mirror, projector)
        if facet is not None:
            facets.append(facet)
    return facets


def _facet(
    triangles: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    corners: Float[np.ndarray, "n 3 3"],
    normals: Float[np.ndarray, "n 3"],
    mirror: Float32[np.ndarray, "n_all"],
    projector: View,
) -> Facet | None:
    normal = normals.mean(axis=0)
    normal /= np.linalg.norm(normal)
    points = corners.reshape(-1, 3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    middle -= ((middle - points[0]) @ normal) * normal
    above = (projector.position_mm - middle) @ normal
    if above <= 0:
        return None
    return Facet(
        triangles.astype(np.int32),
        middle,
        normal,
        float(np.linalg.norm(points - middle, axis=1).max()),
        projector.position_mm - 2 * above * normal,
        float(mirror[triangles[0]]),
    )


def _lit_by_mirror(
    caster: Caster,
    rays: Float32[np.ndarray, "n 6"],
    lighting: Lighting,
    triangle: Int32[np.ndarray, "n"],
    facet: Facet,
    share: Float32[np.ndarray, "n"],
) -> Bounces:
    """Find which points see the projector's image in a facet, unobstructed on both legs."""
    pixel = _near_facet(lighting, triangle, facet)
    start = lighting.point_mm[pixel] + SHADOW_OFFSET_MM * lighting.normal[pixel]
    towards = np.hstack([start, facet.image_mm.astype(np.float32) - start]).astype(np.float32)
    hit, hit_triangle, _ = caster.first_hit(towards)
    through = np.isin(hit_triangle, facet.triangles)
    pixel, start = pixel[through], start[through]
    on_mirror = start + hit[through, None] * towards[through, 3:]
    leg = on_mirror + SHADOW_OFFSET_MM * facet.normal.astype(np.float32)
    to_projector = caster.projector.position_mm.astype(np.float32) - leg
    uv, depth, inside = project(on_mirror, caster.projector)
    free = inside & ~caster.blocked(np.hstack([leg, to_projector]).astype(np.float32))
    pixel = pixel[free]
    weight = facet.mirror * facet_weight(
        lighting.point_mm[pixel],
        lighting.normal[pixel],
        rays[pixel, 3:],
        caster.surfaces.materials[lighting.part[pixel]],
        facet.image_mm,
    )
    # The picture goes on spreading behind the mirror: sharpness is that of the whole way.
    way_mm = np.linalg.norm(lighting.point_mm[pixel] - facet.image_mm, axis=1)
    first_mm = np.linalg.norm(on_mirror[free] - caster.projector.position_mm, axis=1)
    return Bounces(
        pixel.astype(np.int32),
        uv[free, 0],
        uv[free, 1],
        (weight * share[pixel]).astype(np.float32),
        (depth[free] * way_mm / first_mm).astype(np.float32),
    )


def _near_facet(
    lighting: Lighting, triangle: Int32[np.ndarray, "n"], facet: Facet
) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Preselect points before the facet whose line to the image passes near it: casting costs more.

    Each test runs on what the one before left over; most points fall out at the first.
    """
    normal, image = facet.normal.astype(np.float32), facet.image_mm.astype(np.float32)
    height = lighting.point_mm @ normal - np.float32(facet.point_mm @ facet.normal)
    pixel = np.flatnonzero((triangle >= 0) & (height > SHADOW_OFFSET_MM))
    towards = image - lighting.point_mm[pixel]
    facing = np.einsum("nk,nk->n", towards, lighting.normal[pixel]) > 0
    pixel, towards, height = pixel[facing], towards[facing], height[pixel[facing]]
    depth = np.float32((facet.point_mm - facet.image_mm) @ facet.normal)
    crossing = lighting.point_mm[pixel] + towards * (height / (height + depth))[:, None]
    off = crossing - facet.point_mm.astype(np.float32)
    near = np.einsum("nk,nk->n", off, off) <= facet.radius_mm**2
    return np.asarray(pixel[near], np.int64)


__all__ = ["REFERENCE_MM", "Bounces", "Caster", "Facet", "Transport", "cast", "mirror_facets"]
