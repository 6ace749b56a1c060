"""From sub-pixel columns to one point per camera pixel: a camera against the projector, a second one beside it."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

from backend.domain.rig import RigCalibration
from backend.numerics import filters
from backend.numerics.camera_model import Pinhole, RigidTransform, inverse
from backend.numerics.filters import Kept
from backend.numerics.gathering import gather
from backend.numerics.normals import normal_limit, normals
from backend.numerics.reasons import Reason
from backend.numerics.second_camera import SecondOpinion, on_pixels, second_opinion
from backend.numerics.triangulation import Cloud as OrganisedCloud
from backend.numerics.triangulation import projector_consistency, triangulate_projector
from backend.stages.cloud import Cloud, FilterRow, colour_of
from backend.stages.edges import Codes
from backend.stages.rig_geometry import from_reference, pair_geometry

_EXPOSURE_UNKNOWN = 255
_SPREADS = 2.7
"""Rows known to whole stripes are spread evenly: this many robust standard deviations reach to their ends."""
_LEAST_SPREAD_PX = 0.5
_SIGMAS = 5.0
"""Two cameras contradict each other beyond so many standard deviations, and what calibration allows."""
_OTHER_SURFACE_PX = 4.0
"""Columns further apart are another surface that hides the point from the second camera, no contradiction."""
PIXELS_PER_SPECK = 20_000


@runtime_checkable
class DenseParams(Protocol):
    """The settings that are read here; they are those of the stage `code_cloud`."""

    @property
    def epipolar_px(self) -> float | None:
        """Row against epipolar line; None: by the scene's own spread."""

    @property
    def agreement_px(self) -> float:
        """Contradiction of two cameras allowed, beside noise."""

    @property
    def outlier_sigmas(self) -> float:
        """Outliers beyond; 0 = off."""

    @property
    def speck_px(self) -> int | None:
        """Smallest patch; None: by the picture's size."""

    @property
    def near_mm(self) -> float:
        """Nearest point."""

    @property
    def far_mm(self) -> float | None:
        """Farthest point."""


@dataclass
class _View:
    """What one camera and the projector make of the scene, in the camera's frame."""

    name: str
    camera: Pinhole
    projector: Pinhole
    projector_from_camera: RigidTransform
    column_px: Float32[np.ndarray, "h w"]
    sigma_px: Float32[np.ndarray, "h w"]
    points: OrganisedCloud
    reasons: UInt16[np.ndarray, "h w"]
    rows: list[FilterRow]
    epipolar_px: float
    """Contradiction of row and epipolar line that was allowed."""
    spread_px: float = float("nan")
    """Robust standard deviation of that contradiction."""

    def reject(self, bad: Bool[np.ndarray, "h w"], reason: Reason, title: str) -> None:
        """Remove the points of these pixels, note why, and count them."""
        known = np.isfinite(self.points.depth_mm)
        gone = np.asarray(known & bad)
        self.points.depth_mm[gone] = np.nan
        self.points.sigma_mm[gone] = np.nan
        self.reasons[gone] |= np.uint16(reason)
        self.rows.append(FilterRow(title, int(np.count_nonzero(gone))))

    def keep(self, kept: Kept, reason: Reason, title: str) -> None:
        """Remove the points that a filter doesn't keep."""
        self.reject(np.asarray(~kept.keep), reason, title)


def dense_cloud(
    codes: Codes, calibration: RigCalibration, names: tuple[str, ...], params: DenseParams
) -> Cloud:
    """Make one point per pixel of the first camera named; a second one averages, contradicts and fills in."""
    view = _view(codes, calibration, names[0], params)
    for name in names[1:]:
        other = _view(codes, calibration, name, params)
        other_from_camera = from_reference(calibration, calibration.camera_from_world[name])
        _average(view, other, other_from_camera, params)
        _fill(view, other, inverse(other_from_camera))
    _filter(view, params)
    return _cloud(codes, view, names)


def _view(codes: Codes, calibration: RigCalibration, name: str, params: DenseParams) -> _View:
    pair = pair_geometry(calibration, name)
    assert pair is not None, "the stage refuses a projector without calibration or pose"
    column_px, sigma_px = codes.projector_px[name], codes.sigma_px[name]
    points = triangulate_projector(column_px, *pair, sigma_projector_px=sigma_px)
    reasons = codes.reasons[name].copy()
    reasons[(reasons == 0) & ~np.isfinite(points.depth_mm)] |= np.uint16(Reason.NO_MATCH)
    view = _View(name, *pair, column_px, sigma_px, points, reasons, [], float("nan"))
    depth_mm = points.depth_mm
    far_mm = np.inf if params.far_mm is None else params.far_mm
    view.reject(
        (depth_mm < params.near_mm) | (depth_mm > far_mm), Reason.CLIPPED, f"{name}: clipped"
    )
    _check_rows(codes, view, params)
    return view


def _check_rows(codes: Codes, view: _View, params: DenseParams) -> None:
    """Remove points whose row isn't where the epipolar line of their column is."""
    rows = codes.projector_row_px.get(view.name)
    if rows is None:
        return
    residual_px = np.abs(
        projector_consistency(
            view.points.points_mm, rows, view.projector, view.projector_from_camera, rows=True
        )
    )
    known = residual_px[np.isfinite(residual_px)][::7]
    view.spread_px = 1.4826 * float(np.median(known)) if known.size else 0.0
    view.epipolar_px = params.epipolar_px or max(_SPREADS * view.spread_px, _LEAST_SPREAD_PX)
    view.reject(
        residual_px > view.epipolar_px, Reason.EPIPOLAR, f"{view.name}: off the epipolar line"
    )


