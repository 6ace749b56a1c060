"""Fringe reflection from the stack to the linear quantity, on chains: choices, overrides, and what is refused."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from backend.devices.sim.chains import CHAINS
from backend.domain.errors import InvalidCaptureError, StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import StaticPicture
from backend.domain.rig import ProjectorFacts, RigFacts
from backend.domain.states import Level
from backend.stages.camera_response import Response, ResponseParams, camera_response
from backend.stages.interval import Interval, IntervalParams, interval
from backend.stages.linearise import (
    TITLES,
    LineariseParams,
    choose,
    linearise,
    representations,
)
from backend.stages.pre_exposure import ExposureGrid
from backend.stages.ramp import Ramp, RampParams, ramp, ramp_from_table
from backend.stages.stack import Stack, StackParams, import_stack, ladder, stack
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.codec import content_hash, decode, encode
from tests.chain_rig import ChainRig

SCENE = StackParams(scene_periods=0.5)  # the little screen has few codes: one slope shows them all


@dataclass(frozen=True)
class Made:
    """The stages' results on one chain."""

    rig: ChainRig
    facts: RigFacts
    stack: Stack
    response: Response
    ramp: Ramp
    interval: Interval


def made(letter: str, seed: int, *, bits: int = 8, exposure_ms: float | None = None) -> Made:
    rig = ChainRig(CHAINS[letter], seed=seed, bits=bits)
    facts = rig.facts
    pictures = stack(facts, SCENE, rig)
    response = camera_response(pictures, ResponseParams())
    measured = ramp(pictures, facts, RampParams(exposure_ms=exposure_ms), rig)
    chosen = interval(measured, response, facts, IntervalParams())
    return Made(rig, facts, pictures, response, measured, chosen)


@pytest.fixture(scope="module")
def film() -> Made:
    return made("D", 1)


# stack


def test_the_fringes_exposure_is_the_longest_that_saturates_nothing(film: Made) -> None:
    exposure_ms = film.stack.base_exposure_ms
    assert exposure_ms is not None

    # Chain D reaches 0.9 of full scale at the nominal 20 ms, some sigmas of noise below saturation.
    assert 17.0 < exposure_ms < 22.5


def test_the_ladder_surrounds_the_fringes_exposure(film: Made) -> None:
    exposures_ms = film.stack.exposures_ms

    assert len(exposures_ms) == 6
    assert exposures_ms[-1] / exposures_ms[0] == pytest.approx(50, rel=0.1)
    assert exposures_ms[-1] == pytest.approx(4 * (film.stack.base_exposure_ms or 0), rel=0.05)


def test_whole_frames_of_a_slow_screen_still_make_a_ladder() -> None:
    grid = ExposureGrid(step_ms=16.6667, lowest=1, highest=120)

    exposures_ms = ladder(16.6667, grid, StackParams())

    assert len(exposures_ms) == 6
    assert min(exposures_ms) == pytest.approx(16.6667)
    assert all(round(t / 16.6667, 4).is_integer() for t in exposures_ms)


def test_the_mirror_is_where_the_screen_is_seen(film: Made) -> None:
    region = film.stack.region["camera"]

    assert region[8:-8, 8:-8].all()
    assert region.sum() == region[8:-8, 8:-8].sum()


def picture(gray: int | np.ndarray, exposure_ms: float | None, camera: str = "camera") -> Frame:
    pixels = np.full((20, 20), gray, np.uint8) if isinstance(gray, int) else gray
    return Frame(camera, StaticPicture(), exposure_ms, InMemory(pixels))


BAD_STACKS = {
    "one exposure": ((picture(90, 10.0), picture(90, 10.0)), "one exposure, 10 ms"),
    "a single picture": ((picture(90, 10.0),), "one exposure, 10 ms"),
    "all clipped": ((picture(255, 10.0), picture(255, 20.0)), "All pixels .* are clipped"),
    "black and white": ((picture(0, 10.0), picture(255, 20.0)), "All pixels .* are clipped"),
    "no exposure": ((picture(90, None), picture(99, 20.0)), "doesn't tell its exposure"),
    "two cameras": ((picture(90, 1.0), picture(99, 2.0, "other")), "of 2 cameras"),
    "two sizes": (
        (picture(90, 1.0), picture(np.full((9, 9), 99, np.uint8), 2.0)),
        "differ in size",
    ),
}


