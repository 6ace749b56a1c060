"""From projector codes to points: cameras against the calibrated projector."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt16

from backend.domain.errors import StageFailedError
from backend.domain.params import Params, setting
from backend.domain.rig import RigCalibration
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.camera_model import Pinhole, RigidTransform, project
from backend.numerics.code_points import triangulate_code
from backend.numerics.gray_code import distinct_projector_pixels
from backend.numerics.normals import normals
from backend.numerics.reasons import Reason
from backend.numerics.triangulation import projector_consistency, triangulate_projector
from backend.stages.cloud import (
    Cloud,
    FilterRow,
    colour_of,
    enough_points,
    precise_enough,
)
from backend.stages.dense_points import dense_cloud
from backend.stages.edges import Codes
from backend.stages.rig_geometry import pinhole, projector_from_reference, require_camera

_EXPOSURE_UNKNOWN = 255
_ROUNDING_PX = float(1 / np.sqrt(12.0))
"""Standard deviation of a position that is known to a whole pixel."""
_EPIPOLAR_PX = 4.0
"""Allowed of whole columns, whose rows are whole, too."""
_FILTER_NAMES = {
    Reason.CLIPPED: "camera pixels nearer or farther than allowed",
    Reason.EPIPOLAR: "camera pixels off their epipolar line",
}


class CodeCloudParams(Params):
    """Which points are kept."""

    cameras: Literal["all", "reference"] = setting("all", title="Cameras used")
    """all: with sub-pixel columns the second camera averages, contradicts and fills in; reference: one camera."""
    epipolar_px: float | None = setting(
        None, title="Row against epipolar line", unit="px", gt=0, le=1000, auto="consistency_px"
    )
    """By how many projector pixels the row code may miss the place where the point projects to: light that
    came by a second reflection misses it. Automatic: 4 for whole columns; as fine as the rows are read for
    sub-pixel columns."""
    agreement_px: float = setting(
        0.3, title="Contradiction of two cameras", unit="px", ge=0, le=100, advanced=True
    )
    """In projector pixels beside 5 sigma of noise: beyond it neither is believed."""
    outlier_sigmas: float = setting(6.0, title="Outliers beyond", unit="sigma", ge=0, le=100)
    """Sub-pixel columns only: points so far from the median of their 5x5 neighbourhood, and alone there, are
    removed; 0 = off."""
    speck_px: int | None = setting(None, title="Smallest patch", unit="px", ge=0, le=100_000)
    """Sub-pixel columns only: connected patches of fewer pixels are removed; 0 = off. Automatic: one in 20 000 of
    the picture's pixels."""
    spread_px: float = setting(
        3.0, title="Spread of one code", unit="px", gt=0, le=1000, advanced=True
    )
    """Camera pixels that see one projector pixel lie this near to their mean (root mean square): the same
    code at separate places is no surface."""
    near_mm: float = setting(0.0, title="Nearest point", unit="mm", ge=0, advanced=True)
    far_mm: float | None = setting(None, title="Farthest point", unit="mm", gt=0, advanced=True)
    """Distance from the camera along its axis; none: no limit."""


@stage(title="Cloud", version=2, review=Review.ON_WARNING, checks=(enough_points, precise_enough))
def code_cloud(
    codes: Codes, calibration: RigCalibration, params: CodeCloudParams, progress: Progress
) -> Cloud:
    """Intersect each camera ray with its projector column, checked by the row and by a second camera."""
    rig = _Pair.of(calibration)
    if rig.name not in codes.projector_px:
        raise StageFailedError(
            f"Camera {rig.name!r} has no column code: points need the columns of the reference camera."
        )
    if rig.name in codes.sigma_px:
        progress(0.0, "every pixel against the projector")
        return dense_cloud(codes, calibration, _cameras(codes, calibration, params), params)
    progress(0.0, "every pixel against its epipolar line")
    pixels = _pixel_points(codes, rig, params)
    progress(0.5, "projector pixels")
    if rig.name in codes.projector_row_px:
        points = _points_of_projector(codes, rig, params, pixels)
    else:
        points = _points_of_pixels(rig, pixels)
    return _cloud(codes, rig, pixels, points, _epipolar_px(params))


