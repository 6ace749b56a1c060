"""The simulated rig passes the suite that hardware passes."""

from collections.abc import Mapping

import numpy as np
import pytest

from backend.devices.conformance import RigConformance
from backend.devices.sim import create_lcd_rig, create_rig
from backend.devices.sim.chains import CHAINS

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


class _SimulatedLcd(RigConformance):
    has_light = True
    exposure_us = 12_000.0
    options: Mapping[str, object] = {}

    @pytest.fixture
    def rig(self):
        small = {"scene": "mirror-flat", "size": "160x120", "screen_size": "480x270"}
        with create_lcd_rig({"pixel_pitch_mm": 1.1, **small, **self.options}) as rig:
            yield rig


class TestScreenAndMirror(_SimulatedLcd):
    options = {"chain": "B"}


class TestScreenAndMirror12Bit(_SimulatedLcd):
    options = {"chain": "A", "bit_depth": 12, "scene": "mirror-freeform"}


class TestScreenAndFilmCamera(_SimulatedLcd):
    """Its gray levels aren't proportional to light: the tone curve is undone first."""

    options = {"chain": "D", "bit_depth": 12}
    exposure_us = 6_000.0
    linear_within = 0.02

    def light(self, share: np.ndarray) -> np.ndarray:
        levels = np.linspace(0.0, 1.0, 4096)
        return np.asarray(np.interp(share, CHAINS["D"].tone(levels), levels))
