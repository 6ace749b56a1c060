"""A projector whose mirrors stand on their corners: a model for square pixels isn't one of it."""

import numpy as np
import pytest

from backend.devices.assembled import AssembledRig
from backend.devices.dlpc350_protocol import SIZE_PX
from backend.devices.errors import RigConfigError
from backend.devices.protocols import ProjectorCapabilities
from backend.domain.rig import PinholeModel, Pose, RigCalibration
from tests.example_driver.acme_unglare import AcmeProjector, Options


class Projector(AcmeProjector):
    """Of the LightCrafter's size."""

    layout = "diamond"

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(SIZE_PX, pixel_layout=self.layout)


@pytest.mark.parametrize(
    ("layout", "focal_rows", "refused"),
    [("diamond", 3000.0, False), ("diamond", 1500.0, True), ("square", 1500.0, False)],
)
def test_a_projector_model_for_square_pixels_is_refused(
    layout: str, focal_rows: float, refused: bool
) -> None:
    width_px, height_px = SIZE_PX
    K = np.array([[1500.0, 0, width_px / 2], [0, focal_rows, height_px / 2], [0, 0, 1]])
    model = PinholeModel(width_px, height_px, K, np.zeros(5))
    world = Pose(np.eye(3), np.zeros(3))
    known = RigCalibration({}, {}, "left", projector=model, projector_from_world=world)
    projector = Projector("projector", "Lamp", Options())
    projector.layout = layout
    rig = AssembledRig("bench", {}, projector, sensors={}, calibration=known)
    if refused:
        with pytest.raises(RigConfigError, match="its columns are twice as far apart as its rows"):
            rig._refuse_square_pixels()
    else:
        rig._refuse_square_pixels()
