"""Fringes under bands of epipolar lines: what is captured, when, and what it replaces."""

from dataclasses import replace

import numpy as np
import pytest

from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.rig import (
    CameraFacts,
    PinholeModel,
    Pose,
    ProjectorFacts,
    RigCalibration,
    RigFacts,
)
from backend.domain.shots import Shot
from backend.stages.band_capture import BandCaptureParams, band_capture, doubtful_pixels, lines
from backend.stages.band_phase import BandPhaseParams, band_phase
from backend.stages.cloud import Cloud
from backend.stages.exposures import Exposures
from backend.stages.fringe_design import FringeDesign
from backend.stages.fringe_phase import AbsolutePhase
from tests import surfaces

WIDTH, HEIGHT = 96, 72
PROJECTOR = (128, 80)
DESIGN = FringeDesign((7.0, 8.0, 9.0), 4, 40.0, 220.0, "x", "none")


def facts() -> RigFacts:
    camera = CameraFacts(WIDTH, HEIGHT, 8, 1.0, 2000.0, 4.0, 15300.0, 12.0)
    return RigFacts({"left": camera, "right": camera}, "left", ProjectorFacts(*PROJECTOR, 10.0))


def model(width: int, height: int) -> PinholeModel:
    K = np.array([[1.9 * width, 0, width / 2], [0, 1.9 * width, height / 2], [0, 0, 1]])
    return PinholeModel(width, height, K)


def pose(transform) -> Pose:
    return Pose(transform.R, transform.t_mm)


def calibration() -> RigCalibration:
    return RigCalibration(
        cameras={"left": model(WIDTH, HEIGHT), "right": model(WIDTH, HEIGHT)},
        camera_from_world={"left": pose(surfaces.LEFT), "right": pose(surfaces.RIGHT)},
        reference="left",
        projector=model(*PROJECTOR),
        projector_from_world=pose(surfaces.PROJECTOR),
    )


def maps(value: float, dtype: type = np.float32) -> dict[str, np.ndarray]:
    return {name: np.full((HEIGHT, WIDTH), value, dtype) for name in ("left", "right")}


def a_phase() -> AbsolutePhase:
    return AbsolutePhase(
        projector_px=maps(40.0),
        projector_row_px={},
        wrapped_rad=maps(0.0),
        modulation_gray=maps(30.0),
        residual_cycles=maps(0.001),
        sigma_px=maps(0.02),
        sigma_row_px={},
        reasons=maps(0, np.uint16),
        exposure_index=maps(0, np.uint8),
        valid_share=1.0,
        median_sigma_px=0.02,
        unwrapping="maximum likelihood",
        residual_max_cycles=0.1,
        full_scale_gray=255.0,
    )


def a_cloud(missing: int) -> Cloud:
    """Make a cloud that lacks the uppermost rows."""
    depth = np.full((HEIGHT, WIDTH), 700, np.float32)
    depth[:missing] = np.nan
    nothing = np.zeros(0, np.float32)
    return Cloud(
        points_mm=np.zeros((0, 3), np.float32),
        normals=np.zeros((0, 3), np.float32),
        colour=np.zeros((0, 3), np.uint8),
        sigma_mm=nothing,
        pixel_x=nothing,
        pixel_y=nothing,
        exposure_index=np.zeros(0, np.uint8),
        depth_mm={"left": depth},
        reasons={"left": np.zeros((HEIGHT, WIDTH), np.uint16)},
        removed=(),
        point_count=0,
        median_sigma_mm=0.1,
        kept_share=1.0,
        cameras=("left", "right"),
    )


def some_exposures() -> Exposures:
    empty = np.zeros(0)
    return Exposures((50.0, 200.0), (), 1, 0, 0.1, 3.0, 20.0, empty, empty, False, DESIGN)


