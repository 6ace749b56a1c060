"""Bring a calibration into a rig file: of OpenCV's stereo calibrations, of a capture, or of another rig.

A camera and a projector that were calibrated together are a stereo calibration, too. The programs that do so write
`cam_K`, `proj_K`, `R`, `T` (scan3d-capture), `Kc`, `Kp`, `Rp`, `Tp` (SLStudio) or `cam_int`, `proj_int`, `roration`,
`translation` (procam-calibration); in all of them x_projector = R x_camera + T.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float
from pydantic import ValidationError

from backend.contract.capture import Capture
from backend.devices.calibration_entries import (
    CalibrationEntry,
    PoseEntry,
    ScreenEntry,
    ViewEntry,
    entry_of,
    pose_of,
    view_of,
)
from backend.devices.plain_yaml import read_yaml
from backend.domain.errors import InvalidCalibrationError
from backend.domain.rig import PinholeModel, Pose
from backend.numerics.pinhole import RigidTransform, compose, inverse
from backend.services.capture_calibration import capture_calibration

_SIDES = (("1", "_1", "L", "_left", "Left", "l"), ("2", "_2", "R", "_right", "Right", "r"))
_K = ("K", "M", "cameraMatrix", "camera_matrix", "cam_mat", "mtx", "intrinsic")
_D = ("D", "dist", "distCoeffs", "dist_coeffs", "distortion", "distortion_coefficients")
_R, _T = ("R", "rotation", "Rot", "rot_mat"), ("T", "t", "translation", "trans_vec", "Trns")
_SIZE = ("imageSize", "image_size", "size", "img_size", "ImageSize")
_SHAPE = ("img_shape",)
"""Height first."""
_WIDTHS, _HEIGHTS = (
    ("image_width", "width", "frameWidth"),
    ("image_height", "height", "frameHeight"),
)
_CAMERA_K, _CAMERA_D = ("cam_K", "Kc", "cam_int", *_K), ("cam_kc", "kc", "cam_dist", *_D)
_PROJECTOR_K, _PROJECTOR_D = ("proj_K", "Kp", "proj_int"), ("proj_kc", "kp", "proj_dist")
_PROJECTOR_R, _PROJECTOR_T = (*_R, "Rp", "roration"), (*_T, "Tp")
_PROJECTOR_WIDTHS, _PROJECTOR_HEIGHTS = ("screenResX",), ("screenResY",)
AnyPlaced = TypeVar("AnyPlaced", ViewEntry, ScreenEntry, PoseEntry)
_NEAREST_MM = 5.0
"""Cameras don't stand nearer to each other: a smaller base line is in another unit."""


@dataclass(frozen=True)
class StereoHints:
    """What a file of OpenCV's doesn't say itself."""

    cameras: Sequence[str]
    """Names of the first and the second camera; or of the one that was calibrated with the projector."""
    unit_mm: float = 1.0
    """Length of T's unit: 1000 for metres, or the size of the board's squares where that was the unit."""
    size: tuple[int, int] | None = None
    """Width and height of the pictures in [px], where no file says it."""
    projector_size: tuple[int, int] | None = None
    """The same of the projector."""


def read_calibration(
    files: Sequence[Path], hints: StereoHints, known: CalibrationEntry | None = None
) -> CalibrationEntry:
    """Read a calibration from files.

    Parameters
    ----------
    files
        What cv2.FileStorage wrote, in one file or several; a `capture.json`; files of ours, whole or in parts (a
        `screen`, a `mirror`).
    hints
        What OpenCV's files don't say.
    known
        What files that hold no camera are added to.

    Raises
    ------
    InvalidCalibrationError
        If something is missing or impossible; the sentence says what it was looked for as.
    RigConfigError
        If a file can't be read.
    """
    of_opencv = [file for file in files if _is_of_opencv(file)]
    parts = [_read_ours(file) for file in files if file not in of_opencv]
    if of_opencv:
        parts.insert(0, _of_opencv(_Matrices.of(of_opencv), hints, known))
    if known is not None and not any("cameras" in part for part in parts):
        parts.insert(0, _document(known))
    return _joined(parts, files)


