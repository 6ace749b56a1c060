"""Reading a captured folder: `capture.json`, its pictures, its calibration. Nothing is stored here."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped
from pydantic import ValidationError

from backend.contract.capture import Capture, CapturedCamera, CapturedFrame
from backend.domain.errors import InvalidCaptureError
from backend.domain.rig import CameraFacts, ProjectorFacts, RigCalibration, RigFacts

ASSUMED_FULL_WELL_E = 10_000.0
ASSUMED_READ_NOISE_E = 10.0
"""What an unknown camera's noise is predicted with: a common 8-bit industrial camera."""


@dataclass(frozen=True)
class CaptureFolder:
    """A capture that has been read and checked, but for its pictures."""

    folder: Path
    capture: Capture
    scan: dict[str, Any] | None
    """The `scan.json` beside it, if there is one."""
    calibration: RigCalibration | None = None
    """Where another program's file says more than a `capture.json` can; else the capture's own is read."""
    given: Mapping[str, Any] = field(default_factory=dict)
    """Results that such a file brings, by the name under which they are handed over."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings of stages that such a file brings."""
    setting_arrays: Mapping[tuple[str, str], Shaped[np.ndarray, "..."]] = field(
        default_factory=dict
    )
    """Arrays that settings refer to, by stage and setting."""

    def pictures(
        self,
    ) -> Iterator[tuple[CapturedFrame, Shaped[np.ndarray, "h w"]]]:
        """Read one picture after the other, checked against its camera."""
        for frame in self.capture.frames:
            yield frame, read_picture(self.folder / frame.file, self.capture.cameras[frame.camera])

    def mask(self, frame: CapturedFrame) -> Shaped[np.ndarray, "h w"] | None:
        """Read the intensity mask of a frame, float32 in [0, 1]."""
        if frame.mask is None:
            return None
        gray = _decode(self.folder / frame.mask)
        full_scale = 255.0 if gray.dtype == np.uint8 else 65535.0
        return (gray / full_scale).astype(np.float32)


def open_capture(path: Path) -> CaptureFolder:
    """Read `capture.json` (or the one in a folder) and the `scan.json` beside it.

    Raises
    ------
    InvalidCaptureError
        In one sentence: no such file, not JSON, a missing or wrong field, a missing picture.
    """
    file = path / "capture.json" if path.is_dir() else path
    capture = _validated(file, _json(file))
    for frame in capture.frames:
        _inside(file.parent, frame.file)
        if frame.mask is not None:
            _inside(file.parent, frame.mask)
    scan = file.parent / "scan.json"
    return CaptureFolder(file.parent, capture, _json(scan) if scan.is_file() else None)


