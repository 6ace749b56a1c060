"""Frames that don't show what they were taken for are named, taken again or refused; those that do never are."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from backend.domain.checks import Check
from backend.domain.errors import RigFailedError
from backend.domain.frames import InMemory
from backend.domain.patterns import BLACK, WHITE, Pattern, Sine, Uniform, gray_code
from backend.domain.shots import Exposed, Plan, Shot
from backend.domain.states import Level
from backend.jobs.capture import CaptureSession
from backend.jobs.control import JobControl
from backend.jobs.sequence_shooting import shooter_of
from backend.stages.code_capture import CodeCaptureParams, code_patterns, stripe_patterns
from backend.storage.artifacts import LocalArtifactStore
from tests.scans.doubtful import (
    DoubtfulRig,
    Fault,
    always_from,
    dark,
    fading,
    late,
    mixed,
    once,
    right,
    torn,
)
from tests.scans.test_capture import MemoryJournal

SMALL: dict[str, Any] = {"scene": "plane", "size": "160x120", "projector_size": "320x200"}
PERIOD_MS = 1000 / 120

WITNESSES = 2
"""White and black before the first burst."""


class Restful(JobControl):
    """Doesn't wait for a display to come to rest, but tells it to."""

    def __init__(self, rig: DoubtfulRig) -> None:
        super().__init__()
        self._rig = rig

    def pause(self, seconds: float) -> None:
        self.check()
        rest = getattr(self._rig.projector, "rest", None)
        if rest is not None:
            rest()


class Bench:
    """Captures one burst after the other on a doubtful rig, as a stage would."""

    def __init__(self, rig: DoubtfulRig, store: LocalArtifactStore) -> None:
        self.rig, self.store, self.journal = rig, store, MemoryJournal()
        self.checks: tuple[Check, ...] = ()

    def capture(self, *bursts: tuple[Shot, ...], stage: str = "stage") -> list[Exposed]:
        with shooter_of(self.rig, Restful(self.rig)) as shooter:
            session = CaptureSession(
                scan="s", stage=stage, take=1, facts=self.rig.facts(), journal=self.journal,
                store=self.store, shooter=shooter,
            )  # fmt: skip
            found = session.run_plan(_plan(bursts))
            self.checks = session.finish()
        return found

    @property
    def verdict(self) -> Check:
        return next(check for check in self.checks if check.name == "synchronisation")

    @property
    def drift(self) -> Check:
        return next(check for check in self.checks if check.name == "drift")


def _plan(bursts: tuple[tuple[Shot, ...], ...]) -> Plan[list[Exposed]]:
    found: list[Exposed] = []
    for burst in bursts:
        found += yield burst
    return found


@contextmanager
def bench_of(store: LocalArtifactStore, fault: Fault = right, **options: Any) -> Iterator[Bench]:
    with DoubtfulRig(fault, **{**SMALL, **options}) as rig:
        yield Bench(rig, store)


def fringes(
    steps: int = 4, periods: tuple[float, ...] = (7.0, 8.0), axis: Any = "x"
) -> list[Pattern]:
    return [
        Sine(axis=axis, periods=p, shift_rad=2 * np.pi * k / steps, low_gray=40.0, high_gray=220.0)
        for p in periods
        for k in range(steps)
    ]


def burst(
    patterns: list[Pattern], periods: int = 2, role: str = "fringe", **more: Any
) -> tuple[Shot, ...]:
    return tuple(Shot(p, periods * PERIOD_MS, role=role, **more) for p in patterns)


CODE: list[Pattern] = [*gray_code("x", 64), *stripe_patterns("x", 320, 16, 2)]
FRINGES = burst(fringes())


# ---------------------------------------------------------------- nothing is wrong


def _methods() -> dict[str, tuple[tuple[Shot, ...], ...]]:
    projector = DoubtfulRig(**SMALL).facts().projector
    assert projector is not None
    mask = InMemory(np.linspace(0.1, 1.0, 320 * 200).reshape(200, 320).astype(np.float32))
    ladder = tuple(
        shot for n in (1, 2, 8, 30) for shot in burst(fringes(4, (19.0, 20.0)), n)
    )  # fmt: skip
    return {
        "three steps": (burst(fringes(3)),),
        "three steps of one frequency": (burst(fringes(3, (8.0,))),),
        "four steps": (FRINGES,),
        "eight steps": (burst(fringes(8)),),
        "twelve steps, rows": (burst(fringes(12, axis="y")),),
        "coarse fringes": (burst(fringes(4, (0.9, 4.0))),),
        "three coarse steps": (burst(fringes(3, (0.5, 1.0))),),
        "exposures": (ladder,),
        "short and long": (burst(fringes(4, (17.0, 18.0)), 1), burst(fringes(4, (17.0, 18.0)), 100)),
        "under a mask": (burst(fringes(4), mask=mask), burst(CODE, mask=mask)),
        "Gray code and stripes": (burst(list(code_patterns(projector, CodeCaptureParams()))),),
        "one pair": (burst(list(gray_code("x", 2))),),
        "search for an exposure": (
            *(burst([WHITE], n) for n in (7, 60, 14, 3, 1)), burst([BLACK], 3),
        ),
        "fields": (burst([Uniform(gray=g) for g in (64, 128, 192, 255)]), burst([Uniform(gray=g) for g in (8, 32)])),
        "ramp": (burst([Uniform(gray=float(g)) for g in range(0, 256, 32) for _ in range(2)]),),
        "one camera after the other": (
            burst(fringes(4), cameras=("left",)), burst(fringes(4), cameras=("right",)), FRINGES,
        ),
        "dark only": (burst([BLACK]),),
        "with gain": (burst(fringes(4), gain_db=12.0), burst([WHITE, BLACK], gain_db=6.0)),
    }  # fmt: skip


