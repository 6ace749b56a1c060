"""Plans: where every stage stands, without a database."""

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from backend.domain.errors import StageUnavailableError
from backend.domain.hashing import document_hash
from backend.domain.method import Method
from backend.domain.states import Level, Review, Verdict
from backend.jobs.edits import fresh_take, last_group, present_takes, resolve_settings, standing
from backend.jobs.plan import Gate, History, Run, ScanPlan, gate_holds, next_step, plan_scan
from backend.storage.rows import DecisionRow, EditKind, EditRow, GivenRow, RunRow, RunStatus
from tests.scans.toy import TOY, toy_fringes, toy_levels, toy_look, toy_phase

NOW = datetime(2026, 1, 1, tzinfo=UTC)
RIG = {name: GivenRow(name, name, {}, f"hash of {name}") for name in ("RigFacts", "RigCalibration")}


class Past:
    """Runs and decisions of a scan, by key."""

    def __init__(self) -> None:
        self.runs: dict[str, RunRow] = {}
        self.decisions: dict[str, DecisionRow] = {}

    def finish(self, key: str, result: str, *, level: Level = Level.OK) -> None:
        checks = [{"level": level.value, "sentence": "so", "name": "n"}]
        self.runs[key] = RunRow(
            id=key[:8], scan="s", stage="", key=key, take=0, status=RunStatus.FINISHED, started=NOW, hash=result, checks=checks,
        )  # fmt: skip

    def decide(self, key: str, verdict: Verdict) -> None:
        self.decisions[key] = DecisionRow(1, "s", "r", "", key, verdict, "", "ada", NOW)


def plan(past: Past | None = None, *, method: Method = TOY, **options: Any) -> ScanPlan:
    past = past or Past()
    edits = options.pop("edits", [])
    recipe = options.pop("recipe", {})
    return plan_scan(
        options.pop("scan", "s"),
        method,
        settings=resolve_settings(method, preset=None, recipe=recipe, edits=edits),
        takes=present_takes(method, edits),
        given=options.pop("given", RIG),
        history=History(past.runs.get, past.decisions.get),
        **options,
    )


def walk(past: Past, **options: Any) -> list[str]:
    """Run what has to run; every stage's result is named after its key. Return the stages in order."""
    ran = []
    while isinstance(step := next_step(plan(past, **options), until=None, unattended=True), Run):
        assert step.planned.key
        ran.append(step.planned.name.removeprefix("toy_"))
        past.finish(step.planned.key, f"result of {step.planned.key}")
    return ran


def keys(past: Past, **options: Any) -> dict[str, str | None]:
    return {p.name.removeprefix("toy_"): p.key for p in plan(past, **options).stages}


def edit(revision: int, stage: str, field: str, new: Any, **changes: Any) -> EditRow:
    row = EditRow(
        "s",
        stage,
        field,
        None,
        new,
        EditKind.SET,
        f"g{revision}",
        "",
        "ada",
        NOW,
        revision=revision,
    )
    return replace(row, **changes)


ALL = ["look", "levels", "fringes", "phase", "cloud"]


def test_everything_runs_once() -> None:
    past = Past()
    assert walk(past) == ALL
    assert walk(past) == []


def test_a_key_is_the_hash_of_what_the_architecture_says() -> None:
    key = plan().stage("toy_look").key
    assert key == document_hash(
        [
            "toy_look",
            1,
            {"exposure_ms": None, "wanted_gray": 100.0},
            {"facts": "hash of RigFacts"},
            "s/toy_look/1",
        ]
    )


@pytest.mark.parametrize(
    ("name", "value", "ran"),
    [
        ("toy_look.wanted_gray", 50, ALL),
        ("toy_levels.step_gray", 32, ["levels", "fringes", "phase", "cloud"]),
        ("toy_levels.colour", "green", []),
        ("toy_phase.offset_rad", 1.0, ["phase", "cloud"]),
        ("toy_cloud.scale_mm", 2.0, ["cloud"]),
    ],
)
def test_an_edit_runs_its_stage_and_what_depends_on_it(
    name: str, value: Any, ran: list[str]
) -> None:
    past = Past()
    walk(past)
    stage, field = name.split(".")
    edits = [edit(1, stage, field, value)]
    assert walk(past, edits=edits) == ran
    assert walk(past, edits=edits) == []
    assert walk(past) == [], "and back: the old keys have their old results"


