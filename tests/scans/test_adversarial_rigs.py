"""Displays and cameras that try to spoil a scan: each is refused with the right sentence, or changes nothing."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from backend.devices.protocols import Frame
from backend.domain.errors import RigFailedError
from backend.domain.patterns import Uniform
from backend.domain.shots import Exposed, Shot
from backend.domain.states import Level
from backend.jobs.shooting import is_off_grid
from backend.storage.artifacts import LocalArtifactStore
from tests.scans.doubtful import (
    CameraFault,
    Fault,
    always_from,
    at_random,
    brighter,
    covered,
    dark,
    every,
    frozen_from,
    lamp,
    late,
    moved,
    right,
    rolling,
    stale,
    through,
)
from tests.scans.test_sync_checks import CODE, METHODS, bench_of, burst, fringes

SETS = burst(fringes(5, (7.0, 8.0, 9.0)))
PAIRS = burst(CODE, role="code")
GRAYS = burst([Uniform(gray=g) for g in (64, 96, 128, 160, 192, 224)], role="field")
SHORT = tuple(replace(shot, exposure_ms=5.0) for shot in burst(fringes(8)))
SINGLE_FRINGE = tuple(shot for n in (1, 2, 30) for shot in burst(fringes(4, (19.0,)), n))

DISPLAY = "the display is late, torn or not lit"
STILL = "white isn't brighter than black any more"
LIGHT = "the light changes from frame to frame"
CAMERA = "the other cameras saw what was shown at the same time"
GRID = (
    r"5 ms is no multiple of the projector's refresh period of 8\.333 ms.*expose for whole periods"
)
NAMED = r"(frame \d+ of \d+ \(.*\)|the (white|black) (marker|field)|the marker)"


def same(frames: Sequence[Frame], count: int) -> Frame:
    return frames[-1]


@dataclass(frozen=True)
class Case:
    name: str
    words: str
    """Of the refusal."""
    display: Fault = right
    camera: CameraFault = same
    cameras: tuple[str, ...] = ()
    shots: tuple[Shot, ...] = SETS


def flicker(most_gray: float) -> CameraFault:
    return lamp(lambda count: float(np.random.default_rng(count).uniform(0, most_gray)))


REFUSED = [
    Case("late by one at random", DISPLAY, at_random(0.4, late(1)), shots=PAIRS),
    Case("late by two", f"{DISPLAY}|{STILL}", late(2)),
    Case("late by one from the middle on", DISPLAY, always_from(12, late(1))),
    Case("late, single fringe", DISPLAY, always_from(7, late(1)), shots=SINGLE_FRINGE),
    Case("frozen from the middle on", f"{DISPLAY}|{STILL}", frozen_from(11)),
    Case("frozen, code", f"{DISPLAY}|{STILL}", frozen_from(11), shots=PAIRS),
    Case("frozen, gray fields", f"{DISPLAY}|{STILL}", frozen_from(7), shots=GRAYS),
    Case("a rolling tear", DISPLAY, rolling),
    Case("a rolling tear, code", DISPLAY, rolling, shots=PAIRS),
    Case("drops every sixth", DISPLAY, every(6, late(1))),
    Case("goes dark", f"{DISPLAY}|{STILL}", always_from(11, dark)),
    Case("gray fields late", DISPLAY, always_from(6, late(1)), shots=GRAYS),
    Case("room's light flickers", f"{LIGHT}|room's light", camera=flicker(40.0)),
    Case(
        "room's light flickers, code", f"{LIGHT}|room's light", camera=flicker(120.0), shots=PAIRS
    ),
    Case("frames from before the trigger", CAMERA, camera=stale, cameras=("right",)),
    Case("cap on a lens in mid-scan", f"{CAMERA}|{STILL}", camera=covered(9), cameras=("right",)),
    Case("cap on both", STILL, camera=covered(9)),
    Case("exposed for a part of a frame", f"{GRID}.*{DISPLAY}", shots=SHORT),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.name)
def test_what_spoils_a_scan_is_refused_with_the_frame_and_the_reason(
    case: Case, store: LocalArtifactStore
) -> None:
    with bench_of(store, case.display) as bench:
        bench.rig.spoil(case.camera, *case.cameras)
        with pytest.raises(RigFailedError) as caught:
            bench.capture(case.shots)
    sentence = caught.value.sentence
    assert re.search(case.words, sentence), sentence
    assert re.search(NAMED, sentence), sentence
    assert "\n" not in sentence
    if LIGHT not in case.words:
        assert LIGHT not in sentence
    if GRID not in case.words:
        assert "refresh period" not in sentence


@pytest.mark.parametrize(
    ("exposure_ms", "off"),
    [(1.0, True), (10.0, True), (25.0, True), (16.683, False), (50.0, False), (66.7, False), (1001.0, False)],
)  # fmt: skip
def test_an_exposure_is_off_the_grid_if_it_sees_much_of_a_frame_that_it_doesnt_see_whole(
    exposure_ms: float, off: bool
) -> None:
    assert is_off_grid(exposure_ms, 1000 / 60) is off


def shift_ids(frames: Sequence[Frame], count: int) -> Frame:
    """Count one frame twice."""
    last = frames[-1]
    return replace(last, frame_id=frames[-2].frame_id) if count == 7 else last


def jump(frames: Sequence[Frame], count: int) -> Frame:
    """Let the camera's clock be set in mid-scan."""
    return replace(frames[-1], timestamp_s=count + (1e6 if count > 7 else 0.0))


