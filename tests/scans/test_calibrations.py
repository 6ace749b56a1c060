"""Results that are kept for a rig and handed to later scans, and those of other scans and exports."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float

from backend.contract.requests import Decide, GivenSource
from backend.contract.scans import HandedView, ScanState
from backend.domain.checks import Check, at_most
from backend.domain.errors import ConflictError, InvalidCaptureError, NotFoundError
from backend.domain.method import Method
from backend.domain.params import Params, setting
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.stage import stage
from backend.domain.states import Review, Verdict
from backend.methods import Registry
from tests.scans import toy_house
from tests.scans.toy import TOY, Hint
from tests.scans.toy_house import House, data_folder
from tests.scans.toy_house import stage as stage_of


class HintParams(Params):
    """What is told."""

    text: str = setting("aim left", title="Text")
    worst: float = setting(1.0, title="Worst")


@dataclass(frozen=True)
class Table:
    """Something larger that can be kept."""

    heights_mm: Float[np.ndarray, "n"]


def good_enough(result: Hint, params: HintParams) -> Check:
    return at_most(
        "worst", params.worst, warning=2.0, failure=3.0, sentence=f"worst {params.worst}"
    )


@stage(title="Tell", version=1, review=Review.ON_FAILURE, checks=(good_enough,))
def toy_tell(params: HintParams) -> Hint:
    """Say something that other scans can use."""
    return Hint(params.text)


@stage(title="Measure table", version=1)
def toy_table(hint: Hint) -> Table:
    """Measure the table."""
    return Table(np.arange(2000.0))


@stage(title="Read", version=1)
def toy_read(table: Table, facts: RigFacts) -> Hint:
    """Read the table, measured here or before."""
    return Hint(f"{table.heights_mm.sum():.0f}")


TELLING = Method(name="telling", title="Telling", stages=(toy_tell, toy_table))
READING = Method(
    name="reading",
    title="Reading",
    stages=(toy_tell, toy_table, toy_read),
    given=(RigFacts, RigCalibration, Table),
)


@lru_cache(maxsize=1)
def registry() -> Registry:
    return Registry({"toy": TOY, "telling": TELLING, "reading": READING}, {})


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    monkeypatch.setattr(toy_house, "toy_registry", registry)
    with toy_house.inline_house(*data_folder(tmp_path / "data")) as house:
        yield house


def told(house: House, text: str = "aim left", **options: Any) -> ScanState:
    """Run a scan whose first stage makes a hint."""
    state = house.create(method="telling", settings={"toy_tell": {"text": text}}, **options)
    return house.run_through(state.id)


def keep(house: House, state: ScanState, name: str = "toy_tell") -> int:
    run = stage_of(state, name).stage_run
    assert run
    return house.services.keep(run, "bob").number


def handed(state: ScanState) -> HandedView:
    (view,) = state.handed
    return view


def note(house: House, state: ScanState) -> str:
    """Return what the toy method's fringes say that they were given."""
    state = house.run_through(state.id)
    (found,) = [f.value for f in stage_of(state, "toy_fringes").fields if f.name == "note"]
    return str(found)


def test_a_later_scan_gets_the_newest_result_of_its_rig(house: House) -> None:
    before = house.create()
    first = keep(house, told(house, "aim left", name="first"))
    second = keep(house, told(house, "aim right", name="second"))
    state = house.create()
    assert handed(before).sentence is None
    view = handed(state)
    assert (view.type, view.name, view.stages) == ("Hint", "Hint", ("toy_fringes",))
    assert view.calibration == second == first + 1
    assert view.sentence
    assert view.sentence.startswith(f"Calibration {second} of the rig: 'second', bob, ")
    assert note(house, state) == "aim right"
    assert note(house, before) == "no hint"


def test_what_is_kept_is_shown_and_audited(house: House) -> None:
    state = told(house, name="first")
    assert stage_of(state, "toy_tell").can_keep
    assert stage_of(state, "toy_tell").kept is None
    number = keep(house, state)
    after = house.services.scan(state.id)
    assert stage_of(after, "toy_tell").kept == number
    last = house.services.audit(state.id)[-1]
    assert (last.who, last.action, last.stage) == ("bob", "kept", "toy_tell")
    assert last.sentence == f"Tell kept as calibration {number} of rig toy."
    assert house.services.audit(house.create().id)[-1].action == "given"