def test_equal_results_stop_the_wave() -> None:
    past = Past()
    walk(past)
    levels = plan(past).stage("toy_levels").run
    assert levels
    edits = [edit(1, "toy_levels", "most", 3)]
    key = plan(past, edits=edits).stage("toy_levels").key
    assert key
    past.finish(key, levels.hash or "")
    assert walk(past, edits=edits) == []


def test_a_take_is_another_capture_and_so_is_another_scan() -> None:
    past = Past()
    walk(past)
    redo = [edit(1, "toy_fringes", "take", 2, kind=EditKind.TAKE)]
    before, after = keys(past), keys(past, edits=redo)
    assert [n for n in ALL if before[n] != after[n]] == ["fringes", "phase", "cloud"]
    assert not set(keys(Past()).values()) & set(keys(Past(), scan="t").values()) - {None}


def test_another_version_of_a_stage_is_another_key() -> None:
    newer = replace(TOY, stages=(replace(toy_look, version=2), *TOY.stages[1:]))
    assert keys(Past(), method=newer)["look"] != keys(Past())["look"]


def test_a_repeated_stage_shares_results_only_with_equal_inputs() -> None:
    twice = replace(
        TOY, stages=(toy_look, toy_levels, toy_levels.named("again"), toy_fringes, toy_phase)
    )
    past = Past()
    assert walk(past, method=twice) == ["look", "levels", "fringes", "phase"]
    edits = [edit(1, "again", "step_gray", 8)]
    assert walk(past, method=twice, edits=edits) == ["again", "fringes", "phase"]


# given results


def test_a_given_result_replaces_its_stage() -> None:
    given = {**RIG, "toy_fringes": GivenRow("toy_fringes", "Fringes", {}, "given frames")}
    past = Past()
    assert walk(past, given=given) == ["look", "levels", "phase", "cloud"]
    assert plan(past, given=given).stage("toy_phase").inputs["fringes"] == given["toy_fringes"]


def test_an_imported_scan_starts_in_the_middle() -> None:
    given = {**RIG, "toy_fringes": GivenRow("toy_fringes", "Fringes", {}, "given frames")}
    past = Past()
    assert walk(past, given=given, has_rig=False) == ["phase", "cloud"]
    found = plan(past, given=given, has_rig=False)
    assert (
        found.stage("toy_look").missing
        == "needs a rig, and this scan has none: its frames were imported"
    )
    assert found.stage("toy_levels").missing == (
        "needs Look, which needs a rig, and this scan has none: its frames were imported"
    )
    assert found.stage("toy_phase").inputs["levels"] is None, "optional"


def test_captured_frames_let_a_stage_run_without_a_rig() -> None:
    past = Past()
    ran = walk(past, has_rig=False, journalled={"toy_look", "toy_fringes"})
    assert ran == ALL


def test_a_given_type_reaches_an_optional_input() -> None:
    hint = {"Hint": GivenRow("Hint", "Hint", {}, "a hint")}
    past = Past()
    walk(past)
    assert walk(past, given={**RIG, **hint}) == ["fringes", "phase", "cloud"]


def test_without_facts_the_rig_is_asked_first() -> None:
    found = plan(given={})
    assert (found.stage("toy_look").waits_for, found.stage("toy_look").missing) == ("the rig", None)
    step = next_step(found, until=None, unattended=False)
    assert isinstance(step, Run)
    assert step.planned.key is None


def test_a_missing_input_stops_only_what_needs_it() -> None:
    given = {"RigFacts": RIG["RigFacts"]}
    past = Past()
    assert walk(past, given=given) == ALL[:-1]
    found = plan(past, given=given)
    assert found.stage("toy_cloud").missing == "needs rig calibration, and the rig hands over none"
    with pytest.raises(
        StageUnavailableError, match="toy_cloud is unavailable: needs rig calibration"
    ):
        next_step(found, until="toy_cloud", unattended=False)


def test_settings_that_hold_no_more_make_their_stage_unavailable() -> None:
    found = plan(recipe={"toy_levels": {"steps": 3}, "toy_look": {"wanted_gray": 50}})
    assert found.stage("toy_look").missing is None
    assert found.stage("toy_levels").missing == (
        "needs settings that hold. toy_levels has no setting 'steps': "
        "it has step_gray, levels_gray, kind, colour, mask, most."
    )
    assert found.stage("toy_levels").settings.values["step_gray"] == 64


# gates


