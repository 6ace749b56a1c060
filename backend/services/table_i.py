"""The paper's Table I for a rig: what a wrong height costs in projector pixels, and the dilation that covers it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from backend.domain.errors import InvalidCalibrationError
from backend.domain.rig import RigCalibration
from backend.numerics.errors import NumericsError
from backend.numerics.height_deviation import Deviation, facing_plane, height_deviation
from backend.services.context import Context
from backend.services.line_chart import Line, line_chart
from backend.services.report_document import Column, Figure, Report, ReportTable
from backend.stages.rig_geometry import from_reference, pinhole, require_camera

HEIGHTS_MM = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
"""Errors of the assumed height, to either side."""
_PAPERS_PX = 5.0
"""The dilation of the paper, whose table ends at 20 mm for it."""

_INTRODUCTION = (
    "A camera pixel's place in the projector is guessed as if the scene were a flat table. Where the true surface is "
    "higher or lower, the light comes from elsewhere: the table says from how far, in projector pixels, as it "
    "follows from the calibration of the rig (the paper's Table I and figure 12).",
    "The assumed plane stands across the camera's axis where the projector's axis comes nearest. Median and largest "
    "deviation are those of 24 x 24 pixels of the picture that the projector lights there. An intensity mask whose dark "
    "regions are widened by so many pixels covers the error; what is left over is the refinement's to find.",
)


def table_i(context: Context, rig: str, rig_options: Mapping[str, Any]) -> Report:
    """Tell what errors in height cost on a calibrated rig.

    Raises
    ------
    InvalidCalibrationError
        If the rig has no calibration of camera and projector, or one that can't be used.
    """
    calibration = context.rigs.given(rig, rig_options).calibration
    if calibration is None:
        raise InvalidCalibrationError(
            f"The rig {rig!r} has no calibration: calibrate it, the deviation follows from where its devices are."
        )
    found = {name: _deviation(calibration, name) for name in calibration.cameras}
    return Report(
        name="table-i",
        title="Error of the assumed height and deviation in the projector",
        introduction=_INTRODUCTION,
        tables=(_table(found),),
        figures=(Figure("table_i", "Median deviation over the error in height", _chart(found)),),
        findings=tuple(_finding(name, deviation) for name, deviation in found.items()),
    )


def _deviation(calibration: RigCalibration, name: str) -> Deviation:
    if calibration.projector is None or calibration.projector_from_world is None:
        raise InvalidCalibrationError(
            "The projector isn't calibrated: the deviation in its pixels follows from its place."
        )
    camera, projector = require_camera(calibration, name), pinhole(calibration.projector)
    own = from_reference(calibration, calibration.camera_from_world[name])
    other = from_reference(calibration, calibration.projector_from_world)
    R = other.R @ own.R.T
    pose = type(own)(R, other.t_mm - R @ own.t_mm)
    heights = np.array([*(-h for h in reversed(HEIGHTS_MM)), 0.0, *HEIGHTS_MM])
    try:
        plane = facing_plane(camera, projector, pose)
        return height_deviation(heights, camera, projector, pose, plane)
    except NumericsError as error:
        raise InvalidCalibrationError(f"Camera {name!r}: {error}.") from error


def _table(found: Mapping[str, Deviation]) -> ReportTable:
    rows: list[dict[str, Any]] = []
    for name, deviation in found.items():
        rows += [
            {"camera": name, "height_mm": h, "median_px": _rounded(m), "largest_px": _rounded(w)}
            for h, m, w in zip(*(values.tolist() for values in deviation), strict=True)
            if h != 0.0
        ]
    columns = (
        Column("camera", "camera"),
        Column("height_mm", "error in height, mm", "+g"),
        Column("median_px", "deviation, median, px", ".2f"),
        Column("largest_px", "deviation, largest, px", ".2f"),
    )
    return ReportTable("table_i", "Deviation in projector pixels", columns, tuple(rows))


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def _finding(name: str, deviation: Deviation) -> str:
    height_mm = covered_mm(deviation, _PAPERS_PX)
    if height_mm is None:
        return f"Camera {name}: a dilation of {_PAPERS_PX:g} px covers every height of the table."
    return f"Camera {name}: a dilation of {_PAPERS_PX:g} px covers heights up to {height_mm:.1f} mm off the plane."


def covered_mm(deviation: Deviation, dilation_px: float) -> float | None:
    """Return the error in height up to which the median deviation stays below a dilation; None if all do."""
    up = deviation.height_mm >= 0
    heights, deviations = deviation.height_mm[up], deviation.median_px[up]
    if not (deviations > dilation_px).any():
        return None
    return float(np.interp(dilation_px, deviations, heights))


def _chart(found: Mapping[str, Deviation]) -> Any:
    lines = [Line(f"camera {name}", d.height_mm, d.median_px) for name, d in found.items()]
    return line_chart(
        "Deviation for an error of the assumed height",
        lines,
        x_title="error in height, mm",
        y_title="projector px",
    )