def _average(
    view: _View, other: _View, other_from_camera: RigidTransform, params: DenseParams
) -> None:
    """Weight both cameras' words by their noise where they agree; remove the point where they don't."""
    opinion = second_opinion(
        view.points.points_mm,
        np.where(other.reasons == 0, other.column_px, np.float32(np.nan)),
        other.sigma_px,
        other.camera,
        other_from_camera,
        view.projector,
        view.projector_from_camera,
    )
    sigma = view.points.sigma_mm / _distance_mm(view.points)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_px = sigma / view.sigma_px
        both = np.sqrt(sigma**2 + opinion.sigma**2)
        apart = np.abs(opinion.shift)
        agrees = apart <= np.float32(_SIGMAS) * both + np.float32(params.agreement_px) * per_px
        contradicts = ~agrees & (apart <= np.float32(_OTHER_SURFACE_PX) * per_px)
    _merge(view.points, opinion, sigma, agrees)
    view.reject(
        contradicts, Reason.LEFT_RIGHT_CHECK, f"{view.name} and {other.name} contradict each other"
    )


def _merge(
    points: OrganisedCloud,
    opinion: SecondOpinion,
    sigma: Float32[np.ndarray, "h w"],
    agrees: Bool[np.ndarray, "h w"],
) -> None:
    own, others = sigma[agrees] ** -2, opinion.sigma[agrees] ** -2
    share = others / (own + others)
    points.depth_mm[agrees] *= np.float32(1) + share * opinion.shift[agrees]
    points.sigma_mm[agrees] *= np.sqrt(own / (own + others))


def _distance_mm(points: OrganisedCloud) -> Float32[np.ndarray, "h w"]:
    x, y = points.rays.map()
    return np.asarray(points.depth_mm * np.sqrt(x * x + y * y + np.float32(1)))


def _fill(view: _View, other: _View, camera_from_other: RigidTransform) -> None:
    """Take the other camera's points for pixels that have none, but where the two contradict each other."""
    disputed = (view.reasons & np.uint16(Reason.LEFT_RIGHT_CHECK)) != 0
    wanted = np.asarray(~np.isfinite(view.points.depth_mm) & ~disputed)
    found = np.isfinite(other.points.depth_mm)
    organised_mm = other.points.points_mm
    R, t_mm = camera_from_other
    there_mm = organised_mm[found].astype(np.float64) @ R.T + t_mm
    facing = normals(organised_mm, other.camera)[found].astype(np.float64) @ R.T
    splat = on_pixels(there_mm, facing, view.camera, wanted)
    view.points.depth_mm.reshape(-1)[splat.pixel] = splat.points_mm[:, 2]
    view.points.sigma_mm.reshape(-1)[splat.pixel] = other.points.sigma_mm[found][splat.source]
    view.reasons.reshape(-1)[splat.pixel] = 0
    view.rows.append(FilterRow(f"filled in from {other.name}", -int(splat.pixel.size)))


def _filter(view: _View, params: DenseParams) -> None:
    """Remove lonely points and specks."""
    angle = filters.pixel_angle(view.camera.K)
    if params.outlier_sigmas > 0:
        kept = filters.without_outliers(
            view.points.depth_mm,
            sigma_mm=view.points.sigma_mm,
            pixel_angle_rad=angle,
            factor=params.outlier_sigmas,
        )
        view.keep(kept, Reason.OUTLIER, "outliers")
    least = speck_px(view.camera, params)
    if least > 1:
        kept = filters.without_specks(
            view.points.depth_mm, least_pixels=least, pixel_angle_rad=angle
        )
        view.keep(kept, Reason.OUTLIER, "specks")


def speck_px(camera: Pinhole, params: DenseParams) -> int:
    """Return the smallest patch that is kept."""
    if params.speck_px is not None:
        return params.speck_px
    return int(camera.width_px * camera.height_px / PIXELS_PER_SPECK)


def _cloud(codes: Codes, view: _View, names: tuple[str, ...]) -> Cloud:
    unknown: UInt8[np.ndarray, "h w"] = np.full(view.reasons.shape, _EXPOSURE_UNKNOWN, np.uint8)
    points = gather(
        view.points,
        unknown,
        codes.brightness[view.name],
        normal_limit=normal_limit(view.camera),
    )
    count = len(points.points_mm)
    decoded = int(np.count_nonzero(codes.reasons[view.name] == 0))
    return Cloud(
        points_mm=points.points_mm,
        normals=points.normals,
        colour=colour_of(points.brightness, count),
        sigma_mm=points.sigma_mm,
        pixel_x=points.pixel_x,
        pixel_y=points.pixel_y,
        exposure_index=points.exposure_index,
        depth_mm={view.name: view.points.depth_mm},
        reasons={view.name: view.reasons},
        removed=tuple(view.rows),
        point_count=count,
        median_sigma_mm=float(np.median(points.sigma_mm)) if count else float("nan"),
        kept_share=count / max(decoded, 1),
        cameras=names,
        consistency_px=view.epipolar_px,
        epipolar_sigma_px=view.spread_px,
    )
