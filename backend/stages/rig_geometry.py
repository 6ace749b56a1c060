"""A rig's calibration in the words of numerics."""

from collections.abc import Mapping, Sequence

from backend.domain.errors import InvalidCalibrationError
from backend.domain.rig import PinholeModel, Pose, RigCalibration
from backend.numerics.camera_model import Pinhole, RigidTransform, compose, inverse
from backend.numerics.code_certainty import PairGeometry


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


def pair_geometry(calibration: RigCalibration, camera: str) -> PairGeometry | None:
    """Return a camera against the projector; None if the projector isn't calibrated."""
    projector_from_rig = projector_from_reference(calibration)
    if calibration.projector is None or projector_from_rig is None:
        return None
    model = require_camera(calibration, camera)
    camera_from_rig = from_reference(calibration, calibration.camera_from_world[camera])
    pose = compose(projector_from_rig, inverse(camera_from_rig))
    return PairGeometry(model, pinhole(calibration.projector), pose)


def camera_geometry(
    calibration: RigCalibration | None, cameras: Sequence[str]
) -> Mapping[str, PairGeometry]:
    """Return each camera against the projector; empty where the rig or its projector isn't calibrated."""
    if calibration is None:
        return {}
    pairs = {name: pair_geometry(calibration, name) for name in cameras}
    return {name: pair for name, pair in pairs.items() if pair is not None}


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
