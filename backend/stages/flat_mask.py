"""The first mask: as if the scene were a flat table, so that hardly anything saturates while the truth is found."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from backend.domain.arrays import LoadArray
from backend.domain.errors import StageFailedError
from backend.domain.params import setting
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.errors import CalibrationError
from backend.numerics.flat_guess import height_shifts, plane_positions
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_map import CodeMap, require_projector
from backend.stages.intensity_mask import IntensityMask
from backend.stages.mask_making import (
    MaskParams,
    View,
    gather,
    not_too_dark,
    pixel_need,
    served_cameras,
    touched_up,
)
from backend.stages.pixel_response import PixelResponse
from backend.stages.rig_geometry import camera_geometry
from backend.stages.table_homography import TableHomography

_UNCALIBRATED_PX = 5.0
"""The paper's dilation, where nothing tells how far heights move a pixel."""
_TABLE_PX = 2.0
"""What lens distortion and the table's own unevenness may add."""


class FlatMaskParams(MaskParams):
    """How the first mask is made."""

    height_mm: float = setting(50.0, title="Parts up to", unit="mm", ge=0, le=10_000)
    """Highest part above the table: the higher, the farther a bright place may be from where the table says,
    and the more of the picture is dimmed to be sure."""
    dilation_px: float | None = setting(
        None, title="Dark regions widened by", unit="px", ge=0, le=200, auto="dilation_px"
    )
    """Automatic: along the epipolar lines as far as the height moves a pixel, from the rig's calibration; 5 px
    all around without one."""


@stage(title="First mask", version=1, review=Review.ON_WARNING, checks=(not_too_dark,))
def flat_mask(
    base: BaseExposure,
    response: PixelResponse,
    homography: TableHomography | None,
    facts: RigFacts,
    calibration: RigCalibration | None,
    params: FlatMaskParams,
    load: LoadArray,
) -> IntensityMask:
    """Dim what would saturate, guessing that the scene is as flat as its table; without a table, nothing yet."""
    projector = require_projector(facts)
    cameras = served_cameras(facts, params)
    needs = {
        name: pixel_need(name, response, base, facts.cameras[name], projector, params)
        for name in cameras
    }
    guesses = (
        []
        if homography is None
        else [_guess(n, homography, facts, calibration, params) for n in cameras]
    )
    factor = gather(
        [View(needs[g.camera], m) for g in guesses for m in g.maps()],
        projector,
        dilation_px=max((g.disc_px for g in guesses), default=0.0),
        smoothing_px=params.smoothing_px,
    )
    factor = touched_up(factor, params, load)
    return IntensityMask(
        factor=factor,
        proper={name: need.most for name, need in needs.items()},
        dilation_px=max((g.reach_px for g in guesses), default=0.0),
        mean_factor=float(factor.mean()),
    )


@dataclass(frozen=True)
class _Guess:
    """Where a camera's pixels may look."""

    camera: str
    table: CodeMap
    shifts_px: Float64[np.ndarray, "n 2"]
    """By which the surface's height may move them."""
    disc_px: float

    @property
    def reach_px(self) -> float:
        """The farthest that a pixel's dimming reaches."""
        return float(np.hypot(*self.shifts_px.T).max()) + self.disc_px

    def maps(self) -> Iterator[CodeMap]:
        """Move the table along the epipolar lines, from the table itself to the highest part."""
        for du, dv in self.shifts_px.astype(np.float32):
            yield CodeMap(self.table.projector_px + du, self.table.projector_row_px + dv)


def _guess(
    name: str,
    homography: TableHomography,
    facts: RigFacts,
    calibration: RigCalibration | None,
    params: FlatMaskParams,
) -> _Guess:
    matrix = homography.projector_from_camera.get(name)
    if matrix is None:
        known = ", ".join(homography.projector_from_camera)
        raise StageFailedError(
            f"The table was measured with {known}, not with camera {name!r}: measure it with this rig, "
            "or serve the reference camera only."
        )
    camera = facts.cameras[name]
    table = CodeMap(*plane_positions(matrix, width_px=camera.width_px, height_px=camera.height_px))
    still = np.zeros((1, 2))
    if params.dilation_px is not None:
        return _Guess(name, table, still, params.dilation_px)
    shifts = _shifts(name, matrix, calibration, params.height_mm)
    if shifts is None:
        return _Guess(name, table, still, _UNCALIBRATED_PX)
    return _Guess(name, table, shifts, _TABLE_PX)


def _shifts(
    name: str,
    matrix: Float64[np.ndarray, "3 3"],
    calibration: RigCalibration | None,
    height_mm: float,
) -> Float64[np.ndarray, "n 2"] | None:
    """Return how heights move a pixel's place; None where the projector isn't calibrated."""
    geometry = camera_geometry(calibration, (name,)).get(name)
    if geometry is None:
        return None
    try:
        return height_shifts(height_mm, matrix, *geometry)
    except CalibrationError as error:
        raise StageFailedError(
            f"The table's homography doesn't fit the calibration of camera {name!r} ({error}): measure the table anew."
        ) from error
