"""A rig's calibration in the words of numerics."""

from backend.domain.errors import InvalidCalibrationError
from backend.domain.rig import PinholeModel, Pose, RigCalibration
from backend.numerics.camera_model import Pinhole, RigidTransform, compose, inverse


def pinhole(model: PinholeModel) -> Pinhole:
    """Convert a camera or projector."""
    return Pinhole(model.K, model.distortion, model.width_px, model.height_px)


def from_reference(calibration: RigCalibration, device: Pose) -> RigidTransform:
    """Return the pose of a device with respect to the reference camera's frame."""
    reference = calibration.camera_from_world[calibration.reference]
    return compose(_transform(device), inverse(_transform(reference)))


def projector_from_reference(calibration: RigCalibration) -> RigidTransform | None:
    """Return the projector's pose with respect to the reference camera; None if it isn't calibrated."""
    if calibration.projector is None or calibration.projector_from_world is None:
        return None
    return from_reference(calibration, calibration.projector_from_world)


def require_camera(calibration: RigCalibration, name: str) -> Pinhole:
    """Return a camera's model, or say which are calibrated."""
    if name not in calibration.cameras or name not in calibration.camera_from_world:
        known = ", ".join(calibration.cameras)
        raise InvalidCalibrationError(
            f"Camera {name!r} isn't calibrated (calibrated are: {known}): calibrate it or leave it out."
        )
    return pinhole(calibration.cameras[name])


def _transform(pose: Pose) -> RigidTransform:
    return RigidTransform(pose.R, pose.t_mm)
