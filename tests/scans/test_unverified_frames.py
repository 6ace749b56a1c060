"""Frames that can't be verified are kept to be looked at, and count for nothing; verdicts stay with the frames."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.devices.errors import DeviceTimeout
from backend.devices.protocols import Frame
from backend.domain.errors import RigFailedError, StorageFullError
from backend.domain.patterns import BLACK, WHITE, Uniform
from backend.domain.shots import Exposed, Plan, Shot, Until
from backend.jobs import evidence, shooting
from backend.jobs.capture import CaptureSession
from backend.jobs.control import JobControl
from backend.jobs.evidence import ACTION, chosen
from backend.jobs.sequence_shooting import shooter_of
from backend.jobs.sync_sets import Planned
from backend.services.exporting import export_scan
from backend.storage.artifacts import LocalArtifactStore
from tests.scans.doubtful import always_from, frozen_from, late, once
from tests.scans.test_sync_checks import (
    FRINGES,
    PERIOD_MS,
    Bench,
    Restful,
    bench_of,
    burst,
    fringes,
)
from tests.scans.toy_house import House, stage


def drive(
    bench: Bench,
    plan: Plan[Any],
    keep: Callable[[str, Sequence[Mapping[str, Any]]], bool] = evidence.no_evidence,
) -> Any:
    with shooter_of(bench.rig, Restful(bench.rig)) as shooter:
        session = session_of(bench, shooter, keep)
        found = session.run_plan(plan)
        bench.checks = session.finish()
    return found


def session_of(bench: Bench, shooter: Any, keep: Any = evidence.no_evidence) -> CaptureSession:
    return CaptureSession(
        scan="s", stage="stage", take=1, facts=bench.rig.facts(), journal=bench.journal,
        store=bench.store, shooter=shooter, control=JobControl(), evidence=keep,
    )  # fmt: skip


def one_burst(shots: tuple[Shot, ...]) -> Plan[tuple[Exposed, ...]]:
    exposed = yield shots
    return exposed


# ---------------------------------------------------------------- evidence


def test_a_set_that_is_never_right_is_kept_beside_the_frames(store: LocalArtifactStore) -> None:
    told: list[tuple[str, Sequence[Mapping[str, Any]]]] = []

    def keep(reason: str, frames: Sequence[Mapping[str, Any]]) -> bool:
        told.append((reason, frames))
        return True

    shots = burst(fringes(4, (7.0, 8.0, 9.0)))
    with bench_of(store, always_from(11, late(1))) as bench:
        with pytest.raises(RigFailedError, match=r"kept \(and \d+ that count for nothing, to look"):
            drive(bench, one_burst(shots), keep)
        ((reason, frames),) = told
        assert "shows what was shown before" in reason or "doesn't show its pattern" in reason
        assert {frame["camera"] for frame in frames} == {"left", "right"}
        for frame in frames:
            assert store.get(frame["artifact"]).shape == (120, 160)
        kept = {row.artifact for row in bench.journal.rows.values()}
        numbers = {frame["number"] for frame in frames}
        assert kept.isdisjoint(frame["artifact"] for frame in frames)
        # A resume takes them again.
        bench.rig.projector.fault = lambda asked, count: asked[-1]
        bench.rig.projector.asked.clear()
        drive(bench, one_burst(shots))
        assert len(bench.rig.projector.asked) >= len(numbers)


@pytest.mark.parametrize(
    "hindrance", [StorageFullError("the disk is full"), OSError("input/output error")], ids=type
)
def test_evidence_that_cant_be_kept_hides_no_reason(
    hindrance: Exception, store: LocalArtifactStore
) -> None:
    def keep(reason: str, frames: Sequence[Mapping[str, Any]]) -> bool:
        raise hindrance

    with bench_of(store, late(1)) as bench, pytest.raises(RigFailedError) as caught:
        drive(bench, one_burst(FRINGES), keep)
    assert "the display" in caught.value.sentence
    assert "count for nothing" not in caught.value.sentence


def test_a_camera_that_gives_up_when_a_set_is_taken_again_loses_no_frame(
    store: LocalArtifactStore,
) -> None:
    told: list[tuple[str, Sequence[Mapping[str, Any]]]] = []

    def gives_up(frames: Sequence[Frame], count: int) -> Frame:
        if count > 2 * len(FRINGES):
            raise DeviceTimeout("left", "no frame came")
        return frames[-1]

    def keep(reason: str, frames: Sequence[Mapping[str, Any]]) -> bool:
        told.append((reason, frames))
        return True

    with bench_of(store, always_from(7, late(1))) as bench:
        bench.rig.spoil(gives_up, "left")
        with pytest.raises(RigFailedError, match=r"no frame came; .* that count for nothing"):
            drive(bench, one_burst(FRINGES), keep)
    ((reason, frames),) = told
    assert "no frame came" in reason
    assert {4, 5, 6, 7} <= {frame["number"] for frame in frames}


def exposures(count: int, size_px: int = 10) -> tuple[list[Planned], list[dict[str, Frame]]]:
    planned = [Planned(Shot(WHITE, 1.0), ("left",), n) for n in range(count)]
    gray = np.zeros((size_px, size_px), np.uint8)
    frame = Frame(gray, "Mono8", 8, 1, 1000.0, 0.0, None, 0.0)
    return planned, [{"left": frame} for _ in planned]


def test_what_is_kept_is_bounded_around_the_wrong_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    planned, frames = exposures(100)
    kept = [one.planned.number for one in chosen(planned, frames, 80)]
    assert len(kept) == evidence.MOST_FRAMES
    assert 80 in kept
    assert kept == sorted(n for n in kept if n is not None)
    monkeypatch.setattr(evidence, "MOST_BYTES", 350)
    assert [one.planned.number for one in chosen(planned, frames, 80)] == [79, 80, 81]
    monkeypatch.setattr(evidence, "MOST_BYTES", 1)
    assert [one.planned.number for one in chosen(planned, frames, 80)] == [80]
    assert chosen([], [], None) == []


def test_a_camera_that_gives_up_in_the_middle_of_a_set_loses_no_frame(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are in the log and in the export, and neither a resume nor an import takes them for frames of the scan."""
    monkeypatch.setattr(shooting, "STEADY_S", 0.0)
    state = house.create()
    for rig in house.rigs.opened:
        rig.projector.capabilities = replace(rig.projector.capabilities, certain=False)
    house.run(state.id, until="toy_levels")
    shots = house.rigs.opened[-1].shots
    house.rigs.faults.errors = {
        shots + n: [DeviceTimeout("left", "no frame came")] for n in range(5, 20)
    }
    state = house.run(state.id)
    assert state.job is not None
    assert "that count for nothing, to look at" in (state.job.error or "")
    context = house.services.context
    with context.database.reading() as repositories:
        lines = [row for row in repositories.audit.of(state.id) if row.action == ACTION]
        before = len(repositories.frames.of_scan(state.id))
    assert len(lines) == 1
    assert "only to be looked at: left: no frame came" in lines[0].sentence
    export_scan(context, state.id, tmp_path / "out", frames=True, who="ada")
    (failure,) = json.loads((tmp_path / "out" / "unverified.json").read_text())
    assert failure["stage"] == "toy_fringes"
    assert all((tmp_path / "out" / frame["file"]).is_file() for frame in failure["frames"])
    capture = json.loads((tmp_path / "out" / "capture.json").read_text())
    assert len(capture["frames"]) == before
    house.rigs.faults.errors = {}
    state = house.run(state.id)
    assert stage(state, "toy_fringes").status == "done"


