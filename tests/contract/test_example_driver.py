"""The example package's devices pass the suite: as a rig, and its camera alone, without any projector."""

from collections.abc import Iterator

import pytest

from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.conformance import RigConformance
from backend.devices.driver_loading import make_projector
from backend.devices.pages import PageDesk
from backend.devices.protocols import Rig
from tests.example_driver.acme_unglare import create_camera, create_rig


class TestCell(RigConformance):
    has_light = True

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        with create_rig({"cell": "tested"}) as rig:
            yield rig


class TestCameraAlone(RigConformance):
    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        cameras = {"top": create_camera("top", {"cell": "alone"})}
        nobody = make_projector("projector", "none", {}, PageDesk())
        with AssembledRig("alone", cameras, nobody, sensors={"top": SensorFacts()}) as rig:
            yield rig