@pytest.mark.parametrize(("frames", "sentence"), BAD_STACKS.values(), ids=BAD_STACKS.keys())
def test_stacks_that_tell_nothing_are_refused(frames: tuple[Frame, ...], sentence: str) -> None:
    with pytest.raises(InvalidCaptureError, match=sentence) as refused:
        import_stack(frames)

    assert refused.value.sentence.endswith(".")
    assert refused.value.sentence.count(". ") == 0


def test_an_imported_stack_gives_the_same_response(film: Made) -> None:
    imported = import_stack(film.stack.frames[::-1])

    found = camera_response(imported, ResponseParams())

    inside = slice(20, 245)
    assert (found.curve - film.response.curve)[inside].std() < 0.03


def test_a_screen_that_isnt_seen_is_refused() -> None:
    dark = replace(CHAINS["D"], black=0.999)  # black and white alike: no screen in the mirror
    rig = ChainRig(dark, seed=1)

    with pytest.raises(StageFailedError, match="isn't seen"):
        stack(rig.facts, SCENE, rig)


def test_a_rig_without_a_screen_is_refused(film: Made) -> None:
    with pytest.raises(StageFailedError, match="no screen"):
        stack(replace(film.facts, projector=None), SCENE, film.rig)


# ramp


def test_the_ramp_is_the_chains(film: Made) -> None:
    exposure_ms = film.ramp.exposure_ms or 0.0
    chain = CHAINS["D"]
    light = chain.luminance(chain.code(film.ramp.control))
    truth = chain.gray(light, exposure_ms / 20.0, quantised=False)

    np.testing.assert_allclose(film.ramp.gray, truth, atol=0.5)
    assert len(film.ramp.control) == 33
    assert film.ramp.screen_px == (96, 48)
    assert all(check.level is Level.OK for check in ramp.check(film.ramp, RampParams()))


def falling(measured: Ramp) -> Ramp:
    gray = np.where(measured.control > 0.6, 0.8 * measured.gray, measured.gray)
    return replace(measured, gray=gray)


def test_a_ramp_that_falls_fails_its_check_and_is_refused(film: Made) -> None:
    bad = falling(film.ramp)

    assert ramp.check(bad, RampParams())[0].level is Level.FAILURE
    with pytest.raises(StageFailedError, match="isn't monotone") as refused:
        interval(bad, film.response, film.facts, IntervalParams())
    assert refused.value.sentence.startswith("The ramp")


def test_a_ramp_of_another_screen_or_depth_is_refused(film: Made) -> None:
    other = replace(film.facts, projector=ProjectorFacts(1920, 1080))

    with pytest.raises(StageFailedError, match="96 x 48 px, this rig's has 1920 x 1080"):
        interval(film.ramp, film.response, other, IntervalParams())
    with pytest.raises(StageFailedError, match="at this bit depth"):
        interval(
            replace(film.ramp, full_scale_gray=4095.0), film.response, film.facts, IntervalParams()
        )


def test_a_ramp_from_a_table_works_without_a_stack() -> None:
    codes = np.linspace(0.0, 255.0, 27)
    on_file = ramp_from_table(codes, 2 + 232 * (codes / 255) ** 2.2)

    chosen = interval(on_file, None, None, IntervalParams())
    linear = linearise(on_file, None, chosen, None, LineariseParams())

    assert linear.representation in {"raw_full", "raw", "inverse", "predistorted"}
    assert np.isfinite(linear.predicted_mrad)
    with pytest.raises(StageFailedError, match="needs an exposure stack"):
        linearise(on_file, None, chosen, None, LineariseParams(representation="log"))


# interval and linear quantity


def test_a_dragged_interval_is_taken(film: Made) -> None:
    params = IntervalParams(interval_gray=(40.0, 200.0))

    chosen = interval(film.ramp, film.response, film.facts, params)

    assert chosen.chosen_gray == (40.0, 200.0)
    assert chosen.cost >= film.interval.cost
    linear = linearise(film.ramp, film.response, chosen, film.facts, LineariseParams())
    assert (linear.gray_low, linear.gray_high) == (40.0, 200.0)