def _json(file: Path) -> dict[str, Any]:
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InvalidCaptureError(
            f"There is no file {file}: name a capture.json or its folder."
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidCaptureError(f"{file} can't be read: {error}.") from None
    except json.JSONDecodeError as error:
        raise InvalidCaptureError(
            f"{file} isn't JSON: {error.msg} at line {error.lineno}, column {error.colno}."
        ) from None
    if not isinstance(document, dict):
        raise InvalidCaptureError(f"{file} has to hold one JSON object.")
    return document


def _validated(file: Path, document: dict[str, Any]) -> Capture:
    try:
        return Capture.model_validate_json(json.dumps(document))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the document"
        value = "" if first["type"] == "missing" else f" (it is {first['input']!r:.80})"
        more = f"; {error.error_count() - 1} more" if error.error_count() > 1 else ""
        raise InvalidCaptureError(f"{file}: {place}: {first['msg']}{value}{more}.") from None


def _inside(folder: Path, name: str) -> None:
    """Refuse a file that isn't there, or that is named outside of the folder."""
    file = (folder / name).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise InvalidCaptureError(
            f"{name} lies outside of {folder}: put the picture into the folder."
        )
    if not file.is_file():
        raise InvalidCaptureError(
            f"The picture {file} is missing: add it or take it out of capture.json."
        )


def read_picture(file: Path, camera: CapturedCamera) -> Shaped[np.ndarray, "h w"]:
    """Read one picture as gray levels and check it against its camera; colours become their mean.

    Raises
    ------
    InvalidCaptureError
        If the file is truncated or no picture, or its size or bit depth isn't the camera's.
    """
    gray = _decode(file)
    expected = (camera.height_px, camera.width_px)
    if gray.shape != expected:
        raise InvalidCaptureError(
            f"{file} is {gray.shape[1]}x{gray.shape[0]} px, but its camera has {expected[1]}x{expected[0]} px."
        )
    dtype = np.dtype(np.uint8 if camera.bit_depth == 8 else np.uint16)
    if gray.dtype != dtype:
        raise InvalidCaptureError(
            f"{file} has {gray.dtype.itemsize * 8} bits a pixel, but its camera's bit depth is {camera.bit_depth}: "
            "all frames of a camera have to be alike."
        )
    if (brightest := int(gray.max())) >= 2**camera.bit_depth:
        raise InvalidCaptureError(
            f"{file} holds gray {brightest}, more than {camera.bit_depth} bits can: correct bit_depth."
        )
    return gray


def _decode(file: Path) -> Shaped[np.ndarray, "h w"]:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InvalidCaptureError(f"{file} can't be read: {error.strerror}.") from None
    if not _is_whole(data):
        raise InvalidCaptureError(f"{file} is truncated ({len(data)} bytes): copy it again.")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None:
        raise InvalidCaptureError(
            f"{file} is no picture that can be read: save it as PNG, TIFF or JPEG."
        )
    if picture.ndim == 3:
        return _mean_of_colours(picture)
    return np.ascontiguousarray(picture)


def _mean_of_colours(picture: Shaped[np.ndarray, "h w c"]) -> Shaped[np.ndarray, "h w"]:
    colours = picture[:, :, :3]  # without alpha
    third = np.full((1, 3), 1 / 3, np.float32)
    return np.ascontiguousarray(cv2.transform(colours, third))


def _is_whole(data: bytes) -> bool:
    """Look for the end mark: decoders show half a picture without complaint."""
    ends: dict[bytes, Callable[[bytes], bool]] = {
        b"\x89PNG": lambda d: d.rstrip(b"\0").endswith(b"IEND\xaeB`\x82"),
        b"\xff\xd8": lambda d: b"\xff\xd9" in d[-4096:],
    }
    for start, ends_well in ends.items():
        if data.startswith(start):
            return ends_well(data)
    return len(data) > 0


def capture_facts(capture: Capture) -> RigFacts:
    """Collect what a captured folder tells of its rig; noise that isn't told is assumed."""
    cameras = {
        name: _camera_facts(capture, name, camera) for name, camera in capture.cameras.items()
    }
    projector = capture.projector
    return RigFacts(
        cameras=cameras,
        reference=capture.reference_camera,
        projector=None
        if projector is None
        else ProjectorFacts(
            projector.width_px,
            projector.height_px,
            projector.frame_period_ms,
            projector.gamma or 1.0,
        ),
    )


def _camera_facts(capture: Capture, name: str, camera: CapturedCamera) -> CameraFacts:
    exposures = [f.exposure_ms for f in capture.frames if f.camera == name and f.exposure_ms]
    return CameraFacts(
        width_px=camera.width_px,
        height_px=camera.height_px,
        bit_depth=camera.bit_depth,
        exposure_min_ms=min(exposures, default=1.0),
        exposure_max_ms=max(exposures, default=1.0),
        black_level_gray=camera.black_level_gray or 0.0,
        full_well_e=camera.full_well_e or ASSUMED_FULL_WELL_E,
        read_noise_e=camera.read_noise_e
        if camera.read_noise_e is not None
        else ASSUMED_READ_NOISE_E,
    )
