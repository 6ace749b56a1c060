"""Keys, invalidation, edits, undo, takes, decisions: the mechanism, on the toy method."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from backend.contract.requests import Decide, EditSettings, RedoStage, StartRun, UndoEdit
from backend.contract.scans import ScanState
from backend.domain.checks import Check
from backend.domain.errors import (
    ConflictError,
    InvalidSettingError,
    NotFoundError,
    StageUnavailableError,
    StaleEditError,
)
from backend.domain.states import Level, Verdict
from backend.jobs.capture import CaptureSession
from tests.scans.toy_house import House, hashes, stage, statuses, waiting

DONE = {"look": "done", "levels": "done", "fringes": "done", "phase": "accepted", "cloud": "done"}


def runs(house: House, scan: str) -> list[str]:
    """Return the stages that ran, in order."""
    with house.shop.database.reading() as repositories:
        return [run.stage.removeprefix("toy_") for run in repositories.runs.of(scan)]


def test_a_new_scan_is_pending_and_knows_its_first_key(house: House) -> None:
    state = house.create()
    assert set(statuses(state).values()) == {"pending"}
    assert state.status == "idle"
    assert stage(state, "toy_look").key is not None
    assert stage(state, "toy_levels").key is None
    assert stage(state, "toy_levels").message == "Waits for Look."
    assert state.undo is None


def test_a_scan_runs_to_a_gate_and_on(house: House) -> None:
    state = house.run(house.create().id)
    assert statuses(state) == {
        "look": "done", "levels": "done", "fringes": "done", "phase": "awaiting_review", "cloud": "pending",
    }  # fmt: skip
    assert state.status == "awaiting_review"
    gate = waiting(state)
    assert gate is not None
    house.accept(gate, who="bob")
    state = house.services.wait(state.id)
    assert statuses(state) == DONE
    assert state.status == "done"
    said = stage(state, "toy_phase").message  # what it found stays in front
    assert re.fullmatch(r"Done in \d\.\d s\. Accepted by bob\.", said), said


def test_running_again_computes_nothing(house: House) -> None:
    scan = house.create().id
    house.run_through(scan)
    ran, shots = runs(house, scan), house.rigs.shots
    state = house.run(scan)
    assert state.job is not None
    assert state.job.status == "finished"
    assert (runs(house, scan), house.rigs.shots) == (ran, shots)


def test_an_edit_invalidates_downstream_only(house: House) -> None:
    state = house.run_through(house.create().id)
    before = hashes(state)
    state = house.edit(state, "toy_phase", offset_rad=0.5)
    assert statuses(state) == {**DONE, "phase": "pending", "cloud": "pending"}
    assert {n: h for n, h in hashes(state).items() if h} == {
        n: h for n, h in before.items() if n not in ("phase", "cloud")
    }


def test_a_cosmetic_edit_invalidates_nothing(house: House) -> None:
    state = house.run_through(house.create().id)
    assert statuses(house.edit(state, "toy_levels", colour="green")) == DONE


def test_a_text_that_refers_to_an_artifact_is_a_setting_like_any_other(house: House) -> None:
    state = house.run_through(house.create().id)
    mask = house.shop.store.put(np.ones((16, 24), np.float32)).hash
    state = house.edit(state, "toy_levels", mask=mask)
    assert statuses(state)["levels"] == "pending"
    assert stage(state, "toy_levels").settings["mask"].value == mask


def test_equal_recomputation_stops_the_wave(house: House) -> None:
    """Another limit of a check is another key of its stage, but the same numbers: nothing below runs."""
    state = house.run_through(house.create().id)
    before = hashes(state)
    state = house.edit(state, "toy_levels", most=7.0)
    assert statuses(state)["phase"] == "pending"
    state = house.run(state.id)
    assert statuses(state) == DONE
    assert hashes(state) == before
    assert runs(house, state.id) == ["look", "levels", "fringes", "phase", "cloud", "levels"]


def test_undo_brings_the_old_result_back_without_computing(house: House) -> None:
    first = house.run_through(house.create().id)
    edited = house.edit(first, "toy_levels", step_gray=32)
    house.run_through(edited.id)
    ran = runs(house, first.id)
    state = house.undo(edited)
    assert statuses(state) == DONE
    assert hashes(state) == hashes(first)
    assert [s.key for s in state.stages] == [s.key for s in first.stages]
    assert runs(house, first.id) == ran


def test_undo_takes_back_a_request_whole_and_names_it(house: House) -> None:
    state = house.create()
    state = house.edit(state, "toy_levels", step_gray=32, kind="odd")
    assert state.undo == "Levels: step_gray back to 64, kind back to even (ada)."
    state = house.edit(state, "toy_look", wanted_gray=50)
    assert state.undo == "Look: wanted_gray back to 100 (ada)."
    state = house.undo(house.undo(state))
    assert state.undo is None
    assert stage(state, "toy_levels").settings["step_gray"].value == 64
    with pytest.raises(ConflictError, match="nothing to undo in 'part'"):
        house.undo(state)


def test_undo_after_undo_skips_what_is_taken_back(house: House) -> None:
    state = house.create()
    for step in (16, 32, 48):
        state = house.edit(state, "toy_levels", step_gray=step)
    seen = []
    while state.undo:
        state = house.undo(state)
        seen.append(stage(state, "toy_levels").settings["step_gray"].value)
    assert seen == [32, 16, 64]
    assert state.revision == 6, "edits are only ever added"


def test_a_value_equal_to_the_unedited_one_is_a_reset(house: House) -> None:
    state = house.create(settings={"toy_levels": {"step_gray": 16}})
    assert stage(state, "toy_levels").settings["step_gray"].source == "recipe"
    state = house.edit(state, "toy_levels", step_gray=64)
    assert stage(state, "toy_levels").settings["step_gray"].source == "edited"
    state = house.edit(state, "toy_levels", step_gray=16)
    assert stage(state, "toy_levels").settings["step_gray"].source == "recipe"
    same = house.edit(state, "toy_levels", step_gray=16)
    assert same.revision == state.revision, "what changes nothing isn't stored"


def test_reset_goes_back_to_recipe_preset_or_default(house: House) -> None:
    state = house.create(preset="coarse", settings={"toy_levels": {"most": 3}})
    state = house.edit(state, "toy_levels", step_gray=8, most=9, kind="odd")
    state = house.edit(state, "toy_levels", reset=("step_gray", "most", "kind"))
    shown = stage(state, "toy_levels").settings
    assert {name: (s.value, s.source) for name, s in shown.items()} == {
        "step_gray": (128, "preset"), "most": (3.0, "recipe"), "kind": ("even", "default"),
        "levels_gray": (None, "default"), "colour": ("red", "default"), "mask": (None, "default"),
    }  # fmt: skip


def test_settings_are_stored_as_they_are_not_as_they_were_written(house: House) -> None:
    state = house.create()
    state = house.edit(state, "toy_levels", step_gray="32")
    assert stage(state, "toy_levels").settings["step_gray"].value == 32
    assert house.edit(state, "toy_levels", step_gray=32).revision == state.revision


@pytest.mark.parametrize(
    ("stage_name", "changes", "sentence"),
    [
        ("toy_levels", {"step_gray": 500}, "toy_levels.step_gray can't be 500: it has to be a whole number from 1 to 128 gray."),
        ("toy_levels", {"kind": "both"}, "toy_levels.kind can't be 'both': it has to be one of even, odd."),
        ("toy_levels", {"levels_gray": []}, r"toy_levels.levels_gray can't be \[\]: it has to be a list of 1 to 4 values gray or null \(automatic\)."),
        ("toy_look", {"exposure_ms": 0}, r"toy_look.exposure_ms can't be 0: it has to be a number above 0 up to 100 ms or null \(automatic\)."),
        ("toy_look", {"wanted_gray": "much"}, "toy_look.wanted_gray can't be 'much': it has to be a number from 1 to 250 gray."),
        ("toy_look", {"exposure": 3}, "toy_look has no setting 'exposure': it has exposure_ms, wanted_gray."),
    ],
)  # fmt: skip
def test_a_setting_that_cant_be_used_is_refused_in_one_sentence(
    house: House, stage_name: str, changes: dict[str, Any], sentence: str
) -> None:
    state = house.create()
    with pytest.raises(InvalidSettingError, match=f"^{sentence}$"):
        house.edit(state, stage_name, **changes)
    with pytest.raises(InvalidSettingError, match=f"^{sentence}$"):
        house.create(settings={stage_name: changes})
    assert house.services.scan(state.id).revision == 0


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"method": "fringes"}, NotFoundError, "There is no method 'fringes'; there are: toy."),
        ({"preset": "fine"}, InvalidSettingError, "toy has no preset 'fine'; its presets are: coarse."),
        ({"settings": {"zones": {}}}, InvalidSettingError, "toy has no stage 'zones'; its stages are toy_look, "),
    ],
)  # fmt: skip
def test_a_scan_that_cant_be_made_says_what_there_is(
    house: House, options: dict[str, Any], error: type[Exception], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        house.create(**options)
    assert house.services.scans() == ()


def test_automatic_shows_what_was_chosen(house: House) -> None:
    state = house.run_through(house.create().id)
    look, levels = stage(state, "toy_look"), stage(state, "toy_levels")
    assert look.settings["exposure_ms"].value is None
    assert look.settings["exposure_ms"].chosen == look.fields[0].value == 8.0
    assert levels.settings["levels_gray"].chosen == [0.0, 64.0, 128.0, 192.0]
    state = house.edit(state, "toy_levels", levels_gray=[5.0, 6.0])
    assert stage(state, "toy_levels").settings["levels_gray"].chosen is None


# other people


def stale(house: House, action: Callable[[ScanState], object]) -> StaleEditError:
    """Let Bob act on a state that Ada changed since."""
    old = house.create()
    house.edit(old, "toy_levels", who="ada", step_gray=32, kind="odd")
    with pytest.raises(StaleEditError) as caught:
        action(old)
    return caught.value


def test_a_stale_edit_of_the_same_field_is_refused_with_the_others_edit(house: House) -> None:
    error = stale(house, lambda old: house.edit(old, "toy_levels", who="bob", step_gray=16))
    assert error.sentence == (
        "ada changed Levels, step_gray from 64 to 32, since you last looked: look at it and decide again."
    )
    edit = error.details["edit"]
    assert isinstance(edit, dict)
    assert edit.pop("when").startswith("20")
    assert edit == {
        "stage": "toy_levels", "field": "step_gray", "old": 64, "new": 32, "who": "ada", "reason": "", "revision": 1,
    }  # fmt: skip
    assert error.details["revision"] == 2


def test_a_stale_reset_and_a_stale_undo_are_refused(house: House) -> None:
    stale(house, lambda old: house.edit(old, "toy_levels", who="bob", reset=("kind",)))
    stale(house, lambda old: house.undo(old, who="bob"))


def test_unrelated_edits_merge(house: House) -> None:
    old = house.create()
    house.edit(old, "toy_levels", who="ada", step_gray=32)
    house.edit(old, "toy_levels", who="bob", kind="odd")
    state = house.edit(old, "toy_look", who="cid", wanted_gray=50)
    levels = stage(state, "toy_levels").settings
    assert (levels["step_gray"].value, levels["kind"].value, state.revision) == (32, "odd", 3)


def test_a_field_that_was_undone_since_is_stale_too(house: House) -> None:
    state = house.edit(house.create(), "toy_levels", step_gray=32)
    house.undo(state, who="bob")
    with pytest.raises(StaleEditError, match="bob changed Levels, step_gray from 32 to 64"):
        house.edit(state, "toy_levels", step_gray=16)


# takes


def test_redo_takes_new_pictures_of_one_stage(house: House) -> None:
    state = house.run_through(house.create(rig_options={"noise": True}).id)
    shots = house.rigs.shots
    redone = house.redo(state, "toy_fringes")
    assert stage(redone, "toy_fringes").take == 2
    assert statuses(redone) == {
        **DONE,
        "fringes": "pending",
        "phase": "pending",
        "cloud": "pending",
    }
    after = house.run_through(state.id)
    assert house.rigs.shots == shots + 8
    assert hashes(after)["fringes"] != hashes(state)["fringes"]
    assert hashes(after)["look"] == hashes(state)["look"]


def test_redo_that_sees_the_same_stops_the_wave(house: House) -> None:
    state = house.run_through(house.create().id)
    house.redo(state, "toy_fringes")
    after = house.run(state.id)
    assert statuses(after) == DONE
    assert runs(house, state.id)[5:] == ["fringes"]


def test_undoing_a_redo_brings_the_old_pictures_back(house: House) -> None:
    state = house.run_through(house.create(rig_options={"noise": True}).id)
    redone = house.redo(state, "toy_fringes")
    assert redone.undo == "Fringes: go back to take 1 (ada)."
    house.run_through(state.id)
    shots = house.rigs.shots
    undone = house.undo(redone)
    assert (statuses(undone), hashes(undone)) == (DONE, hashes(state))
    again = house.redo(undone, "toy_fringes")
    assert stage(again, "toy_fringes").take == 3, "new pictures, not those of the undone take"
    house.run_through(state.id)
    assert house.rigs.shots == shots + 8


def test_what_was_found_of_frames_stays_when_they_are_looked_at_anew(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    drift = Check("drift", Level.WARNING, "white has changed")
    found = iter([(drift,)])
    monkeypatch.setattr(CaptureSession, "finish", lambda session: next(found, ()))
    state = house.run(house.create().id)
    assert "drift" in {check.name for check in stage(state, "toy_look").checks}
    shots = house.rigs.shots
    state = house.run(house.edit(state, "toy_look", wanted_gray=99.0).id)
    assert house.rigs.shots == shots
    assert "drift" in {check.name for check in stage(state, "toy_look").checks}


def test_part_moved_takes_all_pictures_again(house: House) -> None:
    state = house.run_through(house.create().id)
    state = house.redo(state, None)
    assert [stage(state, n).take for n in ("toy_look", "toy_fringes")] == [2, 2]
    assert state.undo == "Look, Fringes: go back to take 1 (ada)."
    state = house.undo(state)
    assert statuses(state) == DONE


def test_what_takes_no_pictures_cant_be_redone(house: House) -> None:
    state = house.create()
    with pytest.raises(ConflictError, match="Phase can't be redone, it takes no pictures"):
        house.redo(state, "toy_phase")
    with pytest.raises(NotFoundError, match="toy has no stage 'phase'"):
        house.redo(state, "phase")


def test_two_people_redo_once(house: House) -> None:
    state = house.create()
    house.redo(state, "toy_look", who="ada")
    with pytest.raises(StaleEditError, match="ada changed Look, take from 1 to 2"):
        house.redo(state, None, who="bob")
    house.redo(state, "toy_fringes", who="bob")


# decisions


def test_an_accepted_decision_holds_for_its_key(house: House) -> None:
    state = house.run_through(house.create().id)
    other = house.edit(state, "toy_phase", offset_rad=1.0)
    gate = waiting(house.run(state.id))
    assert gate is not None, "another key, another decision"
    back = house.undo(other)
    assert statuses(back) == DONE, "the old key, the old decision"


def test_a_decision_doesnt_hold_in_another_scan(house: House) -> None:
    house.run_through(house.create().id)
    assert waiting(house.run(house.create().id)) is not None


def test_a_rejected_result_stops_every_run_until_something_changes(house: House) -> None:
    state = house.run(house.create().id)
    gate = waiting(state)
    assert gate is not None
    assert gate.stage_run
    request = Decide(verdict=Verdict.REJECT, reason="too noisy")
    state = house.services.decide(gate.stage_run, request, "bob")
    assert statuses(state)["phase"] == "rejected"
    said = stage(state, "toy_phase").message
    assert said.endswith("s. Rejected by bob: too noisy. Change a setting or redo it.")
    for unattended in (False, True):
        with pytest.raises(ConflictError, match="bob rejected Phase: change a setting or redo it"):
            house.run(state.id, unattended=unattended)
    state = house.edit(state, "toy_phase", offset_rad=0.25)
    assert waiting(house.run(state.id)) is not None


def test_accepting_without_proceeding_runs_nothing(house: House) -> None:
    gate = waiting(house.run(house.create().id))
    assert gate is not None
    state = house.accept(gate, proceed=False)
    assert statuses(state)["cloud"] == "pending"


def test_a_result_of_yesterday_cant_be_accepted(house: House) -> None:
    state = house.run(house.create().id)
    gate = waiting(state)
    assert gate is not None
    house.edit(state, "toy_phase", offset_rad=1.0)
    with pytest.raises(ConflictError, match="isn't today's any more"):
        house.accept(gate)
    with pytest.raises(NotFoundError, match="no stage run 'nowhere'"):
        house.services.decide("nowhere", Decide(verdict=Verdict.ACCEPT), "ada")


# gates and levels: 4 levels of gray are found, 16 with a step of 8


GATES = [
    # most, unattended -> levels, job, phase
    (6.0, False, "done", "awaiting_review", "awaiting_review"),
    (1.0, False, "awaiting_review", "awaiting_review", "pending"),
    (1.0, True, "done", "finished", "done"),
]


@pytest.mark.parametrize(("most", "unattended", "levels", "job", "phase"), GATES)
def test_gates(
    house: House, most: float, unattended: bool, levels: str, job: str, phase: str
) -> None:
    scan = house.create(settings={"toy_levels": {"most": most}}).id
    state = house.run(scan, unattended=unattended)
    assert state.job is not None
    assert (statuses(state)["levels"], statuses(state)["phase"], state.job.status) == (
        levels,
        phase,
        job,
    )


def test_a_failed_check_stops_an_unattended_run(house: House) -> None:
    scan = house.create(settings={"toy_levels": {"most": 1.0, "step_gray": 8}}).id
    state = house.run(scan, unattended=True)
    assert state.job is not None
    assert state.job.status == "failed"
    assert state.job.error == "Levels failed its check: 16 levels found."
    assert statuses(state)["levels"] == "awaiting_review"
    assert statuses(state)["fringes"] == "pending"
    with pytest.raises(ConflictError, match="Levels failed a check: accept it"):
        house.run(scan, unattended=True)
    house.accept(stage(state, "toy_levels"), proceed=False)
    assert statuses(house.run(scan, unattended=True))["cloud"] == "done"


def test_running_past_a_gate_without_deciding_is_refused(house: House) -> None:
    state = house.run(house.create().id)
    with pytest.raises(ConflictError, match="Phase waits for a decision"):
        house.run(state.id)
    assert house.run(state.id, until="toy_fringes").job is not None


def test_until_ends_early(house: House) -> None:
    state = house.run(house.create().id, until="toy_levels")
    assert statuses(state) == {
        "look": "done", "levels": "done", "fringes": "pending", "phase": "pending", "cloud": "pending",
    }  # fmt: skip
    with pytest.raises(NotFoundError, match="toy has no stage 'levels'"):
        house.run(state.id, until="levels")


# what isn't there


def test_without_calibration_only_the_last_stage_is_unavailable(house: House) -> None:
    state = house.run_through(house.create(rig_options={"calibrated": False}).id)
    assert statuses(state) == {**DONE, "cloud": "unavailable"}
    message = "Unavailable: needs rig calibration, and the rig hands over none."
    assert stage(state, "toy_cloud").message == message
    assert state.status == "done"
    with pytest.raises(
        StageUnavailableError, match="toy_cloud is unavailable: needs rig calibration"
    ):
        house.run(state.id, until="toy_cloud")


def test_every_action_is_in_the_audit_trail(house: House) -> None:
    state = house.create(who="ada")
    state = house.edit(state, "toy_levels", who="bob", step_gray=32)
    house.services.edit(
        state.id,
        "toy_levels",
        EditSettings(changes={"step_gray": 16}, revision=1, reason="finer"),
        "bob",
    )
    state = house.undo(house.services.scan(state.id), who="cid")
    house.services.redo(state.id, "toy_look", RedoStage(revision=state.revision), "dan")
    state = house.run(state.id, who="eve")
    gate = waiting(state)
    assert gate is not None
    house.accept(gate, who="fay")
    house.services.wait(state.id)
    trail = house.services.audit(state.id)
    assert [(e.who, e.action, e.stage) for e in trail] == [
        ("ada", "created", None),
        ("bob", "edited", "toy_levels"),
        ("bob", "edited", "toy_levels"),
        ("cid", "undone", "toy_levels"),
        ("dan", "redone", "toy_look"),
        ("eve", "run", None),
        ("eve", "finished", "toy_look"),
        ("eve", "finished", "toy_levels"),
        ("eve", "finished", "toy_fringes"),
        ("eve", "finished", "toy_phase"),
        ("eve", "awaiting_review", "toy_phase"),
        ("fay", "accepted", "toy_phase"),
        ("fay", "run", None),
        ("fay", "finished", "toy_cloud"),
        ("fay", "finished", None),
    ]
    assert trail[2].sentence == "Levels: step_gray from 32 to 16. finer"
    assert trail[3].sentence == "Levels: step_gray is 32 again."
    assert all(e.sentence.endswith((".", "finer")) for e in trail)


def test_scans_are_listed_with_where_they_stand(house: House) -> None:
    first = house.run_through(house.create(name="bracket").id)
    house.create(name="cover")
    cover, bracket = house.services.scans()
    assert (cover.name, cover.status, cover.stages_done, cover.stages) == ("cover", "idle", 0, 5)
    assert (bracket.id, bracket.status, bracket.stages_done) == (first.id, "done", 5)
    assert bracket.points == 24 * 16
    assert house.services.scans()[1] is bracket, "nothing has happened to it"
    house.edit(first, "toy_cloud", scale_mm=2.0)
    changed = house.services.scans()[1]
    assert (changed.status, changed.stages_done, changed.points) == ("idle", 4, None)
    assert [s.name for s in house.services.scans(text="brack")] == ["bracket"]
    assert [s.name for s in house.services.scans(limit=1, offset=1)] == ["bracket"]


def test_unknown_scans_are_named(house: House) -> None:
    for ask in (
        lambda: house.services.scan("nope"),
        lambda: house.services.audit("nope"),
        lambda: house.services.run("nope", StartRun(), "ada"),
        lambda: house.services.undo("nope", UndoEdit(revision=0), "ada"),
    ):
        with pytest.raises(NotFoundError, match="'nope'"):
            ask()