def _cameras(codes: Codes, calibration: RigCalibration, params: CodeCloudParams) -> tuple[str, ...]:
    """Name the cameras that take part, the reference first."""
    first = calibration.reference
    if params.cameras == "reference":
        return (first,)
    others = [n for n in codes.sigma_px if n != first and n in calibration.camera_from_world]
    return (first, *others)


def _epipolar_px(params: CodeCloudParams) -> float:
    return params.epipolar_px or _EPIPOLAR_PX


@dataclass(frozen=True)
class _Pair:
    """The reference camera and the projector."""

    name: str
    camera: Pinhole
    projector: Pinhole
    projector_from_camera: RigidTransform

    @classmethod
    def of(cls, calibration: RigCalibration) -> "_Pair":
        """Take them out of the rig's calibration."""
        projector_from_camera = projector_from_reference(calibration)
        if calibration.projector is None or projector_from_camera is None:
            raise StageFailedError(
                "The projector isn't calibrated: points from one camera need its calibration."
            )
        name = calibration.reference
        camera, projector = require_camera(calibration, name), pinhole(calibration.projector)
        return cls(name, camera, projector, projector_from_camera)


@dataclass(frozen=True)
class _PixelPoints:
    """One point per camera pixel: to check each one, and for the depth map."""

    points_mm: Float32[np.ndarray, "h w 3"]
    reasons: UInt16[np.ndarray, "h w"]
    sigma_px: float
    """Robust standard deviation of the row's residual: how well code and calibration agree."""
    removed: tuple[FilterRow, ...]
    epipolar_sigma_px: float = float("nan")
    """The same of all pixels, before any is removed."""

    @property
    def valid(self) -> Bool[np.ndarray, "h w"]:
        """The pixels that are kept."""
        return np.asarray(self.reasons == 0)


def _pixel_points(codes: Codes, rig: _Pair, params: CodeCloudParams) -> _PixelPoints:
    rows = codes.projector_row_px.get(rig.name)
    points_mm = triangulate_projector(
        codes.projector_px[rig.name], rig.camera, rig.projector, rig.projector_from_camera
    ).points_mm
    reasons = codes.reasons[rig.name].copy()
    depth_mm = points_mm[..., 2]
    outside = ~((depth_mm >= params.near_mm) & (depth_mm <= (params.far_mm or np.inf)))
    clipped = _reject(reasons, outside, Reason.CLIPPED)
    if rows is None:
        return _PixelPoints(points_mm, reasons, _ROUNDING_PX, (clipped,))
    residual_px = projector_consistency(
        points_mm, rows, rig.projector, rig.projector_from_camera, rows=True
    )
    spread_px = _robust_sigma(residual_px[(reasons == 0) & np.isfinite(residual_px)])
    off = _reject(reasons, ~(np.abs(residual_px) <= _epipolar_px(params)), Reason.EPIPOLAR)
    sigma_px = max(_ROUNDING_PX, _robust_sigma(residual_px[reasons == 0]))
    return _PixelPoints(points_mm, reasons, sigma_px, (clipped, off), spread_px)


def _reject(
    reasons: UInt16[np.ndarray, "h w"], bad: Bool[np.ndarray, "h w"], reason: Reason
) -> FilterRow:
    """Note a reason where there was none, and count."""
    hit = bad & (reasons == 0)
    reasons[hit] = np.uint16(reason)
    return FilterRow(_FILTER_NAMES[reason], int(np.count_nonzero(hit)))


