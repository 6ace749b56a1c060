"""A SOFAST measurement as a capture: frames, patterns, poses and settings in our words."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float64, Shaped

from backend.contract.capture import Capture, CapturedCamera, CapturedFrame
from backend.domain.errors import InvalidCalibrationError
from backend.domain.patterns import Axis, Pattern, Sine, Uniform
from backend.domain.rig import PinholeModel, Pose, RigCalibration, ScreenModel
from backend.numerics.camera_model import Pinhole, check_pinhole
from backend.numerics.errors import CalibrationError, ScreenError
from backend.numerics.screen_surface import screen_surface
from backend.services.capture_folder import CaptureFolder
from backend.services.sofast import STEPS, SofastFile, looks_like_sofast, read_sofast
from backend.stages.ramp import ramp_from_table

CAMERA = "camera"
_MM = 1e3
_TURN_X = np.diag([1.0, -1.0, -1.0])
"""Our screens have y down and z away from the viewer, SOFAST's y up and z towards him."""

__all__ = ["SofastFolder", "looks_like_sofast", "open_sofast"]


@dataclass(frozen=True)
class SofastFolder(CaptureFolder):
    """A measurement that has been read whole."""

    arrays: Mapping[str, Shaped[np.ndarray, "_h _w"]] = field(default_factory=dict)
    """Pictures by the name that the capture gives them."""

    def pictures(self) -> Iterator[tuple[CapturedFrame, Shaped[np.ndarray, "h w"]]]:
        """Return the pictures in order: they were checked when read."""
        for frame in self.capture.frames:
            yield frame, self.arrays[frame.file]


def open_sofast(path: Path) -> SofastFolder:
    """Read a measurement and say it in our words.

    Raises
    ------
    InvalidCaptureError, InvalidCalibrationError
        In one sentence.

    Notes
    -----
    Frame k of a set is A + B cos(2 pi p u - k pi/2); u is the fraction along x, counted from the last display
    column, and 1 - fraction along y. Those u are our positions in the pattern: SOFAST's pattern is ours seen from behind.
    """
    file = read_sofast(path)
    frames, arrays = _frames(file)
    height, width = file.fringes.shape[1:]
    matrix = None if file.camera_matrix is None else _matrix(file.camera_matrix)
    capture = Capture(
        format="unglare-capture",
        version=1,
        name=file.name,
        method="fringe-reflection",
        cameras={
            CAMERA: CapturedCamera(
                width_px=width,
                height_px=height,
                bit_depth=8 if file.fringes.dtype == np.uint8 else 16,
                K=None if matrix is None else tuple(tuple(row) for row in matrix.tolist()),
                distortion=tuple(file.distortion.tolist()),
            )
        },
        frames=frames,
    )
    given: dict[str, Any] = {}
    if file.ramp_camera is not None and file.ramp_display is not None:
        given["ramp"] = ramp_from_table(file.ramp_display, file.ramp_camera)
    return SofastFolder(
        folder=path,
        capture=capture,
        scan=None,
        calibration=_calibration(file, matrix),
        given=given,
        settings=_settings(file),
        setting_arrays={}
        if file.mask is None
        else {("screen_phase", "mask"): file.mask.astype(np.float32)},
        arrays=arrays,
    )


def _frames(
    file: SofastFile,
) -> tuple[tuple[CapturedFrame, ...], dict[str, Shaped[np.ndarray, "h w"]]]:
    shown: list[tuple[str, Pattern, str, Shaped[np.ndarray, "h w"]]] = []
    axes: tuple[Axis, Axis] = ("y", "x")
    number = 0
    for axis in axes:
        for periods in file.periods_y if axis == "y" else file.periods_x:
            for step in range(STEPS):
                pattern = Sine(axis=axis, periods=periods, shift_rad=-step * np.pi / 2)
                shown.append((f"fringe_images[{number}]", pattern, "fringe", file.fringes[number]))
                number += 1
    shown.append(("mask_images[0]", Uniform(gray=0), "dark", file.fields[0]))
    shown.append(("mask_images[1]", Uniform(gray=255), "light", file.fields[1]))
    frames = tuple(
        CapturedFrame(file=name, camera=CAMERA, pattern=pattern, role=role, stage="reflect_capture")
        for name, pattern, role, _ in shown
    )
    return frames, {name: picture for name, _, _, picture in shown}


def _matrix(matrix: Float[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Binned pictures were described by scaling the whole matrix: its last number is 1 by definition."""
    scaled = matrix.astype(np.float64).copy()
    scaled[2, 2] = 1.0
    return scaled


def _calibration(
    file: SofastFile, matrix: Float64[np.ndarray, "3 3"] | None
) -> RigCalibration | None:
    """Return camera, screen and mirror; None if the file doesn't say where the screen is."""
    if (
        matrix is None
        or file.camera_to_screen is None
        or file.screen_m is None
        or file.screen_fraction is None
    ):
        return None
    height, width = file.fringes.shape[1:]
    shares = np.stack([file.screen_fraction[:, 0], 1.0 - file.screen_fraction[:, 1]], axis=1)
    points_mm = _MM * file.screen_m @ _TURN_X
    try:
        screen_surface(shares, points_mm)
        check_pinhole(Pinhole(matrix, file.distortion, width, height), "the camera")
    except (ScreenError, CalibrationError) as error:
        raise InvalidCalibrationError(f"{file.path}: {error}.") from None
    screen = _pose(*file.camera_to_screen)
    return RigCalibration(
        cameras={CAMERA: PinholeModel(width, height, matrix, file.distortion)},
        camera_from_world={CAMERA: Pose(np.eye(3), np.zeros(3))},
        reference=CAMERA,
        screen=ScreenModel(shares, points_mm),
        screen_from_world=Pose(_TURN_X @ screen.R, _TURN_X @ screen.t_mm),
        mirror_from_world=None if file.camera_to_mirror is None else _pose(*file.camera_to_mirror),
    )


def _pose(turn: Float[np.ndarray, "3"], origin_m: Float[np.ndarray, "3"]) -> Pose:
    R = np.asarray(cv2.Rodrigues(turn.astype(np.float64))[0])
    return Pose(R, -R @ (_MM * origin_m))


def _settings(file: SofastFile) -> dict[str, dict[str, Any]]:
    """Return what of the measurement is a setting here."""
    # The mirror is turned to its design and moved to the measured distance: the file's pose is a start.
    slopes: dict[str, Any] = {"align": True}
    if file.distance_m:
        slopes["screen_distance_mm"] = _MM * file.distance_m
        slopes["measured_mm"] = tuple((_MM * file.measured_m).tolist())
    if file.corners_m is not None:
        slopes["outline_mm"] = [tuple(c) for c in (_MM * file.corners_m[:, :2]).tolist()]
    return {"slopes": slopes}
