"""The simulated rig passes the suite that hardware passes."""

from collections.abc import Mapping

import pytest

from backend.devices.conformance import RigConformance
from backend.devices.sim import create_rig

SMALL = {"size": "160x120", "projector_size": "160x100"}


class _Simulated(RigConformance):
    has_light = True
    options: Mapping[str, object] = {}

    @pytest.fixture
    def rig(self):
        with create_rig({"scene": "plane", **SMALL, **self.options}) as rig:
            yield rig


class TestStereo8Bit(_Simulated):
    pass


class TestOneCamera12Bit(_Simulated):
    options = {"cameras": 1, "bit_depth": 12}


class TestMetal(_Simulated):
    options = {"scene": "metal", "projector_blur_px": 0.0, "gamma": 2.2}
    exposure_us = 100_000.0