# ---------------------------------------------------------------- verdicts


def test_what_was_found_of_frames_is_known_whenever_they_are_answered_from_the_journal(
    store: LocalArtifactStore,
) -> None:
    with bench_of(store) as bench:
        drive(bench, one_burst(FRINGES))
        then = bench.verdict
        replay = session_of(bench, None)
        replay.run_plan(one_burst(FRINGES))
        (now,) = replay.finish()
    assert now.name == then.name
    assert now.value == then.value
    assert "frames show what they were taken for: sets deviate" in now.sentence


def test_dark_frames_are_told_by_a_white_marker_also_from_the_journal(
    store: LocalArtifactStore,
) -> None:
    """Nothing is wrong with the light: it mustn't be said that there is too little of it."""
    dark_only = burst([BLACK])
    with bench_of(store) as bench:
        drive(bench, one_burst(dark_only))
        replay = session_of(bench, None)
        replay.run_plan(one_burst(dark_only))
        for check in (bench.verdict, *replay.finish()):
            assert "white markers are lit" in check.sentence
            assert "too little" not in check.sentence


def test_a_resume_tells_of_all_frames(store: LocalArtifactStore) -> None:
    shots = burst(fringes(4, (7.0, 8.0)))
    with bench_of(store) as bench:
        drive(bench, one_burst(shots[:4]))
        first = bench.verdict.value or 0.0
        drive(bench, one_burst(shots))
        assert (bench.verdict.value or 0.0) >= first


# ---------------------------------------------------------------- pictures that are waited for


def until(ready: Callable[[Exposed], bool], shot: Shot) -> Plan[Exposed]:
    (exposed,) = yield Until(shot, ready, timeout_s=5.0)
    return exposed


SHOT = Shot(Uniform(gray=160.0), 2 * PERIOD_MS, role="wait")


def test_a_picture_that_is_waited_for_is_verified(store: LocalArtifactStore) -> None:
    offered: list[float] = []

    def third(exposed: Exposed) -> bool:
        offered.append(float(exposed["left"].gray.mean()))
        return len(offered) == 3

    with bench_of(store) as bench:
        drive(bench, until(third, SHOT))
        assert len(offered) == 3
        assert len(bench.journal) == 2
        assert "markers are dark" in bench.verdict.sentence
        assert max(offered) - min(offered) < 1


def test_a_picture_of_a_display_that_lags_is_refused(store: LocalArtifactStore) -> None:
    with bench_of(store, late(1)) as bench, pytest.raises(RigFailedError, match="the display"):
        drive(bench, until(lambda exposed: True, SHOT))
    assert len(bench.journal) == 0


def test_a_picture_of_a_display_that_stood_still_for_a_moment_is_taken_again(
    store: LocalArtifactStore,
) -> None:
    with bench_of(store, once(1, frozen_from(0))) as bench:
        exposed = drive(bench, until(lambda exposed: True, SHOT))
        assert len(bench.journal) == 2
        assert 5 < exposed["left"].gray.mean() < 200