HARMLESS = [
    Case("a display with a curve of its own", "", through(lambda g: 255 * (g / 255) ** 1.8)),
    Case("drops now and then", "", every(17, late(1))),
    Case("one dark picture", "", lambda a, n: dark(a, n) if n == 9 else a[-1]),
    Case("a frame's number comes twice", "", camera=shift_ids, cameras=("left",)),
    Case("a camera's clock jumps", "", camera=jump),
]


@pytest.mark.parametrize("case", HARMLESS, ids=lambda case: case.name)
def test_what_passes_leaves_the_frames_as_they_are(case: Case, store: LocalArtifactStore) -> None:
    with bench_of(store, case.display) as bench:
        bench.rig.spoil(case.camera, *case.cameras)
        frames = bench.capture(case.shots)
        assert {c.level for c in bench.checks} == {Level.OK}, bench.checks
    steady = case.display if case.name.startswith("a display") else right
    with bench_of(store, steady) as bench:
        expected = bench.capture(case.shots)
    assert difference(frames, expected) < 5


def difference(frames: Sequence[Exposed], expected: Sequence[Exposed]) -> float:
    """Return by how much the most different frame deviates, on average over its pixels."""
    return max(
        float(np.abs(one[c].gray.astype(float) - other[c].gray).mean())
        for one, other in zip(frames, expected, strict=True)
        for c in one
    )


@dataclass(frozen=True)
class Warned:
    name: str
    check: str
    words: str
    camera: CameraFault
    shots: tuple[Shot, ...] = SETS


WARNED = [
    Warned("a lamp is switched on", "drift", "the room's light has changed", lamp(lambda n: 25.0 * (n > 11))),
    Warned(
        "a bright lamp is switched on", "drift", "the room's light has changed", lamp(lambda n: 70.0 * (n > 11)),
    ),
    Warned("a lamp is switched on, code", "drift", "room's light", lamp(lambda n: 25.0 * (n > 11)), PAIRS),
    Warned("automatic exposure", "drift", "the camera doesn't set its exposure itself", brighter(0.006)),
    Warned("a camera moves", "stillness", "has moved by .* px in camera", moved(13, 1)),
    Warned("a camera moves far", "stillness", "has moved by .* px in camera", moved(13, 4)),
]  # fmt: skip


@pytest.mark.parametrize("case", WARNED, ids=lambda case: case.name)
def test_what_changes_slowly_or_once_is_a_warning_with_its_cause(
    case: Warned, store: LocalArtifactStore
) -> None:
    with bench_of(store) as bench:
        bench.rig.spoil(case.camera)
        bench.capture(case.shots)
    check = next(c for c in bench.checks if c.name == case.check)
    assert check.level is Level.WARNING, bench.checks
    assert re.search(case.words, check.sentence)


@pytest.mark.parametrize(
    ("camera", "words"),
    [(covered(0), "too little of the projector's light"), (covered(0, 300.0), "is saturated")],
    ids=["cap on", "saturated all over"],
)
def test_a_camera_that_cant_tell_is_named(
    camera: CameraFault, words: str, store: LocalArtifactStore
) -> None:
    with bench_of(store) as bench:
        bench.rig.spoil(camera, "right")
        bench.capture(SETS)
        assert re.search(f"camera right .*{words}", bench.verdict.sentence)
    with bench_of(store) as bench:
        bench.rig.spoil(camera)
        bench.capture(SETS)
        assert words in bench.verdict.sentence


def test_a_display_that_never_changed_has_nothing_that_looks_valid(
    store: LocalArtifactStore,
) -> None:
    """Frozen from the first picture on, nothing is seen of any pattern: there is nothing to decode."""
    with bench_of(store, frozen_from(0)) as bench:
        frames = bench.capture(SETS)
        assert "too little of the projector's light" in bench.verdict.sentence
    first = frames[0]["left"].gray.astype(float)
    assert max(np.abs(f["left"].gray - first).mean() for f in frames) < 3


def test_long_exposures_have_fields_of_their_own(store: LocalArtifactStore) -> None:
    """A hundred times the first exposure: a late display would pass for a black level that nobody knows."""
    short, long = burst(fringes(4), 1), burst(fringes(4), 100)
    options: dict[str, Any] = {"white_e_per_ms": 20.0, "black_level_gray": 16.0}
    with bench_of(store, **options) as bench:
        bench.capture(short, long)
        assert "again" not in bench.verdict.sentence
        asked = bench.rig.projector.asked
        fields = [n for n, p in enumerate(asked) if p.min() == 255]
        assert len(fields) == 3, "before the short, before the long, at the end"
    with bench_of(store, always_from(11, late(1)), **options) as bench:
        with pytest.raises(RigFailedError, match=f"{DISPLAY}|{STILL}|darker than the black"):
            bench.capture(short, long)


def test_methods_cost_no_more_fields_than_exposures_need(store: LocalArtifactStore) -> None:
    with bench_of(store) as bench:
        for method in ("four steps", "exposures", "Gray code and stripes"):
            bench.rig.projector.asked.clear()
            bench.capture(*METHODS[method], stage=method)
            shots = sum(len(one) for one in METHODS[method])
            assert len(bench.rig.projector.asked) == shots + 4, method
