"""Bring a calibration into a rig file: of OpenCV's stereo calibration, of a capture, or of another rig."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from pydantic import ValidationError

from backend.contract.capture import Capture
from backend.devices.rig_file import CalibrationEntry, ViewEntry, read_yaml
from backend.domain.errors import InvalidCalibrationError
from backend.domain.rig import PinholeModel, Pose, RigCalibration
from backend.numerics.pinhole import RigidTransform, compose, inverse
from backend.services.capture_calibration import capture_calibration

_SIDES = (("1", "_1", "L", "_left", "Left", "l"), ("2", "_2", "R", "_right", "Right", "r"))
_K = ("K", "M", "cameraMatrix", "camera_matrix", "cam_mat", "mtx", "intrinsic")
_D = ("D", "dist", "distCoeffs", "dist_coeffs", "distortion", "distortion_coefficients")
_R, _T = ("R", "rotation", "Rot", "rot_mat"), ("T", "t", "translation", "trans_vec", "Trns")
_SIZE = ("imageSize", "image_size", "size", "img_size", "ImageSize")
_WIDTHS, _HEIGHTS = ("image_width", "width"), ("image_height", "height")
_NEAREST_MM = 5.0
"""Cameras don't stand nearer to each other: a smaller base line is in another unit."""


@dataclass(frozen=True)
class StereoHints:
    """What a file of OpenCV's doesn't say itself."""

    cameras: Sequence[str]
    """Names of the first and the second camera."""
    unit_mm: float = 1.0
    """Length of T's unit: 1000 for metres, or the size of the board's squares where that was the unit."""
    size: tuple[int, int] | None = None
    """Width and height of the pictures in [px], where no file says it."""


def read_calibration(files: Sequence[Path], hints: StereoHints) -> CalibrationEntry:
    """Read a calibration from files.

    Parameters
    ----------
    files
        What cv2.FileStorage wrote, in one file or several; or one `capture.json`, or one file of ours.
    hints
        What OpenCV's files don't say.

    Raises
    ------
    InvalidCalibrationError
        If something is missing or impossible; the sentence says what it was looked for as.
    RigConfigError
        If a file can't be read.
    """
    if len(files) == 1 and not _is_of_opencv(files[0]):
        return _read_ours(files[0])
    return _of_opencv(_Matrices.of(files), hints)


def _is_of_opencv(file: Path) -> bool:
    try:
        head = file.read_text("utf-8", errors="replace")[:4000]
    except OSError as error:
        raise InvalidCalibrationError(
            f"The calibration {file} can't be read ({error.strerror}); check name and rights."
        ) from error
    return head.startswith("%YAML") or "opencv-matrix" in head or "<opencv_storage" in head


def _read_ours(file: Path) -> CalibrationEntry:
    document = read_yaml("calibration", file)  # JSON is YAML, too
    if isinstance(document, dict) and document.get("format") == "unglare-capture":
        return _of_capture(file, document)
    try:
        return CalibrationEntry.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the whole file"
        raise InvalidCalibrationError(
            f"{file} is neither a calibration of OpenCV (cv2.FileStorage) nor a capture.json nor one of ours"
            f" ({place}: {first['msg'].lower()}); choose another file."
        ) from None


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


def entry_of(calibration: RigCalibration) -> CalibrationEntry:
    """Write a calibration as a rig file has it."""
    views = {
        name: _view(model, calibration.camera_from_world[name])
        for name, model in calibration.cameras.items()
    }
    projector, pose = calibration.projector, calibration.projector_from_world
    seen = _view(projector, pose) if projector is not None and pose is not None else None
    return CalibrationEntry(cameras=views, projector=seen)


def _view(model: PinholeModel, pose: Pose) -> ViewEntry:
    return ViewEntry.model_validate(
        {
            "width_px": model.width_px,
            "height_px": model.height_px,
            "K": model.K.tolist(),
            "distortion": model.distortion.ravel().tolist(),
            "R": pose.R.tolist(),
            "t_mm": pose.t_mm.ravel().tolist(),
        }
    )