METHODS = _methods()
SCENES: dict[str, dict[str, Any]] = {
    "plane": {},
    "metal": {"scene": "metal"},
    "high contrast": {"scene": "high-contrast"},
    "workpieces": {"scene": "workpieces"},
    "gamma not known": {"gamma": 2.2},
    "hardly any light": {"white_e_per_ms": 3.0},
    "little light": {"scene": "metal", "white_e_per_ms": 25.0},
    "saturated all over": {"scene": "metal", "white_e_per_ms": 20_000.0},
    "bright room": {"ambient_e_per_ms": 100.0},
    "12 bit, noisy": {"bit_depth": 12, "read_noise_e": 60.0},
    "poor contrast": {"contrast_ratio": 15.0},
    "blur and glare": {"projector_blur_px": 3.0, "glare_share": 0.1},
    "dark reads 0": {"black_level_gray": 0.0, "read_noise_e": 3.0, "ambient_e_per_ms": 3.0},
    "dark reads 0, hardly any light": {
        "black_level_gray": 0.0,
        "read_noise_e": 3.0,
        "ambient_e_per_ms": 0.0,
        "white_e_per_ms": 1.0,
    },
}


@pytest.mark.parametrize("method", METHODS)
def test_no_false_alarm_whatever_is_captured(method: str, store: LocalArtifactStore) -> None:
    with bench_of(store) as bench:
        bench.capture(*METHODS[method])
        assert bench.verdict.level is Level.OK
        assert "again" not in bench.verdict.sentence
        assert all(check.level is Level.OK for check in bench.checks), bench.checks


@pytest.mark.parametrize("scene", SCENES)
def test_no_false_alarm_whatever_is_seen(scene: str, store: LocalArtifactStore) -> None:
    with bench_of(store, **SCENES[scene]) as bench:
        for method in (
            "three steps",
            "exposures",
            "short and long",
            "under a mask",
            "search for an exposure",
            "ramp",
        ):
            bench.capture(*METHODS[method], stage=method)
            assert all(check.level is Level.OK for check in bench.checks), (method, bench.checks)
            assert "again" not in bench.verdict.sentence
            assert bench.verdict.value is None or bench.verdict.value < 0.05


def test_a_certain_display_is_not_looked_at(store: LocalArtifactStore) -> None:
    with bench_of(store) as bench:
        bench.rig.projector = bench.rig._rig.projector
        bench.capture(FRINGES)
        assert bench.checks == ()


def test_what_it_costs(store: LocalArtifactStore) -> None:
    """A marker in every burst; white and black before the first, white after the last."""
    with bench_of(store) as bench:
        bench.capture(FRINGES, burst(CODE), burst([WHITE]))
        shots = len(FRINGES) + len(CODE) + 1
        assert bench.rig.projector.asked[0].min() == 255
        assert len(bench.rig.projector.asked) == shots + 3 + WITNESSES + 1
        assert len(bench.journal) == 2 * shots, "none of them is a frame of the scan"
        assert "sets deviate by 0." in bench.verdict.sentence
        assert "markers are dark (0.0%" in bench.verdict.sentence


def test_the_marker_is_where_nobody_expects_it_and_there_again_after_a_crash(
    store: LocalArtifactStore,
) -> None:
    def places(stage: str) -> list[int]:
        with bench_of(store) as bench:
            bench.capture(FRINGES, FRINGES, FRINGES, stage=stage)
            shown = bench.rig.projector.asked[WITNESSES:]
            return [n for n, picture in enumerate(shown) if picture.max() == 0]

    assert places("one") == places("one")
    assert len({tuple(places(stage)) for stage in ("one", "two", "three", "four")}) > 1


# ---------------------------------------------------------------- something is wrong


