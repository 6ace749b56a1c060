"""The empty table, Gray-coded: which projector pixel a camera pixel sees if nothing stands there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Float64

from backend.domain.checks import Check, at_least, at_most
from backend.domain.errors import StageFailedError
from backend.domain.hints import Picture, Table, Value
from backend.domain.params import Params, setting
from backend.domain.rig import RigFacts
from backend.domain.shots import Shoot
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.errors import CalibrationError
from backend.numerics.homography import PlaneFit, fit_homography, map_points
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_map import CodeMap, CodeShots, code_map_plan, shorter_ms

_FITTED = 40_000
"""Pixels that the fit looks at: more don't make it better."""
_LEAST_KNOWN = 1e-3


class TableHomographyParams(Params):
    """How the table is found."""

    tolerance_px: float = setting(3.0, title="Tolerance", unit="px", gt=0, le=100)
    """A pixel this near to its place on the plane belongs to the table, in projector pixels."""
    darker: int = setting(8, title="Second exposure", unit="x", ge=1, le=64, advanced=True)
    """The code is captured again so many times shorter, for the table's bright places; 1: it isn't."""


@dataclass(frozen=True)
class TableRow:
    """One camera's view of the table."""

    camera: str
    rms_px: float
    """Of the pixels on the table, in projector pixels: noise, and lens distortion, which the model leaves out."""
    table_share: float
    """Share of the decoded pixels that lie on the plane."""
    known_share: float
    """Share of the picture that was decoded."""


@dataclass(frozen=True)
class TableHomography:
    """Where camera pixels look in the projector if the scene is the empty table."""

    projector_from_camera: Mapping[str, Float64[np.ndarray, "3 3"]]
    """Per camera, maps homogeneous camera pixels to projector pixels, centres at integers."""
    rms_px: Annotated[float, Value("Residual, worst camera", unit="px")]
    table: Annotated[tuple[TableRow, ...], Table("Cameras")] = ()
    off_plane_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Distance from the plane", unit="px", colormap="turbo"),
    ] = field(default_factory=dict)
    """In projector pixels; NaN where nothing was decoded."""


def _flat(result: TableHomography, params: TableHomographyParams) -> Check:
    return at_most(
        "residual", result.rms_px, warning=0.7 * params.tolerance_px, failure=2 * params.tolerance_px,
        unit="px", sentence=f"the table fits its plane within {result.rms_px:.2f} px",
    )  # fmt: skip


def _in_view(result: TableHomography, params: TableHomographyParams) -> Check:
    least = min((row.table_share for row in result.table), default=0.0)
    return at_least(
        "table in view", least, warning=0.8, failure=0.3,
        sentence=f"{least:.0%} of what was decoded lies on one plane",
        remedy="clear the table, or let it fill more of the picture",
    )  # fmt: skip


@stage(title="Table", version=1, review=Review.ON_WARNING, checks=(_flat, _in_view))
def table_homography(
    base: BaseExposure, facts: RigFacts, params: TableHomographyParams, shoot: Shoot
) -> TableHomography:
    """Capture the empty table with Gray code and fit the plane that most of it lies on."""
    exposures = {base.exposure_ms, shorter_ms(base.exposure_ms, params.darker, facts)}
    how = CodeShots(tuple(sorted(exposures, reverse=True)), base.gain_db)
    maps = shoot(code_map_plan(facts, how))
    fits = {name: _fit(name, found, params) for name, found in maps.items()}
    return TableHomography(
        projector_from_camera={name: fit.matrix for name, fit in fits.items()},
        rms_px=max(fit.rms_px for fit in fits.values()),
        table=tuple(
            TableRow(name, fit.rms_px, fit.inlier_share, float(maps[name].known.mean()))
            for name, fit in fits.items()
        ),
        off_plane_px={name: _off_plane(maps[name], fit) for name, fit in fits.items()},
    )


def _fit(name: str, found: CodeMap, params: TableHomographyParams) -> PlaneFit:
    if found.known.mean() < _LEAST_KNOWN:
        raise StageFailedError(
            f"No table in view: camera {name!r} reads the code at {found.known.mean():.2%} of its pixels; "
            "put the bare table into the light of the projector and into the picture."
        )
    camera_px, projector_px = _correspondences(found)
    step = max(1, len(camera_px) // _FITTED)
    try:
        return fit_homography(
            camera_px[::step], projector_px[::step], tolerance_px=params.tolerance_px
        )
    except CalibrationError as error:
        raise StageFailedError(f"Camera {name!r}: {error}.") from error


def _correspondences(
    found: CodeMap,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    y, x = np.nonzero(found.known)
    projector_px = np.column_stack([found.projector_px[y, x], found.projector_row_px[y, x]])
    return np.column_stack([x, y]).astype(np.float64), projector_px.astype(np.float64)


def _off_plane(found: CodeMap, fit: PlaneFit) -> Float32[np.ndarray, "h w"]:
    camera_px, projector_px = _correspondences(found)
    off = map_points(fit.matrix, camera_px) - projector_px
    distance = np.full(found.projector_px.shape, np.nan, np.float32)
    distance[found.known] = np.hypot(off[:, 0], off[:, 1])
    return distance
