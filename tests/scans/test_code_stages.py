"""The final code on the simulated rig: predicted noise, two cameras, stripe widths with and without a mask."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from backend.contract.requests import CreateScan
from backend.domain.patterns import WHITE
from backend.domain.shots import Shot
from backend.numerics.camera_model import project
from backend.numerics.reasons import Reason
from backend.numerics.scoring import score
from backend.stages.base_exposure import BaseExposureParams, base_exposure
from backend.stages.cloud import Cloud
from backend.stages.code_capture import CodeCaptureParams, code_capture
from backend.stages.code_cloud import CodeCloudParams, code_cloud
from backend.stages.edges import Codes, EdgesParams, edges
from backend.stages.intensity_mask import IntensityMask
from backend.stages.rig_geometry import pinhole, projector_from_reference
from tests.scans.houses import real_house, run_unattended, stage_of
from tests.scans.sim_shooting import SimShoot, sim_shoot

pytestmark = pytest.mark.scan

PLANE = {"scene": "plane", "size": "640x480", "projector_size": "512x384"}
PARTS = {"scene": "workpieces", "size": "480x360", "projector_size": "512x384"}


def silent(done, text=""):
    """Report to nobody."""


def codes_of(shoot: SimShoot, mask=None, exposure_ms=None, **settings) -> Codes:
    facts = shoot.rig.facts()
    base = base_exposure(facts, BaseExposureParams(exposure_ms=exposure_ms), shoot)
    frames = code_capture(mask, base, facts, CodeCaptureParams(), shoot)
    codes = edges(frames, mask, facts, EdgesParams(**settings), silent)
    assert isinstance(codes, Codes)
    return codes


@lru_cache(maxsize=1)
def plane() -> tuple[Codes, SimShoot]:
    with sim_shoot(**PLANE) as shoot:
        return codes_of(shoot), shoot


def cloud_of(codes: Codes, shoot: SimShoot, **settings) -> Cloud:
    cloud = code_cloud(codes, shoot.rig.calibration(), CodeCloudParams(**settings), silent)
    assert isinstance(cloud, Cloud)
    return cloud


def scores_of(cloud: Cloud, shoot: SimShoot):
    truth = shoot.rig.truth("left", ("left", "right"))
    x, y = cloud.pixel_x.astype(np.int64), cloud.pixel_y.astype(np.int64)
    return score(cloud.points_mm, x, y, truth)


@pytest.mark.parametrize("cameras", ["reference", "all"])
def test_points_of_a_plane_scatter_as_predicted(cameras):
    codes, shoot = plane()
    cloud = cloud_of(codes, shoot, cameras=cameras)
    truth = shoot.rig.truth("left", ("left", "right"))
    x, y = cloud.pixel_x.astype(int), cloud.pixel_y.astype(int)
    true_mm = truth.points_mm[y, x]
    error_mm = ((cloud.points_mm - true_mm) * true_mm).sum(axis=1) / np.linalg.norm(true_mm, axis=1)
    inside = truth.base[y, x]
    score_of = (error_mm / cloud.sigma_mm)[inside]
    assert inside.sum() > 100_000
    assert np.std(score_of) == pytest.approx(1, abs=0.15)
    assert abs(np.mean(score_of)) < 0.1


def test_two_cameras_are_better_than_one_and_miss_nothing():
    codes, shoot = plane()
    one, two = (cloud_of(codes, shoot, cameras=cameras) for cameras in ("reference", "all"))
    worse, better = scores_of(one, shoot).total, scores_of(two, shoot).total
    assert better.completeness >= worse.completeness > 0.999
    assert better.mean_mm < 0.75 * worse.mean_mm
    assert two.median_sigma_mm < 0.8 * one.median_sigma_mm
    assert two.cameras == ("left", "right")


def test_the_second_camera_fills_what_the_first_cannot_read():
    codes, shoot = plane()
    hole = np.s_[150:190, 200:260]
    for maps in (codes.projector_px, codes.sigma_px, codes.projector_row_px):
        assert np.isfinite(maps["left"][hole]).all()

    def blind(maps: Mapping[str, np.ndarray], value: float) -> dict[str, np.ndarray]:
        left = maps["left"].copy()
        left[hole] = value
        return {**maps, "left": left}

    holed = replace(
        codes,
        projector_px=blind(codes.projector_px, np.nan),
        sigma_px=blind(codes.sigma_px, np.nan),
        projector_row_px=blind(codes.projector_row_px, np.nan),
        reasons=blind(codes.reasons, Reason.SATURATED),
    )
    one, two = (cloud_of(holed, shoot, cameras=cameras) for cameras in ("reference", "all"))
    assert np.isnan(one.depth_mm["left"][hole]).all()
    filled = two.depth_mm["left"][hole]
    assert np.isfinite(filled).mean() > 0.8
    truth = shoot.rig.truth("left", ("left", "right")).points_mm[..., 2][hole]
    assert np.nanmedian(np.abs(filled - truth)) < 0.15
    assert (two.reasons["left"][hole][np.isfinite(filled)] == 0).all()


def test_a_column_that_only_one_camera_reads_so_is_removed():
    codes, shoot = plane()
    wrong = {"left": codes.projector_px["left"].copy(), "right": codes.projector_px["right"]}
    wrong["left"][150:190, 200:260] += np.float32(1.2)
    cloud = cloud_of(replace(codes, projector_px=wrong), shoot)
    found = cloud.reasons["left"][152:188, 202:258]
    assert ((found & Reason.LEFT_RIGHT_CHECK) > 0).mean() > 0.9


def own_mask(shoot: SimShoot, exposure_ms: float) -> IntensityMask:
    """Dim what is bright, by the truth: the point of each camera pixel is known here."""
    calibration = shoot.rig.calibration()
    projector, pose = pinhole(calibration.projector), projector_from_reference(calibration)
    factor = np.ones((projector.height_px, projector.width_px), np.float32)

    def plan():
        return (yield tuple(Shot(WHITE, exposure_ms / n) for n in (64, 8, 1)))

    grays = [shot["left"].gray.astype(np.float32) for shot in shoot(plan())]
    rate = (grays[0] - 4) * 64
    for gray, share in ((grays[1], 8), (grays[2], 1)):
        rate = np.where(gray < 250, (gray - 4) * share, rate)
    truth = shoot.rig.truth("left")
    seen = truth.lit_and_seen
    place = np.rint(project(truth.points_mm[seen].astype(float), projector, pose)).astype(int)
    inside = ((place >= 0) & (place < factor.shape[::-1])).all(axis=1)
    wanted = np.clip(200 / np.maximum(rate[seen], 1), 0.01, 1)[inside]
    np.minimum.at(factor, (place[inside, 1], place[inside, 0]), wanted.astype(np.float32))
    return IntensityMask(np.asarray(cv2.erode(factor, np.ones((5, 5))), np.float32))


def test_stripes_of_the_shiny_part_are_equally_wide_under_a_mask_and_unequal_without():
    """The paper's figure 19: 33 against 38 px without, equal with the mask."""
    exposure_ms = 600.0
    with sim_shoot(**PARTS) as shoot:
        mask = own_mask(shoot, exposure_ms)
        with_mask, without = (codes_of(shoot, m, exposure_ms) for m in (mask, None))
        truth = shoot.rig.truth("left", ("left", "right"))
    shiny = truth.base & (truth.part == truth.part_names.index("shiny"))
    unequal = without.widening_px["left"][shiny]
    equal = with_mask.widening_px["left"][shiny]
    assert np.nanmedian(unequal) > 0.5
    assert np.isnan(unequal).mean() + (np.abs(unequal) > 0.5).mean() > 0.8
    assert np.nanpercentile(np.abs(equal), 90) < 0.5
    assert without.bright_widening_px > 0.5
    assert with_mask.valid_share > without.valid_share + 0.3