def test_an_interval_outside_the_ramp_is_refused(film: Made) -> None:
    with pytest.raises(StageFailedError, match="isn't within the ramp"):
        interval(film.ramp, film.response, film.facts, IntervalParams(interval_gray=(0.0, 255.0)))


@pytest.mark.parametrize("name", TITLES)
def test_every_representation_can_be_set_by_hand(film: Made, name: str) -> None:
    params = LineariseParams.model_validate({"representation": name})

    linear = linearise(film.ramp, film.response, film.interval, film.facts, params)

    assert linear.representation == name
    assert "set by hand" in linear.reason
    assert (linear.codes is not None) == (name == "predistorted")
    assert np.isfinite(linear.values).all()
    assert linear.exposure_ms == film.ramp.exposure_ms


def test_four_steps_want_a_table_on_film_eight_need_none(film: Made) -> None:
    four, eight = (
        linearise(film.ramp, film.response, film.interval, film.facts, LineariseParams(steps=steps))
        for steps in (4, 8)
    )

    assert four.representation == "inverse"
    assert four.predicted_mrad < 8.5
    assert eight.representation in {"raw_full", "raw"}
    assert eight.predicted_mrad < 5.0
    raw = {row.representation: row.error_mrad for row in four.predicted}
    assert raw[TITLES["raw_full"]] > 70


@pytest.mark.parametrize("letter", ["A", "B", "C", "E", "F", "G"])
def test_what_is_chosen_is_near_the_best_prediction(letter: str) -> None:
    found = made(letter, 2, exposure_ms=20.0)

    linear = linearise(found.ramp, found.response, found.interval, found.facts, LineariseParams())

    assert linear.predicted_mrad <= 1.04 * min(row.error_mrad for row in linear.predicted)
    assert linear.predicted_mrad < 10.0


def test_the_default_wins_ties_and_nothing_is_refused() -> None:
    assert choose({"raw": 1.0, "inverse": 1.02}) == "inverse"
    assert choose({"raw": 1.0, "inverse": 1.2}) == "raw"
    with pytest.raises(StageFailedError, match="No representation"):
        choose({"raw": float("nan")})


def test_noise_that_wasnt_measured_comes_from_the_cameras_data(film: Made) -> None:
    silent = replace(film.ramp, noise_gray=np.full(33, np.nan))

    with_noise, without = (
        linearise(r, film.response, film.interval, film.facts, LineariseParams())
        for r in (film.ramp, silent)
    )

    assert without.predicted_mrad == pytest.approx(with_noise.predicted_mrad, rel=0.15)


def test_quoted_errors_are_those_of_the_representations(film: Made) -> None:
    linear = linearise(film.ramp, film.response, film.interval, film.facts, LineariseParams())
    assert linear.quoted_percent is not None

    gray, plain, optimised, table = np.abs(linear.quoted_percent).max(axis=1)

    assert gray > 5
    assert plain > 3
    assert optimised < 1
    assert table < 0.3
    assert list(representations(film.ramp, film.response, film.interval)) == list(TITLES)


def test_a_camera_of_12_bit_works_alike() -> None:
    found = made("D", 3, bits=12)

    linear = linearise(found.ramp, found.response, found.interval, found.facts, LineariseParams())

    assert len(linear.values) == 4096
    assert linear.predicted_mrad < 8.0
    assert found.interval.gray_high > 3600


def test_results_come_back_from_the_store_as_they_were(
    film: Made, store: LocalArtifactStore
) -> None:
    linear = linearise(film.ramp, film.response, film.interval, film.facts, LineariseParams())

    for result in (film.stack, film.response, film.ramp, film.interval, linear):
        document = encode(result, store)
        back = decode(document, type(result), store)
        assert content_hash(encode(back, store)) == content_hash(document)


def test_the_same_frames_give_the_same_results(film: Made) -> None:
    again = interval(film.ramp, film.response, film.facts, IntervalParams())

    assert again.chosen_gray == film.interval.chosen_gray
    assert again.cost == film.interval.cost