def _robust_sigma(values: Float32[np.ndarray, "n"]) -> float:
    if values.size == 0:
        return 0.0
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class _Points:
    """The points of the cloud, in any order."""

    points_mm: Float[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    sigma_mm: Float[np.ndarray, "n"]
    camera_px: Float[np.ndarray, "n 2"]
    removed: tuple[FilterRow, ...] = ()


def _points_of_pixels(rig: _Pair, pixels: _PixelPoints) -> _Points:
    """Make one point per camera pixel, where rows weren't coded."""
    points_mm = np.where(pixels.valid[..., None], pixels.points_mm, np.float32(np.nan))
    y, x = np.nonzero(pixels.valid)
    camera_px = np.column_stack([x, y]).astype(np.float64)
    found = points_mm[y, x].astype(np.float64)
    position_px = project(found, rig.projector, rig.projector_from_camera)
    again = triangulate_code(
        camera_px, position_px, rig.camera, rig.projector, rig.projector_from_camera
    )
    return _Points(
        found,
        normals(points_mm, rig.camera)[y, x],
        again.sigma_per_px_mm * pixels.sigma_px,
        camera_px,
    )


def _points_of_projector(
    codes: Codes, rig: _Pair, params: CodeCloudParams, pixels: _PixelPoints
) -> _Points:
    """Average the camera pixels that see a projector pixel, and triangulate their mean."""
    seen = distinct_projector_pixels(
        _whole(codes.projector_px[rig.name], pixels.valid),
        _whole(codes.projector_row_px[rig.name], pixels.valid),
        width_px=rig.projector.width_px,
        height_px=rig.projector.height_px,
    )
    result = triangulate_code(
        seen.camera_px,
        seen.projector_px.astype(np.float64),
        rig.camera,
        rig.projector,
        rig.projector_from_camera,
    )
    on_line = np.abs(result.row_residual_px) <= _epipolar_px(params)
    together = seen.spread_px <= params.spread_px
    keep = on_line & together
    at = seen.projector_px[keep]
    return _Points(
        result.points_mm[keep],
        _projector_normals(rig, at, result.points_mm[keep]),
        result.sigma_per_px_mm[keep] * pixels.sigma_px,
        seen.camera_px[keep],
        (
            FilterRow("projector pixels off their epipolar line", int(np.count_nonzero(~on_line))),
            FilterRow("projector pixels seen apart", int(np.count_nonzero(on_line & ~together))),
        ),
    )


def _whole(
    position_px: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Int32[np.ndarray, "h w"]:
    """Round to the number of the projector pixel; -1 where none is known."""
    return np.floor(np.where(valid, position_px, np.float32(-1)) + np.float32(0.5)).astype(np.int32)


def _projector_normals(
    rig: _Pair, at: Int32[np.ndarray, "n 2"], points_mm: Float64[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Fit planes on the projector's grid, where the points are dense; turned towards the camera."""
    R, t_mm = rig.projector_from_camera
    grid = np.full((rig.projector.height_px, rig.projector.width_px, 3), np.nan, np.float32)
    grid[at[:, 1], at[:, 0]] = points_mm @ R.T + t_mm
    on_grid = normals(grid, rig.projector)[at[:, 1], at[:, 0]]
    found = np.asarray(on_grid @ R.astype(np.float32), np.float32)
    faces_away = (found * points_mm).sum(axis=1) > 0
    found[faces_away] *= np.float32(-1)
    return found


def _cloud(
    codes: Codes, rig: _Pair, pixels: _PixelPoints, points: _Points, epipolar_px: float
) -> Cloud:
    """Bring the points into the order of the camera's pixels and describe them."""
    pixel_px = np.round(points.camera_px).astype(np.int64)
    order = np.asarray(np.lexsort((pixel_px[:, 0], pixel_px[:, 1])), np.int64)
    row, column = pixel_px[order, 1], pixel_px[order, 0]
    decoded = int(np.count_nonzero(codes.reasons[rig.name] == 0))
    sigma_mm = points.sigma_mm[order].astype(np.float32)
    brightness = codes.brightness[rig.name][row, column]
    depth_mm = np.where(pixels.valid, pixels.points_mm[..., 2], np.float32(np.nan))
    return Cloud(
        points_mm=points.points_mm[order].astype(np.float32),
        normals=np.nan_to_num(points.normals[order]),
        colour=colour_of(brightness, order.size),
        sigma_mm=sigma_mm,
        pixel_x=points.camera_px[order, 0].astype(np.float32),
        pixel_y=points.camera_px[order, 1].astype(np.float32),
        exposure_index=np.full(order.size, _EXPOSURE_UNKNOWN, np.uint8),
        depth_mm={rig.name: depth_mm},
        reasons={rig.name: pixels.reasons},
        removed=(*pixels.removed, *points.removed),
        point_count=int(order.size),
        median_sigma_mm=float(np.median(sigma_mm)) if order.size else float("nan"),
        kept_share=int(np.count_nonzero(pixels.valid)) / max(decoded, 1),
        cameras=(rig.name,),
        consistency_px=epipolar_px if rig.name in codes.projector_row_px else float("nan"),
        epipolar_sigma_px=pixels.epipolar_sigma_px,
    )
