"""What clients see of a rig with a screen: the screen's edge and the mirror's middle, in the world."""

import numpy as np
import pytest

from backend.devices.sim import create_lcd_rig, create_rig
from backend.jobs.rigs import RigGiven
from backend.services.rigs import rig_view

SMALL = {"scene": "mirror-flat", "size": "64x48", "screen_size": "480x270", "pixel_pitch_mm": 1.0}


def view(rig):
    return rig_view("rig", "Rig", {}, RigGiven(rig.facts(), rig.calibration()))


@pytest.mark.parametrize(("bow", "points"), [(0.0, 4), (20.0, 18)])
def test_a_screen_has_an_edge_once_around_and_a_mirror_a_middle(bow, points):
    shown = view(create_lcd_rig(SMALL | {"screen_bow_mm": bow}))
    edge = np.array(shown.screen_mm)
    assert len(edge) == points
    around = np.linalg.norm(edge - np.roll(edge, 1, axis=0), axis=1).sum()
    assert around == pytest.approx(2 * (480 + 270), rel=0.02)
    assert shown.mirror_mm == pytest.approx((0.0, 0.0, 700.0), abs=1e-9)


def test_rigs_without_a_screen_have_neither():
    for rig in (create_rig({"scene": "plane"}), create_lcd_rig(SMALL | {"calibrated": False})):
        shown = view(rig)
        assert shown.screen_mm == ()
        assert shown.mirror_mm is None
