"""Which code is projected, in which order, and what captured stripes have to be complete in."""

from dataclasses import replace

import numpy as np
import pytest

from backend.domain.errors import InvalidCaptureError, StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import Gray, Stripe
from backend.domain.rig import ProjectorFacts
from backend.numerics.line_shift import Stripes
from backend.stages.code_capture import (
    CodeCaptureParams,
    capture_plan,
    code_patterns,
    gray_patterns,
    stripe_patterns,
)
from backend.stages.code_frames import code_sets, import_code_frames
from backend.stages.intensity_mask import IntensityMask

PROJECTOR = ProjectorFacts(1024, 768)


def patterns(**settings):
    return code_patterns(PROJECTOR, CodeCaptureParams(**settings))


def test_every_pattern_stands_beside_its_inverse():
    found = patterns()
    assert len(found) == 50
    for pattern, inverse in zip(found[::2], found[1::2], strict=True):
        assert inverse == pattern.model_copy(update={"inverse": True})


@pytest.mark.parametrize(
    ("settings", "bits", "stripes"),
    [
        ({}, {"x": 8, "y": 9}, {"x": 8}),
        ({"rows": False}, {"x": 8}, {"x": 8}),
        ({"stripes": "none"}, {"x": 10, "y": 10}, {}),
        ({"stripes": "both"}, {"x": 8, "y": 8}, {"x": 8, "y": 8}),
        ({"stripe_period_px": 32, "stripe_step_px": 2}, {"x": 7, "y": 9}, {"x": 8}),
        ({"finest_column_px": 1, "finest_row_px": 4}, {"x": 10, "y": 8}, {"x": 8}),
    ],
    ids=["default", "columns only", "plain Gray code", "both shifted", "two-pixel steps", "finer bits"],
)  # fmt: skip
def test_settings_say_which_patterns(settings, bits, stripes):
    found = [p for p in patterns(**settings) if not getattr(p, "inverse", False)]
    gray = [p for p in found if isinstance(p, Gray)]
    assert {a: sum(p.axis == a for p in gray) for a in ("x", "y") if a in bits} == bits
    assert {p.axis: p.bits for p in gray} == bits
    shifted = [p for p in found if isinstance(p, Stripe)]
    assert {a: sum(p.axis == a for p in shifted) for a in stripes} == stripes
    assert len(shifted) == sum(stripes.values())


@pytest.mark.parametrize(
    ("period", "step", "way_out"), [(16, 3, "24 px"), (10, 2, "16 px"), (12, 2, "16 px")]
)
def test_stripes_that_cannot_be_shifted_are_refused_with_a_way_out(period, step, way_out):
    with pytest.raises(StageFailedError, match=f"period of {period} px .* e.g. {way_out}"):
        stripe_patterns("x", 1024, period, step)


def test_stripes_wider_than_the_projector_are_refused():
    with pytest.raises(StageFailedError, match="don't fit on a projector of 96 px"):
        stripe_patterns("y", 96, 128, 1)


def test_the_plan_is_one_burst_under_the_mask_for_the_cameras_asked_for():
    mask = IntensityMask(np.full((768, 1024), 0.5, np.float32))
    plan = capture_plan(patterns(), 25.0, 3.0, mask, ("left",))
    burst = next(plan)
    assert isinstance(burst, tuple)
    assert len(burst) == 50
    assert {(s.exposure_ms, s.gain_db, s.cameras, s.role) for s in burst} == {
        (25.0, 3.0, ("left",), "code")
    }
    assert all(s.mask is not None and s.mask.load() is mask.factor for s in burst)
    picture = InMemory(np.zeros((2, 2), np.uint8))
    with pytest.raises(StopIteration) as end:
        plan.send(tuple({"left": Frame("left", s.pattern, 25.0, picture)} for s in burst))
    assert end.value.value.frame_count == 50
    assert end.value.value.exposure_time_s == pytest.approx(50 * 0.025)


def frames_of(found):
    picture = InMemory(np.zeros((2, 2), np.uint8))
    return tuple(Frame("left", pattern, 20.0, picture) for pattern in found)


def stripe_of(frame: Frame) -> Stripe:
    assert isinstance(frame.pattern, Stripe)
    return frame.pattern


def test_captured_stripes_are_sorted_by_position():
    found = frames_of(patterns())
    columns, rows = code_sets(tuple(reversed(found)))
    assert rows.stripes is None
    assert columns.stripes is not None
    assert columns.stripes.stripes(1024) == Stripes(0.0, 1.0, 8)
    shifts = [stripe_of(f).shift_periods for f in columns.stripes.patterns]
    assert shifts == sorted(shifts)
    assert all(stripe_of(f).inverse for f in columns.stripes.inverses)


def test_stripes_half_a_period_on_are_inverses():
    """A set shifted over a whole period, without inverses, holds both."""
    shifted = tuple(Stripe(periods=64, shift_periods=n / 16) for n in range(16))
    found = code_sets(frames_of((*gray_patterns("x", 1024, 4), *shifted)))[0].stripes
    assert found is not None
    assert found.stripes(1024) == Stripes(0.0, 1.0, 8)


def without(found, **where):
    return [
        p
        for p in found
        if not (isinstance(p, Stripe) and all(getattr(p, k) == v for k, v in where.items()))
    ]


ALL = patterns()


@pytest.mark.parametrize(
    ("incomplete", "words"),
    [
        (without(ALL, shift_periods=0.25, inverse=True), "no inverse .* at a shift of 0.25 periods"),
        (without(ALL, inverse=True), "capture each position with its inverse"),
        (without(ALL, shift_periods=0.25), "add the missing positions"),
        (without(without(without(ALL, shift_periods=0.0), shift_periods=0.0625), shift_periods=0.125), "add the missing positions"),
        ([p for p in ALL if isinstance(p, Stripe)] + [p for p in ALL if p.axis == "y"], "no Gray code beside them"),
        ([*ALL, Stripe(periods=64)], "more than once"),
        ([*ALL, Stripe(periods=60)], "different periods of the stripes"),
    ],
    ids=["one inverse", "all inverses", "one position", "the first positions", "Gray code", "twice", "periods"],
)  # fmt: skip
def test_incomplete_stripes_are_refused_in_one_sentence(incomplete, words):
    with pytest.raises(InvalidCaptureError, match=words) as refused:
        import_code_frames(frames_of(incomplete))
    assert refused.value.sentence.count(". ") == 0


def test_stripes_whose_edges_lie_within_pixels_are_refused():
    columns = code_sets(frames_of(ALL))[0]
    assert columns.stripes is not None
    odd = replace(columns.stripes, periods=60.0)
    with pytest.raises(InvalidCaptureError, match="edges within pixels of a projector of 1024 px"):
        odd.stripes(1024)
