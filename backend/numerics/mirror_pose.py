"""Where the mirror stands: from its outline in the picture, or from markers beside it."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from backend.numerics.camera_model import Pinhole, RigidTransform, inverse, rays
from backend.numerics.errors import MirrorError

_MOST_EDGES = 800
_LEAST_EDGES = 30
_MARKER_ERROR_PX = 5.0
_OUTLINE_ERROR_SHARE = 0.05


def pose_from_markers(
    pixels_px: Float[np.ndarray, "n 2"], points_mm: Float[np.ndarray, "n 3"], camera: Pinhole
) -> RigidTransform:
    """Find the mirror's pose from points on it, or fixed to it, that the picture shows.

    Parameters
    ----------
    pixels_px
        Where the markers are in the picture.
    points_mm
        Where they are in the mirror's frame.
    camera
        Camera model.

    Returns
    -------
    RigidTransform
        mirror_from_camera.

    Raises
    ------
    MirrorError
        If there are fewer than four markers, or no pose shows them within 5 px (rms).
    """
    if len(pixels_px) < 4:
        raise MirrorError(
            f"{len(pixels_px)} markers don't determine the mirror's pose: give at least four"
        )
    flat = bool(np.ptp(points_mm[:, 2]) < 1e-9 * max(1.0, float(np.ptp(points_mm))))
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    try:
        found, turn, shift = cv2.solvePnP(
            np.ascontiguousarray(points_mm, np.float64),
            np.ascontiguousarray(pixels_px, np.float64),
            camera.K,
            camera.distortion,
            flags=method,
        )
        if found:
            turn, shift = cv2.solvePnPRefineLM(
                points_mm.astype(np.float64),
                pixels_px.astype(np.float64),
                camera.K,
                camera.distortion,
                turn,
                shift,
            )
    except cv2.error:
        found = False
    if not found:
        raise MirrorError(
            f"no pose of the mirror shows its {len(pixels_px)} markers: check their order and that they don't lie on one line"
        )
    shown, _ = cv2.projectPoints(
        points_mm.astype(np.float64), turn, shift, camera.K, camera.distortion
    )
    rms_px = float(np.sqrt(((shown[:, 0] - pixels_px) ** 2).sum(axis=1).mean()))
    if not rms_px <= _MARKER_ERROR_PX:
        raise MirrorError(
            f"the markers are {rms_px:.1f} px (rms) from where the best pose shows them: check their order and unit"
        )
    return inverse(RigidTransform(np.asarray(cv2.Rodrigues(turn)[0]), shift.ravel()))


def pose_from_outline(
    mask: Bool[np.ndarray, "h w"],
    outline_mm: Float[np.ndarray, "n 2"],
    camera: Pinhole,
    screen_mm: Float[np.ndarray, "3"],
    *,
    distance_mm: float | None = None,
) -> RigidTransform:
    r"""Find the mirror's pose from the edge of its picture.

    Parameters
    ----------
    mask
        Pixels that see the mirror.
    outline_mm
        Corners of the mirror's edge in x and y of its frame, in order; convex. A round mirror is a polygon of
        many corners.
    camera
        Camera model.
    screen_mm
        Middle of the screen in the camera's frame: the mirror faces between the two.
    distance_mm
        Known distance from the mirror to the screen's middle, a start; None: estimated from the picture's size.

    Returns
    -------
    RigidTransform
        mirror_from_camera. Tilt is known to about the edge's noise over the mirror's size; slopes correct it.

    Raises
    ------
    MirrorError
        If the mask is empty or cut by the picture's border, or no pose fits its edge.

    Notes
    -----
    The start faces halfway between camera and screen, upright, at the distance where its area is the mask's.
    Then least squares over rotation and translation of the distances, in the mirror's plane, from the edge's
    rays to the polygon (edges lie halfway between a pixel of the mask and one beside it).
    """
    # scipy.optimize costs 0.2 s to import: only rigs without a given pose pay.
    from scipy.optimize import least_squares

    edge_px = _edge(mask)
    slopes = rays(edge_px, camera)
    directions = np.column_stack([slopes, np.ones(len(slopes))])
    corners = _anticlockwise(outline_mm)
    start = _start_pose(mask, corners, camera, screen_mm, distance_mm)
    size_mm = float(np.ptp(corners, axis=0).max())

    def misfit(change: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "n"]:
        pose = _changed(start, change, size_mm)
        at = _plane_points(directions, pose)
        return _distances(at, corners) / size_mm

    found = least_squares(misfit, np.zeros(6), loss="soft_l1", f_scale=0.01, max_nfev=100)
    rms = float(np.sqrt(np.median(misfit(found.x) ** 2)))
    if not rms <= _OUTLINE_ERROR_SHARE:
        raise MirrorError(
            f"the outline's shape doesn't fit the mask's edge ({rms:.1%} of the mirror's size away): "
            "check the outline, or paint the mask"
        )
    return _changed(start, found.x, size_mm)


def circle_outline(diameter_mm: float, corners: int = 90) -> Float64[np.ndarray, "n 2"]:
    """Return a polygon of a circle's area."""
    angle = np.arange(corners) * 2 * np.pi / corners
    radius = diameter_mm / 2 / np.sqrt(np.sin(2 * np.pi / corners) * corners / (2 * np.pi))
    return np.asarray(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _edge(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "n 2"]:
    """Return places halfway between the largest patch's pixels and those beside it."""
    count, labels, sizes, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=4
    )
    if count < 2:
        raise MirrorError("no pixel sees the mirror, so it has no outline: check the mask")
    largest = labels == 1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))
    border = sum(
        int(line.sum()) for line in (largest[0], largest[-1], largest[:, 0], largest[:, -1])
    )
    across_y, across_x = np.nonzero(largest[:, 1:] != largest[:, :-1])
    down_y, down_x = np.nonzero(largest[1:] != largest[:-1])
    edge = np.concatenate(
        [
            np.column_stack([across_x + 0.5, across_y]),
            np.column_stack([down_x, down_y + 0.5]),
        ]
    ).astype(np.float64)
    if border > 0.05 * len(edge):
        raise MirrorError(
            "the mirror is cut by the picture's border, so its outline isn't known: "
            "give its pose or markers, or move it into view"
        )
    if len(edge) < _LEAST_EDGES:
        raise MirrorError(f"the mirror's outline is {len(edge)} px long only: check the mask")
    return edge[:: max(1, len(edge) // _MOST_EDGES)]


def _anticlockwise(corners: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise MirrorError(
            f"an outline of {len(corners)} corners is no surface: give at least three"
        )
    return np.asarray(corners if _area(corners) > 0 else corners[::-1], np.float64)


def _area(corners: Float[np.ndarray, "n 2"]) -> float:
    after = np.roll(corners, -1, axis=0)
    return float((corners[:, 0] * after[:, 1] - after[:, 0] * corners[:, 1]).sum() / 2)


def _start_pose(
    mask: Bool[np.ndarray, "h w"],
    corners: Float64[np.ndarray, "n 2"],
    camera: Pinhole,
    screen_mm: Float[np.ndarray, "3"],
    distance_mm: float | None,
) -> RigidTransform:
    """Return camera_from_mirror, facing halfway between camera and screen."""
    y, x = np.nonzero(mask)
    middle_px = np.array([[x.mean(), y.mean()]])
    direction = np.append(rays(middle_px, camera)[0], 1.0)
    seen = mask.sum() / (camera.K[0, 0] * camera.K[1, 1])
    depth_mm = float(np.sqrt(_area(corners) / seen))
    for _ in range(3):
        middle = depth_mm * direction
        if distance_mm is not None:
            middle = direction * _depth_at(direction, screen_mm, distance_mm)
        normal = -middle / np.linalg.norm(middle)
        to_screen = screen_mm - middle
        normal = normal + to_screen / np.linalg.norm(to_screen)
        normal /= np.linalg.norm(normal)
        # A tilted mirror looks smaller than it is.
        facing = abs(float(normal @ direction)) / float(np.linalg.norm(direction))
        depth_mm = float(np.sqrt(_area(corners) / seen * facing))
    up = np.array([0.0, -1.0, 0.0])
    right = np.cross(up, normal)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(normal, right), normal], axis=1)
    shift = R[:, :2] @ corners.mean(axis=0)
    return RigidTransform(R, middle - shift)


def _depth_at(
    direction: Float64[np.ndarray, "3"], screen_mm: Float[np.ndarray, "3"], distance_mm: float
) -> float:
    """Return the depth at which a ray is a known distance from the screen, the farther one."""
    a, b = float(direction @ direction), float(direction @ screen_mm)
    inside = b * b - a * (float(screen_mm @ screen_mm) - distance_mm**2)
    if inside < 0:
        raise MirrorError(
            f"no point in view is {distance_mm:g} mm from the screen: measure the distance again"
        )
    return float((b + np.sqrt(inside)) / a)


def _changed(
    start: RigidTransform, change: Float64[np.ndarray, "6"], size_mm: float
) -> RigidTransform:
    """Return mirror_from_camera after a small turn about the mirror's origin and a shift."""
    R = start.R @ np.asarray(cv2.Rodrigues(change[:3])[0])
    return inverse(RigidTransform(R, start.t_mm + size_mm * change[3:]))


def _plane_points(
    directions: Float64[np.ndarray, "n 3"], mirror_from_camera: RigidTransform
) -> Float64[np.ndarray, "n 2"]:
    along = directions @ mirror_from_camera.R.T
    origin = mirror_from_camera.t_mm
    return np.asarray(origin[:2] - (origin[2] / along[:, 2])[:, None] * along[:, :2])


def _distances(
    points: Float64[np.ndarray, "n 2"], corners: Float64[np.ndarray, "m 2"]
) -> Float64[np.ndarray, "n"]:
    """Return the distances to a convex polygon's edge, negative inside."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    offset = points[:, None, :] - corners
    outwards = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / lengths[:, None]
    beyond = (offset * outwards).sum(axis=2)
    along = np.clip((offset * sides).sum(axis=2) / lengths**2, 0.0, 1.0)
    nearest = offset - along[:, :, None] * sides
    away = np.linalg.norm(nearest, axis=2).min(axis=1)
    return np.asarray(np.where(beyond.max(axis=1) > 0, away, -away))
