"""The calibration that a captured folder brings, checked and brought into one frame."""

import numpy as np
from jaxtyping import Float

from backend.contract.capture import Capture, CapturedCamera, CapturedProjector, Extrinsics
from backend.domain.errors import InvalidCalibrationError
from backend.domain.rig import PinholeModel, Pose, RigCalibration
from backend.numerics.errors import CalibrationError
from backend.numerics.pinhole import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    compose,
    inverse,
)

PROJECTOR = "projector"


def capture_calibration(capture: Capture) -> RigCalibration | None:
    """Build the calibration in the reference camera's frame; None if it doesn't tie two devices together.

    Raises
    ------
    InvalidCalibrationError
        If a matrix is singular, R is no rotation, or extrinsics contradict the devices.
    """
    models = _models(capture)
    poses = _poses(capture)
    cameras = {n: m for n, m in models.items() if n != PROJECTOR and n in poses}
    projector = models.get(PROJECTOR) if PROJECTOR in poses else None
    if len(cameras) + (projector is not None) < 2 or capture.reference_camera not in cameras:
        return None
    return RigCalibration(
        cameras=cameras,
        camera_from_world={name: poses[name] for name in cameras},
        reference=capture.reference_camera,
        projector=projector,
        projector_from_world=poses.get(PROJECTOR) if projector else None,
    )


def _models(capture: Capture) -> dict[str, PinholeModel]:
    devices: dict[str, CapturedCamera | CapturedProjector] = dict(capture.cameras)
    if capture.projector is not None:
        devices[PROJECTOR] = capture.projector
    return {name: _model(name, device) for name, device in devices.items() if device.K is not None}


def _model(name: str, device: CapturedCamera | CapturedProjector) -> PinholeModel:
    K = np.array(device.K, dtype=np.float64)
    if not np.isfinite(K).all() or abs(np.linalg.det(K)) < 1e-9 or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InvalidCalibrationError(
            f"The camera matrix K of {name!r} is {K.tolist()}: it has to be finite, invertible and have "
            "positive focal lengths; calibrate again."
        )
    distortion = np.array(device.distortion or (0.0,) * 5, dtype=np.float64)
    try:
        check_pinhole(Pinhole(K, distortion, device.width_px, device.height_px), repr(name))
    except CalibrationError as error:
        raise InvalidCalibrationError(f"{str(error).rstrip('.')}.") from None
    return PinholeModel(device.width_px, device.height_px, K, distortion)


def _poses(capture: Capture) -> dict[str, Pose]:
    """Walk the extrinsics from the reference camera: device -> x_device = R x_reference + t."""
    poses = {capture.reference_camera: RigidTransform(np.eye(3), np.zeros(3))}
    links = [(link.from_, link.to, _transform(link)) for link in capture.extrinsics]
    links += [(to, from_, inverse(transform)) for from_, to, transform in links]
    for _ in links:
        for from_, to, transform in links:
            if from_ in poses and to not in poses:
                poses[to] = compose(transform, poses[from_])
    return {name: Pose(t.R, t.t_mm) for name, t in poses.items()}


def _transform(link: Extrinsics) -> RigidTransform:
    R = np.array(link.R, dtype=np.float64)
    t_mm = np.array(link.t_mm, dtype=np.float64)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InvalidCalibrationError(
            f"R from {link.from_!r} to {link.to!r} is no rotation (determinant {np.linalg.det(R):.4f}): calibrate again."
        )
    if np.linalg.norm(t_mm) < 1e-9:
        raise InvalidCalibrationError(
            f"{link.from_!r} and {link.to!r} stand at the same place (t_mm is 0): without a base line there is no depth."
        )
    return RigidTransform(_nearest_rotation(R), t_mm)


def _nearest_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)