class TwoPaths:
    """Shows every pixel its own column, and on top a second one of another line, where that is lit, too."""

    def __init__(self) -> None:
        self.shots: list[Shot] = []
        own = lines(calibration(), "left")
        height, _ = own.projector_px.shape
        self.column = np.full((HEIGHT, WIDTH), 70.3)
        self.second = np.full((HEIGHT, WIDTH), 20.7)
        rows = np.arange(height)
        at = 70
        found = np.interp(own.camera_px, own.projector_px[:, at], rows)
        self.row = np.clip(np.rint(found), 0, height - 1).astype(int)
        self.other_row = (self.row + height // 2) % height
        low, high = own.projector_px[[0, -1], at]
        self.seen = (own.camera_px > low + 4) & (own.camera_px < high - 4)
        """Pixels whose line crosses the projector's picture at their column."""
        self.rng = np.random.default_rng(7)

    def shoot(self, plan):
        request = next(plan)
        try:
            while True:
                self.shots += request.burst
                request = plan.send(tuple(self.take(shot) for shot in request.burst))
        except StopIteration as end:
            return end.value

    def take(self, shot):
        mask = np.broadcast_to(shot.mask.load(), PROJECTOR[::-1])
        light = 0.0
        for column, row, share in (
            (self.column, self.row, 1.0),
            (self.second, self.other_row, 0.8),
        ):
            lit = mask[row, np.rint(column).astype(int)]
            phase = 2 * np.pi * shot.pattern.periods * (column + 0.5) / PROJECTOR[0]
            light = light + share * lit * (130 + 90 * np.cos(phase + shot.pattern.shift_rad))
        gray = 4 + 0.4 * shot.exposure_ms / 50 * light + self.rng.normal(0, 0.3, (HEIGHT, WIDTH))
        pixels = InMemory(np.clip(np.rint(gray), 0, 255).astype(np.uint8))
        return {
            name: Frame(name, shot.pattern, shot.exposure_ms, pixels, 8, 0.0, shot.role)
            for name in shot.cameras
        }


def capture(params: BandCaptureParams, *, missing: int = HEIGHT):
    scene = TwoPaths()
    result = band_capture(
        a_phase(),
        a_cloud(missing),
        some_exposures(),
        None,
        None,
        calibration(),
        facts(),
        params,
        scene.shoot,
    )
    return scene, result


def silent(done: float, text: str = "") -> None:
    """Report nothing."""


def test_few_doubtful_pixels_need_no_bands():
    scene, result = capture(BandCaptureParams(), missing=0)
    assert scene.shots == []
    assert result.sets == ()
    phase = a_phase()
    assert band_phase(result, phase, calibration(), facts(), BandPhaseParams(), silent) is phase


def test_bands_can_be_switched_off_and_on():
    assert capture(BandCaptureParams(run="no"))[0].shots == []
    with pytest.raises(StageFailedError, match="nothing that bands could clear up"):
        capture(BandCaptureParams(run="yes"), missing=0)


def test_every_camera_bit_and_half_is_captured_within_the_budget():
    params = BandCaptureParams(bits=3, budget_s=1.5)
    scene, result = capture(params)
    assert len(result.sets) == 2 * 3 * 2
    assert result.frame_count == len(scene.shots) == len(result.sets) * 12
    assert result.exposure_time_s <= 1.5
    assert {shot.exposure_ms for shot in scene.shots} == {10.0}  # a whole projector frame
    first, second = (scene.shots[12 * n].mask.load() for n in (0, 1))
    np.testing.assert_array_equal(first + second, 1)


def test_the_second_path_is_told_apart():
    params = BandCaptureParams(bits=3, cameras="reference", exposures_ms=(50.0,))
    scene, result = capture(params)
    found = band_phase(result, a_phase(), calibration(), facts(), BandPhaseParams(), silent)
    right = np.abs(found.projector_px["left"] - scene.column) < 0.5
    assert right[scene.seen].mean() > 0.8
    np.testing.assert_array_equal(found.projector_px["right"], a_phase().projector_px["right"])
    assert (found.reasons["left"][right] == 0).all()


def test_what_agrees_with_the_first_fringes_stays():
    params = BandCaptureParams(bits=3, cameras="reference", exposures_ms=(50.0,))
    scene, result = capture(params)
    first = replace(a_phase(), projector_px=maps(70.3), sigma_px=maps(0.5))
    found = band_phase(result, first, calibration(), facts(), BandPhaseParams(), silent)
    kept = found.projector_px["left"] == np.float32(70.3)
    assert kept[scene.seen].mean() > 0.8


def test_doubtful_are_pixels_with_a_phase_but_no_point():
    phase = a_phase()
    phase.projector_px["left"][:, 0] = np.nan
    doubtful = doubtful_pixels(phase, a_cloud(10))
    assert doubtful.sum() == 10 * (WIDTH - 1)
