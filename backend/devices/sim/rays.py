"""Camera pixels to rays and points to pixels, OpenCV's lens model, in the rig's frame."""

from typing import Any

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32

from backend.devices.sim.layout import View
from backend.numerics.kernels import kernel, row_loop


@row_loop
def distorted(x: Any, y: Any, k: Any) -> Any:
    """Apply OpenCV's k1 k2 p1 p2 k3 to normalised coordinates."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    xd = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
    yd = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
    return xd, yd


def coefficients(distortion: Float[np.ndarray, "n"]) -> Float[np.ndarray, "5"]:
    """Pad distortion to k1 k2 p1 p2 k3."""
    five = np.zeros(5)
    five[: len(distortion)] = distortion
    return five


def pixel_rays(
    camera: View, rows: range, offset_px: tuple[float, float] = (0.0, 0.0)
) -> tuple[Float32[np.ndarray, "n 6"], Float32[np.ndarray, "n"]]:
    """Return the rays of whole rows of pixels, origin and unit direction, and the lens's cos^4 falloff.

    Notes
    -----
    The distortion is inverted by fixed-point iteration to 1e-12, far below what float32 keeps.
    """
    model, pose = camera.model, camera.device_from_rig
    n = len(rows) * model.width_px
    rays, falloff = np.empty((n, 6), np.float32), np.empty(n, np.float32)
    _pixel_rays(
        np.ascontiguousarray(model.K),
        coefficients(model.distortion),
        np.ascontiguousarray(pose.R),
        camera.position_mm,
        *(rows.start, len(rows), model.width_px, offset_px[0], offset_px[1]),
        *(rays, falloff),
    )
    return rays, falloff


@kernel
def _pixel_rays(
    K: Any,
    dist: Any,
    R: Any,
    origin: Any,
    first_row: Any,
    n_rows: Any,
    width: Any,
    dx: Any,
    dy: Any,
    rays: Any,
    falloff: Any,
) -> None:
    for row in numba.prange(n_rows):
        yd = (first_row + row + dy - K[1, 2]) / K[1, 1]
        for column in range(width):
            xd = (column + dx - K[0, 2]) / K[0, 0]
            x, y = xd, yd
            for _ in range(50):
                x2, y2 = distorted(x, y, dist)
                ex, ey = xd - x2, yd - y2
                x, y = x + ex, y + ey
                if abs(ex) + abs(ey) < 1e-12:
                    break
            length = np.sqrt(x * x + y * y + 1.0)
            i = row * width + column
            for k in range(3):
                rays[i, k] = origin[k]
                # The direction in the rig's frame: R transposed times (x, y, 1).
                rays[i, 3 + k] = (R[0, k] * x + R[1, k] * y + R[2, k]) / length
            falloff[i] = 1.0 / length**4


def project(
    points_mm: Float32[np.ndarray, "n 3"], device: View
) -> tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return the pixel of points in the rig's frame, their depth in [mm], and whether the pixel is on the picture."""
    model, pose = device.model, device.device_from_rig
    uv = np.empty((len(points_mm), 2), np.float32)
    depth = np.empty(len(points_mm), np.float32)
    _project(
        points_mm,
        *(np.ascontiguousarray(pose.R), pose.t_mm, np.ascontiguousarray(model.K)),
        *(coefficients(model.distortion), uv, depth),
    )
    size = np.array([model.width_px, model.height_px])
    inside = ((uv >= -0.5) & (uv <= size - 0.5)).all(axis=1) & (depth > 0)
    return uv, depth, inside


@kernel
def _project(points: Any, R: Any, t: Any, K: Any, dist: Any, uv: Any, depth: Any) -> None:
    for i in numba.prange(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        xd, yd = distorted(x / z, y / z, dist)
        uv[i, 0] = K[0, 0] * xd + K[0, 2]
        uv[i, 1] = K[1, 1] * yd + K[1, 2]
        depth[i] = z
