"""The intensity mask on the simulated rig: other scenes, gammas, depths and lights than it was made on."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest

from backend.domain.rig import RigCalibration
from backend.domain.states import Level
from backend.numerics.camera_model import project
from backend.numerics.code_certainty import on_epipolar_line
from backend.numerics.homography import map_points
from backend.numerics.triangulation import triangulate_projector
from backend.stages.base_exposure import BaseExposure, BaseExposureParams, base_exposure
from backend.stages.code_capture import CodeCaptureParams, code_capture
from backend.stages.edges import Codes, EdgesParams, edges
from backend.stages.flat_mask import FlatMaskParams, flat_mask
from backend.stages.intensity_mask import IntensityMask
from backend.stages.joined_codes import joined_codes
from backend.stages.pixel_response import PixelResponseParams, pixel_response
from backend.stages.refine import RefineParams, refine
from backend.stages.rig_geometry import camera_geometry, pinhole, projector_from_reference
from backend.stages.second_look import SecondLookParams, second_look
from backend.stages.table_homography import (
    TableHomography,
    TableHomographyParams,
    table_homography,
)
from tests.scans.sim_shooting import SimShoot, sim_shoot

pytestmark = pytest.mark.scan

SMALL = {"size": "400x300", "projector_size": "400x300", "cameras": "1"}


def silent(done, text=""):
    """Report to nobody."""


def nothing(array_hash):
    """Load nothing: no test paints."""
    raise AssertionError(array_hash)


class Masked(NamedTuple):
    """A scene under its mask."""

    shoot: SimShoot
    base: BaseExposure
    mask: IntensityMask

    @property
    def calibration(self) -> RigCalibration:
        calibration = self.shoot.rig.calibration()
        assert isinstance(calibration, RigCalibration)
        return calibration

    @property
    def truth(self):
        return self.shoot.rig.truth("left", ("left",))


def masked(homography: TableHomography | None = None, **options) -> Masked:
    """Refine once."""
    with sim_shoot(**SMALL | options) as shoot:
        facts, calibration = shoot.rig.facts(), shoot.rig.calibration()
        base = base_exposure(facts, BaseExposureParams(), shoot)
        response = pixel_response(base, facts, PixelResponseParams(), shoot)
        first = flat_mask(base, response, homography, facts, calibration, FlatMaskParams(), nothing)
        mask = refine(first, response, base, facts, calibration, RefineParams(), shoot, nothing)
        return Masked(shoot, base, mask)


def true_places(found: Masked) -> np.ndarray:
    """Return the projector place that each pixel of the reference camera really sees."""
    points = found.truth.points_mm
    model = found.calibration.projector
    assert model is not None
    places = project(
        points.reshape(-1, 3).astype(np.float64),
        pinhole(model),
        projector_from_reference(found.calibration),
    )
    return places.reshape(*points.shape[:2], 2)


@pytest.mark.parametrize(
    "options",
    [
        {"scene": "workpieces"},
        {"scene": "workpieces", "gamma": "2.2", "seed": "3"},
        {"scene": "workpieces", "bit_depth": "12", "ambient_e_per_ms": "6"},
        {"scene": "metal", "projector_size": "512x320"},
        {"scene": "high-contrast"},
    ],
    ids=["workpieces", "gamma 2.2", "12 bit, bright room", "metal", "high contrast"],
)
def test_one_refinement_serves_nearly_every_pixel_of_any_scene(options):
    found = masked(**options)
    before, after = found.mask.rounds
    assert before.mask == "no mask"
    assert before.over_exposed_share > 0.3
    assert after.over_exposed_share < 0.003
    assert after.unqualified_share < 0.02
    assert found.mask.known_share > 0.98
    # What the mask is made of: where pixels look, but for those that second reflections outshine.
    off = np.stack([found.mask.projector_px["left"], found.mask.projector_row_px["left"]], -1)
    near = np.hypot(*np.moveaxis(off - true_places(found), -1, 0)) <= 1.5
    assert near[found.truth.base].mean() > 0.96


def test_the_mask_keeps_black_parts_in_full_light():
    found = masked(scene="workpieces")
    black = found.truth.base & (found.truth.part == found.truth.part_names.index("black"))
    white = found.mask.white["left"]
    unmasked = found.base.white["left"]
    assert np.median(white[black]) > 0.9 * np.median(unmasked[black])
    assert (found.mask.unqualified["left"][black] == 0).mean() > 0.98


@lru_cache(maxsize=1)
def table() -> tuple[TableHomography, SimShoot]:
    with sim_shoot(**SMALL | {"scene": "plane"}) as shoot:
        facts = shoot.rig.facts()
        base = base_exposure(facts, BaseExposureParams(), shoot)
        return table_homography(base, facts, TableHomographyParams(), shoot), shoot


def test_a_bare_table_is_found_within_its_lens_distortion():
    found, shoot = table()
    assert found.rms_px < 1.0
    assert found.table[0].table_share > 0.98
    truth = shoot.rig.truth("left", ("left",))
    y, x = np.nonzero(truth.base)
    calibration = shoot.rig.calibration()
    true = project(
        truth.points_mm[y, x].astype(np.float64),
        pinhole(calibration.projector),
        projector_from_reference(calibration),
    )
    off = (
        map_points(found.projector_from_camera["left"], np.column_stack([x, y]).astype(np.float64))
        - true
    )
    assert np.median(np.hypot(*off.T)) < 0.8


def test_the_first_mask_is_swept_along_the_heights_expected():
    found, _ = table()
    with sim_shoot(**SMALL | {"scene": "workpieces"}) as shoot:
        facts, calibration = shoot.rig.facts(), shoot.rig.calibration()
        base = base_exposure(facts, BaseExposureParams(), shoot)
        response = pixel_response(base, facts, PixelResponseParams(), shoot)
        reach = {
            height: flat_mask(
                base, response, found, facts, calibration, FlatMaskParams(height_mm=height), nothing
            ).dilation_px
            for height in (0.0, 30.0, 60.0)
        }
    assert reach[0.0] == pytest.approx(2)
    # f b h / z^2 with f = 1.75 * 400 px, b = 98 mm, z = 700 mm
    assert reach[30.0] - 2 == pytest.approx(700 * 98 * 30 / 700**2, rel=0.25)
    assert reach[60.0] - 2 == pytest.approx(2 * (reach[30.0] - 2), rel=0.15)


def errors_mm(codes: Codes, found: Masked) -> np.ndarray:
    """Return the error along each pixel's ray; infinite where there is no code that agrees with itself."""
    pair = camera_geometry(found.calibration, ("left",))["left"]
    columns, rows = codes.projector_px["left"], codes.projector_row_px["left"]
    points = triangulate_projector(columns, *pair).points_mm
    true = found.truth.points_mm
    error = ((points - true) * true).sum(-1) / np.linalg.norm(true, axis=-1)
    good = (codes.reasons["left"] == 0) & on_epipolar_line(columns, rows, pair, tolerance_px=2.5)
    return np.where(good, np.abs(error), np.inf)


