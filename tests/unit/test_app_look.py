"""What is on the screen, and what the large button does about it."""

from collections.abc import Mapping
from typing import Any

import pytest

from app.look import Look
from app.panels.decision import buttons
from backend.contract.descriptions import MethodDescription, StageDescription
from backend.contract.scans import JobView, ScanState, SettingView, StageState

NAMES = ("first", "second", "third")


def look(
    *statuses: str,
    at: str | None = None,
    drafts: Mapping[str, Any] | None = None,
    running: bool = False,
) -> Look:
    """Make a scan of three stages in these states; the first one captures."""
    stages = tuple(_stage(name, status) for name, status in zip(NAMES, statuses, strict=True))
    job = None
    if running:
        stage = next(n for n, s in zip(NAMES, statuses, strict=True) if s == "running")
        job = JobView.model_validate(
            {"id": "j", "status": "running", "stage": stage, "progress": 0.4, "text": "Frame 3", "remaining_s": 9.0, "error": None, "who": "Bo"}
        )  # fmt: skip
    scan = ScanState.model_validate(
        {
            "id": "1", "name": "n", "note": "", "method": "m", "rig": "r", "rig_options": {}, "created": "2026-01-01T00:00:00Z",
            "who": "Bo", "revision": 0, "preset": None, "status": "idle", "stages": stages, "job": job, "undo": None,
        }
    )  # fmt: skip
    found = Look(scan, _method(), pinned=at, may_operate=True)
    for name, value in (drafts or {}).items():
        found = found.with_draft(name, value)
    return found


def _stage(name: str, status: str) -> StageState:
    finished = status in ("done", "accepted", "awaiting_review", "rejected", "failed")
    return StageState.model_validate(
        {
            "name": name, "title": name.title(), "status": status, "message": f"{name} says so", "key": name,
            "stage_run": f"run of {name}" if finished else None, "take": 1,
            "settings": {"x": SettingView(value=1.0, source="default"), "y": SettingView(value=[1.0, 2.0], source="default")},
        }
    )  # fmt: skip


def _method() -> MethodDescription:
    stages = tuple(
        StageDescription.model_validate(
            {
                "name": n,
                "title": n,
                "doc": "",
                "version": 1,
                "review": "always",
                "captures": n == "first",
                "inputs": (),
                "output": "X",
                "settings": {},
                "shown": (),
            }
        )
        for n in NAMES
    )
    return MethodDescription(name="m", title="M", doc="", stages=stages, given=(), presets={})


@pytest.mark.parametrize(
    ("statuses", "active"),
    [
        (("pending", "pending", "pending"), "first"),
        (("done", "pending", "pending"), "second"),
        (("done", "awaiting_review", "pending"), "second"),
        (("done", "running", "pending"), "second"),
        (("accepted", "done", "done"), "third"),
        (("done", "failed", "pending"), "second"),
        (("given", "unavailable", "unavailable"), "first"),
    ],
)
def test_the_screen_follows_what_happens(statuses: tuple[str, ...], active: str) -> None:
    assert look(*statuses, running="running" in statuses).stage.name == active


def test_a_stage_that_was_chosen_stays_on_the_screen() -> None:
    assert look("done", "awaiting_review", "pending", at="first").stage.name == "first"


@pytest.mark.parametrize(
    ("statuses", "at", "label", "do"),
    [
        (("pending", "pending", "pending"), None, "Run", "run"),
        (("done", "awaiting_review", "pending"), None, "Accept", "accept"),
        (("done", "done", "awaiting_review"), None, "Accept result", "accept"),
        (("done", "awaiting_review", "pending"), "first", "Go to Second", "select"),
        (("done", "done", "pending"), "second", "Accept and continue", "accept"),
        (("accepted", "pending", "pending"), "first", "Continue", "run"),
        (("accepted", "accepted", "accepted"), None, "Export …", "export"),
        (("done", "done", "done"), None, "Accept result", "accept"),
        (("done", "failed", "pending"), None, "Run again", "run"),
        (("done", "rejected", "pending"), None, "Accept after all", "accept"),
        (("unavailable", "unavailable", "unavailable"), None, "Not available", "nothing"),
        (("given", "done", "unavailable"), "second", "Accept result", "accept"),
    ],
)  # fmt: skip
def test_the_large_button(statuses: tuple[str, ...], at: str | None, label: str, do: str) -> None:
    primary = buttons(look(*statuses, at=at)).primary

    assert (primary.label, primary.do) == (label, do)


def test_while_a_job_runs_only_cancel_is_left() -> None:
    shown = buttons(look("done", "running", "pending", running=True))

    assert not shown.primary.enabled
    assert not shown.override.enabled
    assert not shown.redo.enabled
    assert (shown.stop.label, shown.stop_cancels) == ("Cancel", True)


def test_from_another_stage_the_button_leads_to_the_running_one() -> None:
    shown = buttons(look("done", "running", "pending", running=True, at="first"))

    assert (shown.primary.label, shown.primary.do) == ("Show Second, running", "follow")


def test_only_a_stage_that_captured_can_be_redone() -> None:
    assert buttons(look("done", "done", "done", at="first")).redo.enabled
    assert not buttons(look("done", "done", "done", at="second")).redo.enabled
    assert not buttons(look("pending", "pending", "pending", at="first")).redo.enabled


def test_a_draft_can_be_applied() -> None:
    assert not buttons(look("done", "awaiting_review", "pending")).override.enabled

    shown = buttons(look("done", "awaiting_review", "pending", drafts={"x": 2.0, "y": [1, 3]}))

    assert (shown.override.label, shown.override.enabled) == ("Apply 2", True)


def test_a_draft_that_changes_nothing_is_none() -> None:
    drafted = look("done", "awaiting_review", "pending", drafts={"x": 2.0, "y": (1.0, 2.0)})

    assert dict(drafted.draft) == {"x": 2.0}
    assert dict(drafted.with_draft("x", 1.0).draft) == {}


def test_a_newer_state_forgets_drafts_that_it_contains() -> None:
    drafted = look("done", "awaiting_review", "pending", drafts={"x": 2.0, "y": [1, 5]})
    newer = [
        s.model_copy(
            update={"settings": {**s.settings, "x": SettingView(value=2.0, source="edited")}}
        )
        for s in drafted.scan.stages
    ]

    after = drafted.with_scan(drafted.scan.model_copy(update={"stages": tuple(newer)}))

    assert dict(after.draft) == {"y": [1, 5]}


def test_stages_are_walked_back_from_the_one_on_the_screen() -> None:
    names = [s.name for s in look("done", "awaiting_review", "pending").upto_stage()]

    assert names == ["second", "first"]