@pytest.mark.parametrize(
    "other", [{"calibrated": False}, {"rig": "another"}], ids=["geometry", "rig"]
)
def test_another_rig_gets_nothing(house: House, other: dict[str, object]) -> None:
    keep(house, told(house))
    rig = other.pop("rig", "toy")
    assert handed(house.create(rig=rig, rig_options=other)).sentence is None
    assert handed(house.create()).sentence is not None


def test_options_that_change_no_fact_are_the_same_rig(house: House) -> None:
    keep(house, told(house))
    assert handed(house.create(rig_options={"noise": True})).sentence is not None


def test_a_withdrawn_one_is_given_to_nobody_any_more(house: House) -> None:
    first = keep(house, told(house, "aim left"))
    second = keep(house, told(house, "aim right"))
    has_it = house.create()
    house.services.withdraw(second, "eve")
    assert handed(house.create()).calibration == first
    assert note(house, has_it) == "aim right"
    views = house.services.calibrations("toy")
    assert [(v.number, v.newest, v.withdrawn_by) for v in views] == [
        (second, False, "eve"), (first, True, None),
    ]  # fmt: skip
    assert house.services.calibrations() == views
    assert house.services.calibrations("another") == ()
    with pytest.raises(ConflictError, match="was withdrawn by eve already"):
        house.services.withdraw(second, "eve")


def test_an_operator_takes_away_and_replaces(house: House) -> None:
    number, other = keep(house, told(house, "aim left")), told(house, "aim up", name="up")
    state = house.create()
    assert note(house, state) == "aim left"
    state = house.services.take_away(state.id, "Hint", "ada")
    assert handed(state).sentence is None
    assert note(house, state) == "no hint"
    state = house.services.give(state.id, "Hint", GivenSource(scan=other.id), "ada")
    assert handed(state).sentence == "From scan 'up', Tell."
    assert note(house, state) == "aim up"
    state = house.services.give(state.id, "Hint", GivenSource(calibration=number), "ada")
    assert stage_of(state, "toy_fringes").status == "done"
    said = [a.sentence for a in house.services.audit(state.id) if a.action == "given"]
    assert said[1:3] == ["Hint taken away.", "Hint handed over: From scan 'up', Tell."]
    house.services.take_away(state.id, "Hint", "ada")
    with pytest.raises(ConflictError, match="No Hint was handed to 'part'"):
        house.services.take_away(state.id, "Hint", "ada")


def test_a_scan_may_be_made_with_another_result_or_without(house: House) -> None:
    keep(house, told(house, "aim left"))
    other = told(house, "aim up", name="up")
    chosen = house.create(given={"Hint": GivenSource(scan=other.id)})
    without = house.create(given={"Hint": None})
    assert handed(chosen).sentence == "From scan 'up', Tell."
    assert handed(without).sentence is None


def test_a_kept_result_replaces_the_stage_that_makes_it(house: House) -> None:
    source = told(house, name="measured")
    number = keep(house, source, "toy_table")
    state = house.run_through(house.create(method="reading").id)
    replaced = stage_of(state, "toy_table")
    assert replaced.status == "given"
    assert replaced.message.startswith(f"Calibration {number} of the rig: 'measured'")
    assert stage_of(state, "toy_read").status == "done"
    assert handed(state).stages == ("toy_table",)
    state = house.services.take_away(state.id, "Table", "ada")
    assert stage_of(house.run_through(state.id), "toy_table").status == "done"


def test_an_export_hands_its_results_on(house: House, tmp_path: Path) -> None:
    source = told(house, name="measured")
    folder = tmp_path / "out"
    house.services.export(source.id, str(folder), False, "ada")
    state = house.create(method="reading", given={"Table": GivenSource(folder=str(folder))})
    assert handed(state).sentence == f"From the export of 'measured' in {folder}."
    assert handed(state).result_hash == stage_of(source, "toy_table").result_hash
    assert stage_of(house.run_through(state.id), "toy_read").status == "done"