def test_a_fixed_threshold_loses_what_pattern_and_inverse_keep():
    with sim_shoot(**PARTS) as shoot:
        facts = shoot.rig.facts()
        base = base_exposure(facts, BaseExposureParams(exposure_ms=25.0), shoot)
        frames = code_capture(None, base, facts, CodeCaptureParams(), shoot)
        found = {
            way: edges(frames, None, facts, EdgesParams(decoding=way), silent)
            for way in ("delta", "dual", "fixed")
        }
        calibration = shoot.rig.calibration()
        truth = shoot.rig.truth("left", ("left", "right"))
    projector, pose = pinhole(calibration.projector), projector_from_reference(calibration)
    u_px = project(truth.points_mm[truth.base].astype(float), projector, pose)[:, 0]
    right, told = {}, {}
    for way, codes in found.items():
        error = np.abs(codes.projector_px["left"][truth.base] - u_px)
        right[way] = float(np.mean(error < 0.5))
        told[way] = float(np.mean(np.isfinite(error)))
    assert right["fixed"] < 0.3
    assert right["delta"] > right["fixed"] + 0.3
    assert told["dual"] >= told["delta"]


def test_a_projector_that_does_not_answer_is_one_sentence_and_keeps_the_frames(tmp_path, impatient):
    options = {**PLANE, "size": "160x120", "projector_fail_after_shows": 30, "fail_for_good": True}
    with real_house(tmp_path) as services:
        scan = services.create_scan(CreateScan(method="adaptive-code", rig_options=options), "ada")
        state = run_unattended(services, scan.id)
        failed = next(s for s in state.stages if s.status.value == "failed")
        assert "the simulated cable stays unplugged" in failed.message
        assert failed.message.count("\n") == 0
        assert stage_of(state, "base_exposure").status.value == "done"
