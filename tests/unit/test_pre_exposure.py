"""The search for the preview's exposure, driven with a linear camera that exists only as a formula."""

import numpy as np
import pytest

from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import Uniform
from backend.domain.rig import CameraFacts, ProjectorFacts, RigFacts
from backend.stages.pre_exposure import MAX_CAPTURES, PreExposureParams, pre_exposure

PERIOD_MS = 1000 / 120


def rig(period_ms: float | None = PERIOD_MS, longest_ms: float = 2000.0) -> RigFacts:
    camera = CameraFacts(40, 30, 8, 1.0, longest_ms, 4.0, 15300.0, 12.0)
    return RigFacts({"left": camera}, "left", ProjectorFacts(64, 48, period_ms))


class LinearCamera:
    """gray = 4 + rate t under white, 4 under black; clipped at 255."""

    def __init__(self, brightest_gray_per_ms: float) -> None:
        ramp = np.linspace(0.0, 1.0, 40 * 30).reshape(30, 40)
        self.rate = brightest_gray_per_ms * ramp
        self.shots: list[tuple[str, float]] = []

    def shoot(self, plan):
        try:
            burst = next(plan)
            while True:
                burst = plan.send(tuple({"left": self.frame(shot)} for shot in burst))
        except StopIteration as end:
            return end.value

    def frame(self, shot) -> Frame:
        assert isinstance(shot.pattern, Uniform)
        self.shots.append((shot.role, shot.exposure_ms))
        light = self.rate * shot.exposure_ms * (shot.pattern.gray / 255)
        gray = np.clip(np.round(4 + light), 0, 255).astype(np.uint8)
        return Frame("left", shot.pattern, shot.exposure_ms, InMemory(gray), role=shot.role)


@pytest.mark.parametrize("brightest", [0.13, 0.9, 4.0, 11.0, 25.0])
def test_the_longest_unsaturated_multiple_of_the_frame_period_is_found(brightest):
    camera = LinearCamera(brightest)
    preview = pre_exposure(rig(), None, PreExposureParams(saturated_share=0.0), camera.shoot)
    steps = preview.t_pre_ms / PERIOD_MS
    assert steps == pytest.approx(round(steps))
    assert 4 + brightest * preview.t_pre_ms < 254.5
    longer = preview.t_pre_ms + max(PERIOD_MS, 0.03 * preview.t_pre_ms)
    assert longer > 2000 or np.round(4 + brightest * longer) >= 254
    assert len(camera.shots) <= MAX_CAPTURES


def test_brightness_is_measured_from_the_longest_unsaturated_picture():
    camera = LinearCamera(4.0)
    preview = pre_exposure(rig(), None, PreExposureParams(), camera.shoot)
    lit = preview.foreground["left"]
    error = preview.rate_gray_per_ms["left"][lit] - camera.rate[lit]
    longest = max(t for role, t in camera.shots if role == "white")
    assert longest == pytest.approx(8 * preview.t_pre_ms, abs=PERIOD_MS)
    assert np.abs(error).max() < 0.5 / preview.t_pre_ms + 1e-6
    dark = camera.rate[lit] * longest < 250
    assert np.abs(error[dark]).max() < 0.5 / longest + 1e-6


def test_a_set_exposure_is_used_as_it_is():
    camera = LinearCamera(1.0)
    preview = pre_exposure(
        rig(), None, PreExposureParams(exposure_ms=33.3, boost=1.0), camera.shoot
    )
    assert preview.t_pre_ms == 33.3
    assert camera.shots == [("white", 33.3), ("dark", 33.3)]


def test_an_all_black_scene_is_refused_in_a_sentence():
    with pytest.raises(StageFailedError, match="lens cap"):
        pre_exposure(rig(), None, PreExposureParams(), LinearCamera(0.0).shoot)


def test_an_all_white_scene_gives_the_shortest_exposure_and_a_failed_check():
    preview = pre_exposure(rig(), None, PreExposureParams(), LinearCamera(5000.0).shoot)
    assert preview.t_pre_ms == pytest.approx(PERIOD_MS)
    assert preview.saturated_share > 0.9
    levels = {c.name: c.level.value for c in pre_exposure.check(preview, PreExposureParams())}
    assert levels["saturation"] == "failure"


@pytest.mark.parametrize(
    ("facts", "params", "words"),
    [
        (rig(longest_ms=5.0), PreExposureParams(), "whole projector frames"),
        (rig(), PreExposureParams(exposure_ms=5000.0), "1 to 2000 ms"),
    ],
)
def test_impossible_exposures_are_refused(facts, params, words):
    with pytest.raises(StageFailedError, match=words):
        pre_exposure(facts, None, params, LinearCamera(1.0).shoot)