def test_what_was_handed_over_is_exported_and_replayed(house: House, tmp_path: Path) -> None:
    keep(house, told(house, "aim right"))
    state = house.run_through(house.create().id)
    house.services.export(state.id, str(tmp_path / "out"), True, "ada")
    assert house.services.replay(state.id).is_same
    assert house.services.replay_folder(str(tmp_path / "out")).is_same
    imported = house.services.import_capture(str(tmp_path / "out"), "", "bob")
    assert handed(imported).sentence == handed(state).sentence


def test_a_changed_export_is_refused(house: House, tmp_path: Path) -> None:
    source = told(house)
    folder = tmp_path / "out"
    house.services.export(source.id, str(folder), False, "ada")
    for file in (folder / "given").iterdir():
        np.save(file, np.zeros(2000))
    with pytest.raises(InvalidCaptureError, match="isn't what was exported"):
        house.create(method="reading", given={"Table": GivenSource(folder=str(folder))})
    with pytest.raises(InvalidCaptureError, match="name the folder of an export"):
        house.create(method="reading", given={"Table": GivenSource(folder=str(tmp_path / "no"))})
    (folder / "scan.json").write_text("{}")
    with pytest.raises(InvalidCaptureError, match="isn't a scan of ours"):
        house.create(method="reading", given={"Table": GivenSource(folder=str(folder))})


def test_what_can_not_be_kept_says_why(house: House) -> None:
    state = house.run_through(house.create().id)
    assert not stage_of(state, "toy_look").can_keep
    with pytest.raises(ConflictError, match="No method takes a Look from outside, so Look isn't"):
        keep(house, state, "toy_look")
    bad = house.run(house.create(method="telling", settings={"toy_tell": {"worst": 9.0}}).id)
    with pytest.raises(ConflictError, match="Tell failed a check, so it isn't kept"):
        keep(house, bad)
    run = stage_of(bad, "toy_tell").stage_run
    assert run
    house.services.decide(run, Decide(verdict=Verdict.ACCEPT, proceed=False), "ada")
    assert keep(house, bad) == 1
    house.services.decide(run, Decide(verdict=Verdict.REJECT), "ada")
    with pytest.raises(ConflictError, match="Tell was rejected"):
        keep(house, bad)
    older = stage_of(told(house), "toy_tell").stage_run
    assert older
    house.services.keep(older, "ada")
    (newest, *_) = house.services.calibrations()
    house.edit(house.services.scan(newest.scan), "toy_tell", text="aim down")
    with pytest.raises(ConflictError, match="isn't today's any more"):
        house.services.keep(older, "ada")


@pytest.mark.parametrize(
    ("method", "kind", "source", "error", "sentence"),
    [
        ("toy", "Ramp", GivenSource(calibration=1), ConflictError, "toy takes no Ramp from outside; what can be handed over: Hint"),
        ("telling", "Hint", GivenSource(calibration=1), ConflictError, "can be handed over: nothing"),
        ("toy", "Hint", GivenSource(calibration=7), NotFoundError, "no calibration 7"),
        ("toy", "Hint", GivenSource(scan="none"), NotFoundError, "no scan 'none'"),
        ("toy", "RigFacts", None, ConflictError, "takes no RigFacts from outside"),
    ],
    ids=["type", "method", "number", "scan", "facts"],
)  # fmt: skip
def test_what_can_not_be_handed_over_says_why(
    house: House,
    method: str,
    kind: str,
    source: GivenSource | None,
    error: type[Exception],
    sentence: str,
) -> None:
    with pytest.raises(error, match=sentence):
        house.create(method=method, given={kind: source})


def test_a_result_of_another_type_is_refused(house: House) -> None:
    number = keep(house, told(house), "toy_table")
    empty = house.create(method="telling")
    with pytest.raises(ConflictError, match=f"Calibration {number} is a Table, not a Hint"):
        house.create(given={"Hint": GivenSource(calibration=number)})
    with pytest.raises(NotFoundError, match="has no Hint now: run the stage that makes it"):
        house.create(given={"Hint": GivenSource(scan=empty.id)})