def in_frame_of(entry: CalibrationEntry, camera: str) -> CalibrationEntry:
    """Return the same calibration with a camera's frame as world; as it is if it has no such camera."""
    if camera not in entry.cameras:
        return entry
    world = inverse(_transform(entry.cameras[camera]))

    def moved(view: ViewEntry) -> ViewEntry:
        pose = compose(_transform(view), world)
        return _view(view.model, Pose(pose.R, pose.t_mm))

    views = {name: moved(view) for name, view in entry.cameras.items()}
    here = views[camera]  # exactly, whatever was rounded
    views[camera] = ViewEntry(
        **here.model_dump(include={"width_px", "height_px", "K", "distortion"})
    )
    return CalibrationEntry(
        cameras=views, projector=moved(entry.projector) if entry.projector else None
    )


def _transform(view: ViewEntry) -> RigidTransform:
    return RigidTransform(view.device_from_world.R, view.device_from_world.t_mm)


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


def _of_opencv(found: _Matrices, hints: StereoHints) -> CalibrationEntry:
    if len(hints.cameras) != 2:
        raise InvalidCalibrationError(
            f"A stereo calibration is for two cameras, the rig has {', '.join(hints.cameras)}; write its calibration entry by hand."
        )
    R = found.need("The rotation between the cameras", _R)
    t_mm = found.need("The translation between the cameras", _T).ravel() * hints.unit_mm
    if R.size == 3:
        R = np.asarray(cv2.Rodrigues(R)[0], np.float64)
    _refuse_wrong_unit(t_mm, hints.unit_mm)
    poses = (Pose(np.eye(3), np.zeros(3)), Pose(_rotation(R), t_mm))
    views = {
        name: _view(_model(found, side, name, hints.size), pose)
        for name, side, pose in zip(hints.cameras, _SIDES, poses, strict=True)
    }
    return CalibrationEntry(cameras=views)


def _model(
    found: _Matrices, side: Sequence[str], camera: str, size: tuple[int, int] | None
) -> PinholeModel:
    K = found.need(f"The camera matrix of {camera}", [f"{k}{s}" for s in side for k in _K])
    distortion = found.find([f"{d}{s}" for s in side for d in _D])
    width_px, height_px = size or _size(found)
    if K.shape != (3, 3) or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InvalidCalibrationError(
            f"The camera matrix of {camera} in {found.files} is {K.tolist()}: it has to have positive focal lengths; calibrate again."
        )
    if not (0 < K[0, 2] < width_px and 0 < K[1, 2] < height_px):
        raise InvalidCalibrationError(
            f"The principal point of {camera} is {K[0, 2]:.0f}, {K[1, 2]:.0f} and so outside of {width_px}x{height_px} px: check --size."
        )
    return PinholeModel(
        width_px, height_px, K, np.zeros(5) if distortion is None else distortion.ravel()
    )


def _size(found: _Matrices) -> tuple[int, int]:
    pair = found.find(_SIZE)
    if pair is not None and pair.size == 2:
        return int(pair.ravel()[0]), int(pair.ravel()[1])
    width, height = found.find(_WIDTHS), found.find(_HEIGHTS)
    if width is None or height is None:
        raise InvalidCalibrationError(
            f"The size of the pictures is missing in {found.files}: say it with --size, e.g. --size 1280x1024."
        )
    return int(width), int(height)


def _rotation(R: Float[np.ndarray, "..."]) -> Float[np.ndarray, "3 3"]:
    if R.shape != (3, 3) or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InvalidCalibrationError(
            f"R is {R.tolist()}, which is no rotation: calibrate again, and write what cv2.stereoCalibrate returns."
        )
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)


def _refuse_wrong_unit(t_mm: Float[np.ndarray, "n"], unit_mm: float) -> None:
    if t_mm.shape != (3,):
        raise InvalidCalibrationError(
            f"T has {t_mm.size} numbers instead of 3: write what cv2.stereoCalibrate returns."
        )
    distance_mm = float(np.linalg.norm(t_mm))
    if not distance_mm > _NEAREST_MM:
        raise InvalidCalibrationError(
            f"The cameras would stand {distance_mm:.3g} mm apart with T's unit of {unit_mm:g} mm: say the right one, "
            "e.g. --unit-mm 1000 for metres, or the size of the board's squares in mm."
        )