def test_a_second_look_tells_what_second_reflections_had_spoilt():
    with sim_shoot(
        scene="workpieces", size="640x480", projector_size="512x384", cameras="1"
    ) as shoot:
        facts, calibration = shoot.rig.facts(), shoot.rig.calibration()
        base = base_exposure(facts, BaseExposureParams(), shoot)
        response = pixel_response(base, facts, PixelResponseParams(), shoot)
        first = flat_mask(base, response, None, facts, calibration, FlatMaskParams(), nothing)
        mask = refine(first, response, base, facts, calibration, RefineParams(), shoot, nothing)
        frames = code_capture(mask, base, facts, CodeCaptureParams(), shoot)
        codes = edges(frames, mask, facts, EdgesParams(), silent)
        params = SecondLookParams(bands=6, band_px=6)
        look = second_look(codes, frames, mask, base, facts, calibration, params, shoot)
        little = params.model_copy(update={"budget_s": 0.4 * look.whole_s})
        less = second_look(codes, frames, mask, base, facts, calibration, little, shoot)
    found = Masked(shoot, base, mask)
    assert (look.looks, look.left_out) == (6, 0)
    assert look.whole_s > sum(f.exposure_ms for f in look.frames) / 1000
    # There is time for two looks in five: those that most pixels wait for, and nothing is told elsewhere.
    assert (less.looks, less.left_out) == (2, 4)
    assert less.whole_s == pytest.approx(look.whole_s, rel=0.1)  # noise moves the exposure a little
    assert 2 / 6 < less.trusted["left"].sum() / look.trusted["left"].sum() < 1
    assert (less.trusted["left"] & ~look.trusted["left"]).mean() < 0.001
    (verdict,) = second_look.checks
    assert verdict(look, params).level is Level.OK
    warning = verdict(less, little)
    assert warning.level is Level.WARNING
    assert "4 of 6 looks were left out" in warning.sentence
    # Most of what is looked at again had been dimmed: less time and more light instead, in whole projector frames.
    assert look.exposure_ms < 0.7 * base.exposure_ms
    frame_ms = facts.projector.frame_period_ms
    assert look.exposure_ms / frame_ms == pytest.approx(round(look.exposure_ms / frame_ms))
    assert {f.exposure_ms for f in look.frames} == {look.exposure_ms}
    assert look.after_share < 0.5 * look.before_share
    joined = joined_codes(codes, look)
    truth = found.truth
    shiny = truth.base & (truth.part == truth.part_names.index("shiny"))
    others = truth.base & ~shiny
    before, after = (errors_mm(c, found) < 1.0 for c in (codes, joined))
    assert after[shiny].mean() > before[shiny].mean() + 0.04
    assert after[others].mean() > before[others].mean() - 0.002


def test_no_second_look_is_taken_where_nobody_asked_for_a_mask():
    with sim_shoot(**SMALL | {"scene": "plane"}) as shoot:
        facts, calibration = shoot.rig.facts(), shoot.rig.calibration()
        base = base_exposure(facts, BaseExposureParams(), shoot)
        frames = code_capture(None, base, facts, CodeCaptureParams(), shoot)
        codes = edges(frames, None, facts, EdgesParams(), silent)
        look = second_look(codes, frames, None, base, facts, calibration, SecondLookParams(), shoot)
    assert look.codes is None
    (verdict,) = second_look.checks
    assert (verdict(look, SecondLookParams()).level, verdict(look, SecondLookParams()).value) == (
        Level.OK,
        None,
    )
    assert "nan" not in verdict(look, SecondLookParams()).sentence
    assert joined_codes(codes, look) is codes
    assert joined_codes(codes, None) is codes