PERSISTENT: dict[str, tuple[Fault, str]] = {
    "one pattern late": (late(1), "."),
    "two patterns late": (late(2), "."),
    "a fifth of each exposure late": (mixed(0.2), "black marker"),
    "torn": (torn, "."),
    "late from the tenth picture on": (
        always_from(9, late(1)),
        "shows what was shown before|doesn't show its pattern",
    ),
    "torn from the tenth picture on": (always_from(9, torn), "fringe frame|code frame"),
}
WHAT: dict[str, tuple[Shot, ...]] = {
    "four steps": burst(fringes(4, (7.0, 8.0, 9.0, 10.0))),
    "three steps": burst(fringes(3, (7.0, 8.0, 9.0, 10.0, 11.0))),
    "twelve steps": burst(fringes(12)),
    "code": burst(CODE, role="code"),
}


@pytest.mark.parametrize("what", WHAT)
@pytest.mark.parametrize("fault", PERSISTENT)
def test_a_display_that_is_never_right_is_refused_with_a_sentence(
    fault: str, what: str, store: LocalArtifactStore
) -> None:
    wrong, pattern = PERSISTENT[fault]
    rests = fault.startswith("a fifth")
    with bench_of(store, wrong, comes_to_rest=rests) as bench:
        with pytest.raises(RigFailedError, match=pattern) as caught:
            bench.capture(WHAT[what])
    sentence = caught.value.sentence
    assert sentence.startswith(("left: ", "right: "))
    assert "right in 3 tries" in sentence
    assert re.search("the display (is late|stands still)", sentence)
    assert "the light changes from frame to frame" not in sentence
    assert "unglare rigs latency --rig doubtful" in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize("patterns", [1, 2, 3])
@pytest.mark.parametrize("method", ["search for an exposure", "fields", "ramp", "one pair"])
def test_a_lag_is_refused_where_no_set_tells(
    method: str, patterns: int, store: LocalArtifactStore
) -> None:
    with bench_of(store, late(patterns)) as bench, pytest.raises(RigFailedError):
        bench.capture(*METHODS[method])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (late(1), "shows what was shown before"),
        (torn, "shows what was shown before"),
        (dark, "doesn't show its pattern"),
    ],
    ids=["late", "torn", "dark"],
)
@pytest.mark.parametrize("steps", [4, 5, 8])
def test_one_wrong_frame_is_named_and_its_set_taken_again(
    wrong: Fault,
    words: str,
    steps: int,
    store: LocalArtifactStore,
    caplog: pytest.LogCaptureFixture,
) -> None:
    shots = burst(fringes(steps))
    # Behind the witnesses, the marker and the first set: the third frame of the second one.
    place = WITNESSES + 1 + steps + 2
    with bench_of(store, once(place, wrong)) as bench:
        frames = bench.capture(shots)
        assert "1 times frames were wrong and taken again" in bench.verdict.sentence
        again = bench.rig.projector.asked
        assert len(again) > len(shots) + 4
    name = f"camera left: fringe frame {steps + 3} of {2 * steps} (8 periods along x at"
    assert name in caplog.text
    assert words in caplog.text
    with bench_of(store) as bench:
        expected = bench.capture(shots)
    for one, other in zip(frames, expected, strict=True):
        deviation = one["left"].gray.astype(float) - other["left"].gray
        assert np.abs(deviation).mean() < 5, "what is kept is right"


def test_frames_that_were_refused_never_count(store: LocalArtifactStore) -> None:
    """Sets that passed are kept; a resume takes the rest, and only that."""
    shots = burst(fringes(4, (7.0, 8.0, 9.0, 10.0)))
    with bench_of(store, always_from(WITNESSES + 1 + 8, late(1))) as bench:
        with pytest.raises(RigFailedError, match="captured frames are kept"):
            bench.capture(shots)
        kept = len(bench.journal)
        assert 16 >= kept >= 8
        assert kept % 8 == 0, "whole sets of two cameras"
        bench.rig.projector.fault = right
        bench.rig.projector.asked.clear()
        bench.capture(shots)
        assert len(bench.journal) == 32
        assert len(bench.rig.projector.asked) == 16 - kept // 2 + WITNESSES + 2


def test_a_fading_lamp_is_a_warning(store: LocalArtifactStore) -> None:
    with bench_of(store, fading(0.004)) as bench:
        bench.capture(FRINGES)
        assert bench.drift.level is Level.WARNING
        assert "let the lamp warm up" in bench.drift.sentence
        assert bench.drift.value == pytest.approx(0.044, abs=0.015)


def test_a_camera_that_sees_nothing_is_nobodys_lag(store: LocalArtifactStore) -> None:
    with bench_of(store, white_e_per_ms=1e-3, ambient_e_per_ms=0.01) as bench:
        bench.capture(FRINGES)
        assert "too little of the projector's light" in bench.verdict.sentence
        assert bench.verdict.level is Level.OK
