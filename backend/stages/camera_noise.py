"""The noise of a camera's gray levels, from what a rig tells of it."""

from backend.domain.rig import CameraFacts
from backend.numerics.uncertainty import NoiseModel


def noise_model(camera: CameraFacts, *, gain_db: float = 0.0) -> NoiseModel:
    """Translate a camera's facts into gray levels at a gain."""
    return NoiseModel.of_camera(
        read_noise_e=camera.read_noise_e,
        full_well_e=camera.full_well_e,
        full_scale_gray=camera.full_scale_gray,
        black_gray=camera.black_level_gray,
        gain_db=gain_db,
    )