GATES = [
    # review, level -> holds attended, holds unattended
    (Review.ALWAYS, Level.OK, True, False),
    (Review.ALWAYS, Level.WARNING, True, False),
    (Review.ALWAYS, Level.FAILURE, True, True),
    (Review.ON_WARNING, Level.OK, False, False),
    (Review.ON_WARNING, Level.WARNING, True, False),
    (Review.ON_WARNING, Level.FAILURE, True, True),
    (Review.ON_FAILURE, Level.OK, False, False),
    (Review.ON_FAILURE, Level.WARNING, False, False),
    (Review.ON_FAILURE, Level.FAILURE, True, True),
]


@pytest.mark.parametrize(("review", "level", "attended", "unattended"), GATES)
def test_gates(review: Review, level: Level, attended: bool, unattended: bool) -> None:
    assert gate_holds(review, level, None) == attended
    assert gate_holds(review, level, None, unattended=unattended) == (
        attended if not unattended else True
    )
    assert gate_holds(review, level, None, unattended=True) == unattended
    accepted = DecisionRow(1, "s", "r", "", "k", Verdict.ACCEPT, "", "ada", NOW)
    for alone in (False, True):
        assert not gate_holds(review, level, accepted, unattended=alone)
        assert gate_holds(
            review, level, replace(accepted, verdict=Verdict.REJECT), unattended=alone
        )


def test_a_walk_stops_at_the_first_gate_and_goes_on_when_it_is_accepted() -> None:
    past = Past()
    for name in ("toy_look", "toy_levels"):
        key = plan(past).stage(name).key
        assert key
        past.finish(key, name, level=Level.WARNING)
    step = next_step(plan(past), until=None, unattended=False)
    assert isinstance(step, Gate)
    assert (step.planned.name, step.level) == ("toy_look", Level.WARNING)
    assert next_step(plan(past), until="toy_levels", unattended=True) is None
    past.decide(step.planned.key or "", Verdict.ACCEPT)
    step = next_step(plan(past), until=None, unattended=False)
    assert isinstance(step, Gate)
    assert step.planned.name == "toy_levels"


# edits


def test_undo_rows_cancel_their_group() -> None:
    rows = [
        edit(1, "toy_levels", "step_gray", 8),
        edit(2, "toy_levels", "kind", "odd", group="g"),
        edit(3, "toy_levels", "most", 4, group="g"),
        edit(4, "toy_levels", "kind", "even", kind=EditKind.UNDO, reverts="g"),
        edit(5, "toy_levels", "most", 6, kind=EditKind.UNDO, reverts="g"),
    ]
    assert [row.revision for row in standing(rows)] == [1]
    assert [row.revision for row in last_group(rows)] == [1]
    assert [row.revision for row in last_group(rows[:3])] == [2, 3]
    assert last_group([]) == []


def test_undoing_a_reset_brings_the_edit_back() -> None:
    rows = [
        edit(1, "toy_levels", "step_gray", 8),
        edit(2, "toy_levels", "step_gray", 64, kind=EditKind.RESET),
    ]
    assert (
        resolve_settings(TOY, preset=None, recipe={}, edits=rows)["toy_levels"].values["step_gray"]
        == 64
    )
    undone = [*rows, edit(3, "toy_levels", "step_gray", 8, kind=EditKind.UNDO, reverts="g2")]
    found = resolve_settings(TOY, preset=None, recipe={}, edits=undone)["toy_levels"]
    assert (found.values["step_gray"], found.sources["step_gray"]) == (8, "edited")


def test_layers_lie_over_each_other() -> None:
    found = resolve_settings(
        TOY,
        preset="coarse",
        recipe={"toy_levels": {"kind": "odd"}},
        edits=[edit(1, "toy_levels", "most", 9)],
    )["toy_levels"]
    assert {n: s for n, s in found.sources.items() if s != "default"} == {
        "step_gray": "preset", "kind": "recipe", "most": "edited",
    }  # fmt: skip
    assert found.values["step_gray"] == 128


def test_a_fresh_take_was_never_used() -> None:
    take = edit(1, "toy_look", "take", 2, kind=EditKind.TAKE)
    undo = edit(2, "toy_look", "take", 1, kind=EditKind.UNDO, reverts="g1")
    assert present_takes(TOY, [])["toy_look"] == 1
    assert present_takes(TOY, [take])["toy_look"] == 2
    assert present_takes(TOY, [take, undo])["toy_look"] == 1
    assert fresh_take([], "toy_look") == 2
    assert fresh_take([take, undo], "toy_look") == 3
    assert fresh_take([take, undo], "toy_fringes") == 2
    assert present_takes(TOY, [])["toy_phase"] == 0