def _joined(parts: Sequence[Mapping[str, Any]], files: Sequence[Path]) -> CalibrationEntry:
    names = ", ".join(map(str, files))
    document = {name: value for part in parts for name, value in part.items()}
    if "cameras" not in document:
        raise InvalidCalibrationError(
            f"There is no camera in {names}, and the rig isn't calibrated yet: name its cameras' file, too."
        )
    try:
        return CalibrationEntry.model_validate(document)
    except ValidationError as error:
        raise InvalidCalibrationError(f"{names}: {_first_problem(error)}; mend it.") from None


def _first_problem(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    place = ".".join(map(str, first["loc"]))
    problem = first["msg"].removeprefix("Value error, ")
    return f"{place}: {problem[0].lower()}{problem[1:]}" if place else problem


def _document(entry: CalibrationEntry) -> dict[str, Any]:
    return entry.model_dump(mode="json", exclude_none=True)


def _is_of_opencv(file: Path) -> bool:
    try:
        head = file.read_text("utf-8", errors="replace")[:4000]
    except OSError as error:
        raise InvalidCalibrationError(
            f"The calibration {file} can't be read ({error.strerror}); check name and rights."
        ) from error
    return head.startswith("%YAML") or "opencv-matrix" in head or "<opencv_storage" in head


def _read_ours(file: Path) -> dict[str, Any]:
    document = read_yaml("calibration", file)  # JSON is YAML, too
    if isinstance(document, dict) and document.get("format") == "unglare-capture":
        return _document(_of_capture(file, document))
    if not isinstance(document, dict) or not set(document) & set(CalibrationEntry.model_fields):
        known = ", ".join(CalibrationEntry.model_fields)
        raise InvalidCalibrationError(
            f"{file} is neither a calibration of OpenCV (cv2.FileStorage) nor a capture.json nor one of ours, which has"
            f" {known}; choose another file."
        )
    return {name: value for name, value in document.items() if value is not None}


def _of_capture(file: Path, document: Mapping[str, Any]) -> CalibrationEntry:
    try:
        capture = Capture.model_validate_json(json.dumps(dict(document), default=str))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the document"
        raise InvalidCalibrationError(
            f"{file}: {place}: {first['msg'].lower()}; mend it."
        ) from None
    found = capture_calibration(capture)
    if found is None:
        raise InvalidCalibrationError(
            f"{file} ties no two devices together: it needs K of two devices and the extrinsics between them."
        )
    return entry_of(found)


def in_frame_of(entry: CalibrationEntry, camera: str) -> CalibrationEntry:
    """Return the same calibration with a camera's frame as world; as it is if it has no such camera."""
    if camera not in entry.cameras:
        return entry
    world = inverse(_transform(entry.cameras[camera]))

    def moved(part: AnyPlaced) -> AnyPlaced:
        pose = compose(_transform(part), world)
        return part.model_copy(update=pose_of(Pose(pose.R, pose.t_mm)))

    views = {name: moved(view) for name, view in entry.cameras.items()}
    here = views[camera]  # exactly, whatever was rounded
    views[camera] = ViewEntry(
        **here.model_dump(include={"width_px", "height_px", "K", "distortion"})
    )
    return CalibrationEntry(
        cameras=views,
        projector=moved(entry.projector) if entry.projector else None,
        screen=moved(entry.screen) if entry.screen else None,
        mirror=moved(entry.mirror) if entry.mirror else None,
    )


def _transform(part: ViewEntry | PoseEntry) -> RigidTransform:
    return RigidTransform(part.device_from_world.R, part.device_from_world.t_mm)


# OpenCV's files


@dataclass(frozen=True)
class _Matrices:
    """What the files hold, by name."""

    files: str
    values: Mapping[str, Float[np.ndarray, "..."]]

    @classmethod
    def of(cls, files: Iterable[Path]) -> "_Matrices":
        files = tuple(files)
        values = {name: value for file in files for name, value in _stored(file)}
        return cls(", ".join(map(str, files)), values)

    def find(self, names: Iterable[str]) -> Float[np.ndarray, "..."] | None:
        """Return the first that is there."""
        return next((self.values[name] for name in names if name in self.values), None)

    def need(self, what: str, names: Sequence[str]) -> Float[np.ndarray, "..."]:
        """Return the first that is there; InvalidCalibrationError if none is."""
        found = self.find(names)
        if found is None:
            there = ", ".join(self.values) or "nothing"
            raise InvalidCalibrationError(
                f"{what} is missing in {self.files}: looked for {', '.join(names[:4])} and the like, there is {there};"
                " name the file that holds it, too, or rename the entry."
            )
        return found


def _stored(file: Path) -> list[tuple[str, Float[np.ndarray, "..."]]]:
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        root = storage.root()
        names = list(root.keys())
    except cv2.error as error:
        reason = " ".join(str(error).split())[:120]
        raise InvalidCalibrationError(
            f"{file} can't be read as a file of OpenCV's ({reason}); write it again with cv2.FileStorage."
        ) from error
    found = []
    for name in names:
        node = root.getNode(name)
        if node.isMap() and (matrix := node.mat()) is not None:
            found.append((name, np.asarray(matrix, np.float64)))
        elif node.isSeq():
            numbers = [node.at(i) for i in range(node.size())]
            if all(number.isReal() or number.isInt() for number in numbers):
                found.append((name, np.array([number.real() for number in numbers])))
        elif node.isInt() or node.isReal():
            found.append((name, np.array(node.real())))
    storage.release()
    return found


def _of_opencv(
    found: _Matrices, hints: StereoHints, known: CalibrationEntry | None
) -> dict[str, Any]:
    if found.find(_PROJECTOR_K) is not None:
        return _with_projector(found, hints, known)
    if len(hints.cameras) == 1 and found.find(_R) is None:
        (name,) = hints.cameras
        return _cameras(
            {name: _view_of(found, _lone(name, hints, found), Pose(np.eye(3), np.zeros(3)))}
        )
    if len(hints.cameras) != 2:
        raise InvalidCalibrationError(
            f"A stereo calibration is for two cameras, here {', '.join(hints.cameras)} would be; name two, or write the"
            " calibration entry by hand."
        )
    first, second = hints.cameras
    poses = {first: Pose(np.eye(3), np.zeros(3)), second: _pose(found, "cameras", _R, _T, hints)}
    views = {
        name: _view_of(found, _Device.camera(name, side, hints, found), poses[name])
        for name, side in zip(hints.cameras, _SIDES, strict=True)
    }
    return _cameras(views)


def _cameras(views: Mapping[str, ViewEntry]) -> dict[str, Any]:
    return {"cameras": {name: view.model_dump(mode="json") for name, view in views.items()}}


def _with_projector(
    found: _Matrices, hints: StereoHints, known: CalibrationEntry | None
) -> dict[str, Any]:
    """Place the projector by the camera that it was calibrated with; that one stays as it is if it is known."""
    name = hints.cameras[0]
    by_camera = _pose(found, "camera and projector", _PROJECTOR_R, _PROJECTOR_T, hints)
    projector = _Device.projector(hints, found)
    if known is None or name not in known.cameras or set(known.cameras) == {name}:
        camera = _view_of(found, _lone(name, hints, found), Pose(np.eye(3), np.zeros(3)))
        return {
            **_cameras({name: camera}),
            "projector": _view_of(found, projector, by_camera).model_dump(mode="json"),
        }
    at = compose(RigidTransform(by_camera.R, by_camera.t_mm), _transform(known.cameras[name]))
    view = _view_of(found, projector, Pose(at.R, at.t_mm))
    return {"projector": view.model_dump(mode="json")}


def _pose(
    found: _Matrices, between: str, Rs: Sequence[str], Ts: Sequence[str], hints: StereoHints
) -> Pose:
    R = found.need(f"The rotation between the {between}", Rs)
    t_mm = found.need(f"The translation between the {between}", Ts).ravel() * hints.unit_mm
    if R.size == 3:
        R = np.asarray(cv2.Rodrigues(R)[0], np.float64)
    _refuse_wrong_unit(t_mm, hints.unit_mm, between)
    return Pose(_rotation(R), t_mm)


@dataclass(frozen=True)
class _Device:
    """One of the two that were calibrated together: its names in the files, and its size."""

    name: str
    K: Sequence[str]
    distortion: Sequence[str]
    size: tuple[int, int]
    centred: bool = True
    """Whether its principal point lies in its picture; that of a projector may be shifted out of it."""

    @classmethod
    def camera(
        cls, name: str, side: Sequence[str], hints: StereoHints, found: _Matrices
    ) -> "_Device":
        K, distortion = ([f"{k}{s}" for s in side for k in known] for known in (_K, _D))
        return cls(name, K, distortion, hints.size or _size(found))

    @classmethod
    def projector(cls, hints: StereoHints, found: _Matrices) -> "_Device":
        said = _pair(found, _PROJECTOR_WIDTHS, _PROJECTOR_HEIGHTS) or hints.projector_size
        if said is None:
            raise InvalidCalibrationError(
                f"The projector's size is missing in {found.files} and in the rig file: say it with --projector-size, e.g."
                " --projector-size 1280x800."
            )
        return cls("projector", _PROJECTOR_K, _PROJECTOR_D, said, centred=False)


def _lone(name: str, hints: StereoHints, found: _Matrices) -> _Device:
    """Return the camera of files that hold no other."""
    return _Device(name, _CAMERA_K, _CAMERA_D, hints.size or _size(found))


def _view_of(found: _Matrices, device: _Device, pose: Pose) -> ViewEntry:
    K = found.need(f"The camera matrix of {device.name}", device.K)
    distortion, (width_px, height_px) = found.find(device.distortion), device.size
    if K.shape != (3, 3) or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InvalidCalibrationError(
            f"The camera matrix of {device.name} in {found.files} is {K.tolist()}: it has to have positive focal lengths; calibrate again."
        )
    if device.centred and not (0 < K[0, 2] < width_px and 0 < K[1, 2] < height_px):
        raise InvalidCalibrationError(
            f"The principal point of {device.name} is {K[0, 2]:.0f}, {K[1, 2]:.0f} and so outside of {width_px}x{height_px} px: check --size."
        )
    bent = np.zeros(5) if distortion is None else distortion.ravel()
    return view_of(PinholeModel(width_px, height_px, K, bent), pose)


def _size(found: _Matrices) -> tuple[int, int]:
    pair, shape = found.find(_SIZE), found.find(_SHAPE)
    if pair is None and shape is not None:
        pair = shape[::-1]
    if pair is not None and pair.size == 2:
        return int(pair.ravel()[0]), int(pair.ravel()[1])
    said = _pair(found, _WIDTHS, _HEIGHTS)
    if said is None:
        raise InvalidCalibrationError(
            f"The size of the pictures is missing in {found.files}: say it with --size, e.g. --size 1280x1024."
        )
    return said


def _pair(
    found: _Matrices, widths: Sequence[str], heights: Sequence[str]
) -> tuple[int, int] | None:
    width, height = found.find(widths), found.find(heights)
    if width is None or height is None or min(int(width), int(height)) < 1:
        return None  # SLStudio writes 0 where it doesn't know
    return int(width), int(height)


def _rotation(R: Float[np.ndarray, "..."]) -> Float[np.ndarray, "3 3"]:
    if R.shape != (3, 3) or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InvalidCalibrationError(
            f"R is {R.tolist()}, which is no rotation: calibrate again, and write what cv2.stereoCalibrate returns."
        )
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)


def _refuse_wrong_unit(t_mm: Float[np.ndarray, "n"], unit_mm: float, who: str) -> None:
    if t_mm.shape != (3,):
        raise InvalidCalibrationError(
            f"T has {t_mm.size} numbers instead of 3: write what cv2.stereoCalibrate returns."
        )
    distance_mm = float(np.linalg.norm(t_mm))
    if not distance_mm > _NEAREST_MM:
        raise InvalidCalibrationError(
            f"The {who} would stand {distance_mm:.3g} mm apart with T's unit of {unit_mm:g} mm: say the right one, "
            "e.g. --unit-mm 1000 for metres, or the size of the board's squares in mm."
        )
