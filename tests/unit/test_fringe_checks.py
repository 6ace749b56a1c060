"""Defective frames among captured fringes: found and named, whichever it is."""

import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import Sine, StaticPicture
from backend.services.sofast_capture import open_sofast
from backend.stages.fringe_checks import defective_frames, ramp_verdict, set_closures
from backend.stages.reflect_capture import reflect_frames
from backend.stages.reflect_sets import axis_sets
from tests.sofast_files import write_npz


@lru_cache
def captured() -> tuple[Frame, ...]:
    with tempfile.TemporaryDirectory() as folder:
        opened = open_sofast(write_npz(Path(folder) / "f.npz"))
        return tuple(
            Frame("camera", frame.pattern, None, InMemory(gray))
            for frame, gray in opened.pictures()
        )


def on_mirror():
    return np.flatnonzero(captured()[-1].gray.astype(int) - captured()[-2].gray > 50)


def with_gray(number, gray):
    frames = list(captured())
    old = frames[number]
    frames[number] = Frame(old.camera, old.pattern, None, InMemory(gray))
    return frames


@pytest.mark.parametrize("frame", range(24))
@pytest.mark.parametrize("damage", ["dark", "dim", "frozen"])
def test_any_frame_may_be_defective(frame, damage):
    gray = [f.gray for f in captured()]
    other = gray[frame - 1 if frame % 4 else frame + 1]
    bad = {"dark": np.zeros_like(other), "dim": gray[frame] // 2, "frozen": other}[damage]
    sets = axis_sets(with_gray(frame, bad))
    chosen = on_mirror()
    found = defective_frames(sets, set_closures(sets, chosen, None), chosen, None)
    assert [f.number for f in found] == [frame]


def test_whole_frames_are_not_accused():
    sets = axis_sets(captured())
    closure = set_closures(sets, on_mirror(), None)
    assert max(closure.values()) < 0.02
    assert defective_frames(sets, closure, on_mirror(), None) == ()


def test_a_ramp_belongs_or_not():
    sets = axis_sets(captured())
    straight = ramp_verdict(sets[0], on_mirror(), np.linspace(-1, 1, 256))
    bent = ramp_verdict(sets[0], on_mirror(), np.linspace(0, 1, 256) ** 2.2)
    assert straight is not None
    assert bent is not None
    assert straight.belongs
    assert not bent.belongs
    assert straight.raw_error_percent == pytest.approx(straight.table_error_percent)


def test_sets_are_sorted_and_frames_counted_in_the_order_of_capture():
    along_x, along_y = axis_sets(captured())
    assert (along_x.axis, along_x.periods, along_y.periods) == (
        "x",
        (0.9, 3.9, 15.9),
        (0.9, 3.9, 15.9),
    )
    assert [s.number for s in along_y.sets[0].steps] == [0, 1, 2, 3]
    assert [s.number for s in along_x.sets[2].steps] == [20, 21, 22, 23]
    left = along_x.without(frozenset({21}))
    assert [s.number for s in left.sets[2].steps] == [20, 22, 23]


@pytest.mark.parametrize(
    ("keep", "words"),
    [
        (lambda n: n != 6, "3.9 periods of camera 'camera' along y lack 180 deg"),
        (lambda n: n % 4 < 2, "lack steps: 2 different shifts are there, 3 are needed"),
        (lambda n: n > 23, "holds no fringes"),
    ],
)  # fmt: skip
def test_missing_frames_are_named(keep, words):
    with pytest.raises(InvalidCaptureError, match=words):
        reflect_frames(tuple(f for n, f in enumerate(captured()) if keep(n)))


def test_frames_of_other_sizes_are_refused():
    small = with_gray(5, captured()[5].gray[:-1])
    with pytest.raises(InvalidCaptureError, match="differ in size"):
        axis_sets(small)


def test_repeated_steps_and_other_pictures_do_not_count():
    again = Frame("camera", captured()[0].pattern, None, captured()[0].pixels)
    frames = (*captured(), again, Frame("camera", StaticPicture(), None, captured()[0].pixels))
    one = axis_sets(frames)[1].sets[0]
    assert [len(one.steps), len(one.equal)] == [5, 4]
    assert isinstance(one.equal[0].frame.pattern, Sine)
