"""Captured fringes are sorted into complete sets, or refused with what is missing."""

from typing import Any

import numpy as np
import pytest

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import Gray, Sine, Uniform
from backend.stages.fringe_sets import fringe_sets


def pattern(frame: Frame) -> Any:
    return frame.pattern


PIXELS = InMemory(np.zeros((4, 6), np.uint8))


def sines(
    periods=(59, 64, 70), steps=4, exposures=(50.0,), camera="left", axis="x", sign=1
) -> list[Frame]:
    return [
        Frame(
            camera,
            Sine(axis=axis, periods=p, shift_rad=sign * 2 * np.pi * k / steps),
            exposure,
            PIXELS,
        )
        for exposure in exposures
        for p in periods
        for k in range(steps)
    ]


def test_frames_are_sorted_by_camera_axis_exposure_frequency_and_step():
    frames = sines(exposures=(400.0, 50.0)) + sines(camera="right", axis="y")
    rng = np.random.default_rng(1)
    shuffled = [frames[i] for i in rng.permutation(len(frames))]
    sets = {(s.camera, s.axis): s for s in fringe_sets(shuffled)}
    left = sets["left", "x"]
    assert set(sets) == {("left", "x"), ("right", "y")}
    assert left.exposures_ms == (50.0, 400.0)
    for exposed in left.exposures:
        found = [(pattern(f).periods, pattern(f).shift_rad) for f in exposed.sines]
        expected = [
            (p, s) for p, row in zip(left.periods, left.shifts_rad, strict=True) for s in row
        ]
        assert found == expected


def test_shifts_that_run_backwards_keep_their_sign():
    (found,) = fringe_sets(sines(sign=-1))
    assert found.shifts_rad[0] == pytest.approx((0, -np.pi / 2, -np.pi, -3 * np.pi / 2))


@pytest.mark.parametrize("first", [0, 1, 2])
def test_every_third_of_twelve_steps_is_a_four_step_set(first):
    (twelve,) = fringe_sets(sines(steps=12))
    four = twelve.subset(4, first)
    assert np.allclose(four.shifts_rad[1], 2 * np.pi * (np.arange(4) * 3 + first) / 12)
    shifts = [pattern(f).shift_rad for f in four.exposures[0].sines[4:8]]
    assert np.allclose(shifts, four.shifts_rad[1])


def test_steps_that_do_not_divide_are_refused():
    (twelve,) = fringe_sets(sines(steps=12))
    with pytest.raises(InvalidCaptureError, match="divisor"):
        twelve.subset(5)


def test_the_gray_code_comes_highest_bit_first_with_the_inverse_behind():
    grays = [
        Frame("left", Gray(bit=b, bits=2, codes=4, inverse=i), 50.0, PIXELS)
        for b in (0, 1)
        for i in (True, False)
    ]
    (found,) = fringe_sets(sines() + grays)
    order = [(pattern(f).bit, pattern(f).inverse) for f in found.exposures[0].grays]
    assert order == [(1, False), (1, True), (0, False), (0, True)]


def _without(frames: list[Frame], index: int) -> list[Frame]:
    return frames[:index] + frames[index + 1 :]


def _with_depth(frames: list[Frame], bits: int) -> list[Frame]:
    first = frames[0]
    return [Frame(first.camera, first.pattern, first.exposure_ms, PIXELS, bits), *frames[1:]]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (_without(sines(), 5), "64 periods is incomplete: shifts 0, 180, 270"),
        (
            sines(exposures=(50.0,)) + sines(exposures=(90.0,))[:-1],
            "90.0 ms, 70 periods is incomplete",
        ),
        (_with_depth(sines(), 12), "different bit depths"),
        ([Frame("left", Uniform(gray=255), 50.0, PIXELS)], "no fringes"),
        ([], "no fringes"),
    ],
)
def test_what_is_incomplete_is_refused_by_name(frames, words):
    with pytest.raises(InvalidCaptureError, match=words):
        fringe_sets(frames)


def test_frequencies_may_have_different_numbers_of_even_steps():
    (found,) = fringe_sets(sines((1,), 8) + sines((8,), 4))
    assert [len(s) for s in found.shifts_rad] == [8, 4]
