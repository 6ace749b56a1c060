"""The projector's and a second camera's word on pixels whose match isn't clear."""

from typing import Any

import numba
import numpy as np
from jaxtyping import Float32, UInt16

from backend.numerics.camera_model import Pinhole, RigidTransform
from backend.numerics.kernels import kernel, kernel_input, row_loop
from backend.numerics.lattice import lattice_point, lattice_row
from backend.numerics.rectification import Rectification
from backend.numerics.triangulation import Cloud, along_ray, plane_depths, projector_planes

SYSTEMATIC_PX = 0.3
"""Error of the calibration, in projector pixels, that is allowed beside the noise."""

_FACTOR = 4.0
"""Number of standard deviations that are noise."""
_BOTH_SIGMAS = 1.5
"""Noise of the difference of both cameras' coordinates over the reference's."""
_TILE = 256
"""Pixels that are triangulated together if one of them is in doubt."""


def settle(
    cloud: Cloud,
    reasons: UInt16[np.ndarray, "h w"],
    coordinate_px: Float32[np.ndarray, "h w"],
    sigma_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h2 w2"],
    rectification: Rectification,
    projector: Pinhole,
    projector_from_camera: RigidTransform,
) -> None:
    r"""Take the projector's word for pixels without a point, where the other camera confirms it.

    Parameters
    ----------
    cloud, reasons
        Points of both cameras in the reference camera's frame; changed in place. A settled pixel has no reason.
    coordinate_px, sigma_px
        Projector column of each pixel of the reference camera and its standard deviation in [px].
    other_px
        The other camera's columns in [px], NaN invalid.
    rectification
        Geometry of the two cameras.
    projector
        Model of the projector.
    projector_from_camera
        Its pose with respect to the reference camera.

    Raises
    ------
    CalibrationError
        If the projector's model or pose can't be used.

    Notes
    -----
    The ray's point on the projector's plane is confirmed where the other camera sees it with the same coordinate,

    .. math:: |u_{other} - u| \le 4 \cdot 1.5 \, \sigma_u + 0.3 \text{ px}

    It isn't outside of the other picture, and where the coordinate there is missing or belongs to another surface.
    Only tiles with a pixel in doubt cost more than reading the depth.
    """
    _settle_rows(
        cloud.depth_mm,
        cloud.sigma_mm,
        reasons,
        kernel_input(coordinate_px),
        kernel_input(sigma_px),
        kernel_input(other_px),
        cloud.rays.nodes,
        projector_planes(projector, projector_from_camera),
        rectification.rectified_of_reference.nodes,
        rectification.pixel_of_other.nodes,
        np.array(rectification.other, np.float64),
        np.ascontiguousarray(rectification.rectified_from_reference[:, 2]),
        np.array([rectification.focal_px, rectification.baseline_mm], np.float64),
    )


@row_loop
def _doubtful(depth: Any, coordinate: Any) -> Any:
    """Count pixels that have a coordinate but no point."""
    count = 0
    for i in range(depth.size):
        # NaN is the only value that doesn't equal itself
        count += 1 if depth[i] != depth[i] and coordinate[i] == coordinate[i] else 0
    return count


@row_loop
def _seen(values: Any, x: Any, y: Any) -> Any:
    """Interpolate between four pixels; NaN outside and where one of them is missing."""
    height, width = values.shape
    if not (0.0 <= x < width - 1 and 0.0 <= y < height - 1):
        return np.nan
    i, j = np.int64(x), np.int64(y)
    a, b = x - i, y - j
    above = (1.0 - a) * values[j, i] + a * values[j, i + 1]
    below = (1.0 - a) * values[j + 1, i] + a * values[j + 1, i + 1]
    return (1.0 - b) * above + b * below


@row_loop
def _settle_part(
    depth: Any,
    sigma: Any,
    reasons: Any,
    u: Any,
    sigma_u: Any,
    found: Any,
    found_sigma: Any,
    x: Any,
    line: Any,
    axis: Any,
    pair: Any,
    other: Any,
    nodes: Any,
    values: Any,
) -> Any:
    for i in range(depth.size):
        if not np.isnan(depth[i]) or np.isnan(found[i]):
            continue
        # depth in the rectified frame, and with it the place on the other camera's canvas
        forward = (axis[0] * x[i] + axis[1] * line[i]) / pair[0] + axis[2]
        place = x[i] - pair[0] * pair[1] * forward / found[i] - other[0]
        row = line[i] - other[1]
        if not (0.0 <= place <= other[2] - 1.0 and 0.0 <= row <= other[3] - 1.0):
            continue
        px, py = lattice_point(nodes[0], place, row), lattice_point(nodes[1], place, row)
        limit = SYSTEMATIC_PX + _FACTOR * _BOTH_SIGMAS * sigma_u[i]
        if abs(_seen(values, px, py) - u[i]) <= limit:  # False with NaN
            depth[i], sigma[i], reasons[i] = found[i], found_sigma[i], 0


@kernel
def _settle_rows(
    depth: Any,
    sigma: Any,
    reasons: Any,
    coordinate: Any,
    sigma_px: Any,
    values: Any,
    rays: Any,
    planes: Any,
    rectifying: Any,
    pixel_of_other: Any,
    other: Any,
    axis: Any,
    pair: Any,
) -> None:
    height, width = depth.shape
    for row in numba.prange(height):
        if _doubtful(depth[row], coordinate[row]) == 0:
            continue
        lines = np.empty((4, width), np.float64)
        work = np.empty(rays.shape[2], np.float64)
        for k in range(2):
            lattice_row(rays[k], row, work, lines[k])
            lattice_row(rectifying[k], row, work, lines[2 + k])
        found = np.empty((3, _TILE), np.float64)
        for begin in range(0, width, _TILE):
            end = min(begin + _TILE, width)
            if _doubtful(depth[row, begin:end], coordinate[row, begin:end]) == 0:
                continue
            z, per_px, noise = (
                found[0, : end - begin],
                found[1, : end - begin],
                found[2, : end - begin],
            )
            x, y, u = lines[0, begin:end], lines[1, begin:end], coordinate[row, begin:end]
            plane_depths(x, y, u, planes, z, per_px)
            along_ray(x, y, z, per_px, sigma_px[row, begin:end], noise)
            _settle_part(
                depth[row, begin:end],
                sigma[row, begin:end],
                reasons[row, begin:end],
                u,
                sigma_px[row, begin:end],
                z,
                noise,
                lines[2, begin:end],
                lines[3, begin:end],
                axis,
                pair,
                other,
                pixel_of_other,
                values,
            )
