"""What the repositories promise, on SQLite and PostgreSQL."""

import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError, IntegrityError

from backend.domain.checks import at_least
from backend.domain.errors import NotFoundError
from backend.domain.ids import new_id
from backend.domain.states import JobStatus, Level, Verdict
from backend.storage.database import Database
from backend.storage.repositories import Repositories
from backend.storage.rows import (
    CalibrationRow,
    EditKind,
    EditRow,
    FrameRow,
    GivenRow,
    JobRow,
    RunStatus,
    ScanRow,
)
from backend.storage.tables import APPEND_ONLY

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def a_scan(**changes: Any) -> ScanRow:
    row = ScanRow(
        id=new_id(),
        name="bracket",
        note="shiny",
        method="hdr-fringe",
        rig="simulated",
        rig_options={"scene": "metal", "width_px": 1280},
        preset=None,
        recipe={"zones": {"sigma_gray": 3.0}},
        created=NOON,
        who="ada",
    )
    return replace(row, **changes)


def an_edit(scan: str, **changes: Any) -> EditRow:
    row = EditRow(
        scan=scan,
        stage="zones",
        field="sigma_gray",
        old=None,
        new=3.0,
        kind=EditKind.SET,
        group="g1",
        reason="too rough",
        who="ada",
        when=NOON,
    )
    return replace(row, **changes)


def a_frame(scan: str, **changes: Any) -> FrameRow:
    row = FrameRow(
        scan=scan,
        stage="fringe_capture",
        take=0,
        shot="5" * 64,
        occurrence=0,
        camera="left",
        document={"pattern": {"kind": "uniform", "gray": 255.0}, "exposure_ms": 60.0},
        artifact="a" * 64,
        bit_depth=8,
        when=NOON,
        metadata={"frame_id": 7, "ExposureTime": 60_000.0},
    )
    return replace(row, **changes)


def a_job(scan: str, **changes: Any) -> JobRow:
    row = JobRow(id=new_id(), scan=scan, status=JobStatus.QUEUED, who="ada", created=NOON)
    return replace(row, **changes)


@pytest.fixture
def scan(database: Database) -> str:
    row = a_scan()
    with database.transaction() as r:
        r.scans.add(row)
    return row.id


# --- scans -----------------------------------------------------------------------------------------


def test_a_scan_comes_back_as_it_was_written(database: Database) -> None:
    row = a_scan(preset="fast", recipe={"b": {"y": 1, "x": None}, "a": {}}, revision=0)
    with database.transaction() as r:
        r.scans.add(row)
    with database.reading() as r:
        assert r.scans.get(row.id) == row


def test_moments_come_back_in_utc_whatever_zone_they_were_written_in(database: Database) -> None:
    row = a_scan(created=datetime(2026, 3, 1, 1, 30, 0, 123456, timezone(timedelta(hours=5.5))))
    with database.transaction() as r:
        r.scans.add(row)
    with database.reading() as r:
        back = r.scans.get(row.id).created
    assert back == row.created
    assert back.utcoffset() == timedelta(0)


def test_a_moment_without_a_zone_is_refused(database: Database) -> None:
    with pytest.raises(Exception, match="no time zone"), database.transaction() as r:
        r.scans.add(a_scan(created=datetime(2026, 3, 1)))


def test_the_list_is_newest_first_and_cut_by_limit_and_offset(database: Database) -> None:
    rows = [a_scan(name=str(n), created=NOON + timedelta(hours=n)) for n in range(5)]
    with database.transaction() as r:
        for row in (rows[3], rows[0], rows[4], rows[1], rows[2]):
            r.scans.add(row)
    with database.reading() as r:
        assert [s.name for s in r.scans.list()] == ["4", "3", "2", "1", "0"]
        assert [s.name for s in r.scans.list(limit=2, offset=1)] == ["3", "2"]
        assert r.scans.count() == 5


@pytest.mark.parametrize(
    ("sought", "found"),
    [
        ("", ["100% matte", "dark_cover", "Plaster"]),
        ("PLAST", ["Plaster"]),
        ("book", ["dark_cover"]),
        ("%", ["100% matte"]),
        ("k_c", ["dark_cover"]),
        ("nothing", []),
    ],
)
def test_the_list_finds_a_text_literally(database: Database, sought: str, found: list[str]) -> None:
    with database.transaction() as r:
        for name, note in (("Plaster", ""), ("dark_cover", "a book"), ("100% matte", "")):
            r.scans.add(a_scan(name=name, note=note))
    with database.reading() as r:
        assert sorted(s.name for s in r.scans.list(text=sought)) == sorted(found)
        assert r.scans.count(sought) == len(found)


MISSING: dict[str, Callable[[Repositories], object]] = {
    "scan": lambda r: r.scans.get("nobody"),
    "locked scan": lambda r: r.scans.lock("nobody"),
    "edited scan": lambda r: r.edits.add("nobody", an_edit("nobody")),
    "run": lambda r: r.runs.get("nobody"),
    "finished run": lambda r: r.runs.finish("nobody", {}, "h"),
    "job": lambda r: r.jobs.get("nobody"),
    "updated job": lambda r: r.jobs.update("nobody", progress=0.5),
}


@pytest.mark.parametrize("what", MISSING)
def test_what_is_missing_is_named(database: Database, what: str) -> None:
    with database.transaction() as r, pytest.raises(NotFoundError, match="'nobody'"):
        MISSING[what](r)


def test_rows_of_a_scan_that_is_not_there_are_refused(database: Database) -> None:
    with pytest.raises(DBAPIError, match=r"(?i)foreign key"), database.transaction() as r:
        r.audit.add("nobody", "ada", "created", None, "Made a scan.")


def test_given_results_come_back_by_name(database: Database, scan: str) -> None:
    with database.transaction() as r:
        r.given.add(scan, "RigFacts", "RigFacts", {"reference": "left"}, "1" * 64)
        r.given.add(scan, "fringe_capture", "FringeFrames", {"frames": []}, "2" * 64)
    with database.reading() as r:
        given = r.given.of(scan)
    assert list(given) == ["RigFacts", "fringe_capture"]
    assert given["fringe_capture"].type_name == "FringeFrames"
    assert given["fringe_capture"].document == {"frames": []}
    assert given["fringe_capture"].hash == "2" * 64


# --- values that databases like to change -----------------------------------------------------------

EXACT_VALUES = {
    "null": None,
    "a float that is whole": 3.0,
    "minus zero": -0.0,
    "a large float that is whole": 1e16,
    "a small float": 5e-324,
    "the largest float": 1.7976931348623157e308,
    "an integer of 80 bit": 2**80,
    "truth": True,
    "a text like a number": "1.0",
    "a text with quotes, zero and letters": 'say "\0 ü 漢 \\u0041 🜁"',
    "order of keys": {"right": 1, "left": 2, "a": {"z": 0, "b": [1.0, 1, None]}},
}


@pytest.mark.parametrize("value", EXACT_VALUES.values(), ids=EXACT_VALUES.keys())
def test_values_that_enter_a_hash_come_back_exactly(
    database: Database, scan: str, value: Any
) -> None:
    with database.transaction() as r:
        r.edits.add(scan, an_edit(scan, old=value, new=value))
        r.audit.add(scan, "ada", "edited", "zones", "Smoothed.", {"value": value})
        r.given.add(scan, "RigFacts", "RigFacts", {"value": value}, "1" * 64)
        r.frames.add(a_frame(scan, document={"value": value}))
        run = r.runs.start(scan, "zones", "k", 0)
        r.runs.finish(run, {"value": value}, "h")
    with database.reading() as r:
        edit = r.edits.of(scan)[0]
        came_back = [
            edit.old,
            edit.new,
            r.audit.of(scan)[0].details["value"],
            r.given.of(scan)["RigFacts"].document["value"],
            r.frames.of(scan, "fringe_capture", 0)[0].document["value"],
            (r.runs.get(run).document or {})["value"],
        ]
    # repr tells 3 from 3.0, 0.0 from -0.0 and shows the order of keys
    assert {repr(v) for v in came_back} == {repr(value)}


def test_a_number_that_json_does_not_have_is_refused(database: Database, scan: str) -> None:
    with pytest.raises(Exception, match="not JSON compliant"), database.transaction() as r:
        r.edits.add(scan, an_edit(scan, new=float("nan")))


@pytest.mark.parametrize("text_sent", ["two\0halves", "half a \ud83d pair"])
def test_a_text_that_no_database_keeps_is_no_fault(database: Database, text_sent: str) -> None:
    row = a_scan(name=text_sent)
    with database.transaction() as r:
        r.scans.add(row)
        with pytest.raises(NotFoundError):
            r.scans.get(text_sent)
    with database.reading() as r:
        assert r.scans.get(row.id).name.replace("?", "") in ("twohalves", "half a  pair")
        assert r.scans.count(text_sent) == 1


# --- edits -----------------------------------------------------------------------------------------


def test_edits_are_numbered_within_their_scan(database: Database, scan: str) -> None:
    other = a_scan()
    with database.transaction() as r:
        r.scans.add(other)
        assert r.edits.add(scan, an_edit(scan)) == 1
        assert r.edits.add(other.id, an_edit(other.id)) == 1
        assert r.edits.add(scan, an_edit(scan, kind=EditKind.UNDO, reverts="g1", group="g2")) == 2
    with database.reading() as r:
        first, second = r.edits.of(scan)
        assert (first.revision, first.kind, first.reverts) == (1, EditKind.SET, None)
        assert second == an_edit(scan, revision=2, kind=EditKind.UNDO, reverts="g1", group="g2")
        assert (r.scans.get(scan).revision, r.scans.get(other.id).revision) == (2, 1)


def test_an_edit_that_is_taken_back_with_its_transaction_frees_its_number(
    database: Database, scan: str
) -> None:
    def add_and_fail() -> None:
        with database.transaction() as r:
            r.edits.add(scan, an_edit(scan))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        add_and_fail()
    with database.transaction() as r:
        assert r.edits.add(scan, an_edit(scan)) == 1


def test_writers_at_once_never_get_the_same_number(database: Database, scan: str) -> None:
    numbers: list[int] = []

    def write() -> None:
        for _ in range(10):
            with database.transaction() as r:
                numbers.append(r.edits.add(scan, an_edit(scan)))

    in_threads(write, 4)
    assert sorted(numbers) == list(range(1, 41))


def test_a_locked_scan_keeps_other_writers_out(database: Database, scan: str) -> None:
    order: list[str] = []
    locked = threading.Event()

    def wait_for_the_lock() -> None:
        locked.wait(60)
        with database.transaction() as r:
            r.scans.lock(scan)
            order.append("second")

    waiter = threading.Thread(target=wait_for_the_lock)
    waiter.start()
    with database.transaction() as r:
        r.scans.lock(scan)
        locked.set()
        waiter.join(0.2)  # were there no lock, the other would be through by now
        order.append("first")
    waiter.join(10)
    assert order == ["first", "second"]


def in_threads(work: Callable[[], None], count: int) -> None:
    errors: list[BaseException] = []

    def guarded() -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 (raised again below)
            errors.append(error)

    threads = [threading.Thread(target=guarded) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


# --- runs and decisions ------------------------------------------------------------------------------


def test_a_run_from_start_to_finish(database: Database, scan: str) -> None:
    check = at_least("zones", 3, warning=2, failure=1, sentence="3 zones found.")
    with database.transaction() as r:
        job = a_job(scan)
        r.jobs.add(job)
        run = r.runs.start(scan, "zones", "k1", 2, job.id, versions={"numpy": "2.4"})
    with database.reading() as r:
        begun = r.runs.get(run)
        assert r.runs.unfinished() == [begun]
        assert r.runs.finished(scan, "k1") is None
    assert (begun.status, begun.take, begun.job) == (RunStatus.RUNNING, 2, job.id)
    assert begun.document is None
    with database.transaction() as r:
        r.runs.finish(run, {"peaks": [1.0]}, "h" * 64, [check], 1.5, device={"left": "sim"})
    with database.reading() as r:
        done = r.runs.finished(scan, "k1")
        assert done is not None
        assert r.runs.unfinished() == []
        assert r.runs.latest_failed(scan, "k1") is None
    assert (done.document, done.hash, done.duration_s) == ({"peaks": [1.0]}, "h" * 64, 1.5)
    assert done.checks[0]["level"] == Level.OK
    assert done.versions == {"numpy": "2.4"}
    assert done.device == {"left": "sim"}
    assert done.finished is not None
    assert done.finished >= done.started


def test_a_failed_run_keeps_its_sentence(database: Database, scan: str) -> None:
    with database.transaction() as r:
        run = r.runs.start(scan, "zones", "k1", 0)
        r.runs.fail(run, "Defect in stage zones: see the log", defect=True)
    with database.reading() as r:
        failed = r.runs.latest_failed(scan, "k1")
    assert failed is not None
    assert (failed.error, failed.defect) == ("Defect in stage zones: see the log", True)


@pytest.mark.parametrize("end", ["finish", "fail", "cancel", "interrupt"])
def test_a_run_ends_once(database: Database, scan: str, end: str) -> None:
    arguments: dict[str, tuple[Any, ...]] = {"finish": ({}, "h"), "fail": ("no light",)}
    with database.transaction() as r:
        run = r.runs.start(scan, "zones", "k1", 0)
        r.runs.finish(run, {}, "h")
        with pytest.raises(ValueError, match="is finished already"):
            getattr(r.runs, end)(run, *arguments.get(end, ()))


def test_of_several_runs_with_one_key_the_newest_counts(database: Database, scan: str) -> None:
    with database.transaction() as r:
        for key, number in (("k1", 1), ("k2", 2), ("k1", 3)):
            r.runs.finish(r.runs.start(scan, "zones", key, 0), {"n": number}, "h")
        r.runs.cancel(r.runs.start(scan, "zones", "k1", 0))
    with database.reading() as r:
        by_key = r.runs.finished_by_key(scan)
        newest = r.runs.finished(scan, "k1")
        assert newest is not None
        assert newest.document == {"n": 3}
        assert {key: run.document for key, run in by_key.items()} == {
            "k1": {"n": 3},
            "k2": {"n": 2},
        }
        statuses = [run.status for run in r.runs.of(scan, documents=False)]
        assert [run.document for run in r.runs.of(scan, documents=False)] == [None] * 4
    assert statuses == [RunStatus.FINISHED] * 3 + [RunStatus.CANCELLED]


def test_a_finished_run_has_a_result(database: Database, scan: str) -> None:
    with database.transaction() as r:
        r.runs.start(scan, "zones", "k1", 0)
    with (
        pytest.raises(DBAPIError, match="ck_runs_finished_has_result"),
        database.engine.begin() as c,
    ):
        c.execute(text("UPDATE runs SET status = 'finished'"))


def test_the_last_decision_on_a_key_counts(database: Database, scan: str) -> None:
    with database.transaction() as r:
        run = r.runs.start(scan, "zones", "k1", 0)
        assert r.decisions.last(scan, "k1") is None
        r.decisions.add(scan, run, "zones", "k1", Verdict.REJECT, "stripes", "ada")
        r.decisions.add(scan, run, "zones", "k1", Verdict.ACCEPT, "fine after all", "bob", NOON)
        r.decisions.add(scan, run, "zones", "k2", Verdict.ACCEPT, "", "ada")
    with database.reading() as r:
        last = r.decisions.last(scan, "k1")
        assert last is not None
        assert (last.verdict, last.reason, last.who, last.when) == (
            Verdict.ACCEPT,
            "fine after all",
            "bob",
            NOON,
        )
        assert set(r.decisions.last_by_key(scan)) == {"k1", "k2"}
        assert r.decisions.last_by_key(scan)["k1"] == last
        assert r.decisions.last("another scan", "k1") is None


# --- frames, jobs, audit -------------------------------------------------------------------------------


def test_the_journal_keeps_the_order_of_capture(database: Database, scan: str) -> None:
    with database.transaction() as r:
        for n in (2, 0, 1):
            r.frames.add(a_frame(scan, shot=str(n) * 64))
        r.frames.add(a_frame(scan, take=1))
        r.frames.add(a_frame(scan, stage="pre_exposure"))
    with database.reading() as r:
        assert [f.shot[0] for f in r.frames.of(scan, "fringe_capture", 0)] == ["2", "0", "1"]
        assert r.frames.of(scan, "fringe_capture", 1) == [a_frame(scan, take=1)]
        assert len(r.frames.of_scan(scan)) == 5


def test_one_place_in_the_journal_takes_one_frame(database: Database, scan: str) -> None:
    with database.transaction() as r:
        r.frames.add(a_frame(scan))
        r.frames.add(a_frame(scan, occurrence=1))
    with pytest.raises(IntegrityError, match=r"(?i)unique"), database.transaction() as r:
        r.frames.add(a_frame(scan, artifact="b" * 64))


def test_a_job_from_queue_to_end(database: Database, scan: str) -> None:
    job = a_job(scan, until="zones", unattended=True)
    with database.transaction() as r:
        r.jobs.add(job)
        assert r.jobs.get(job.id) == job
        r.jobs.update(job.id, status=JobStatus.RUNNING, stage="zones")
        r.jobs.update(job.id, progress=0.5, text="12 of 24")
    with database.reading() as r:
        running = r.jobs.get(job.id)
        assert r.jobs.unfinished() == [running]
    assert (running.stage, running.progress, running.text) == ("zones", 0.5, "12 of 24")
    assert running.started is not None
    assert running.ended is None
    with database.transaction() as r:
        ended = r.jobs.update(job.id, status=JobStatus.FAILED, error="no light")
        assert r.jobs.unfinished() == []
    assert ended.ended is not None
    assert ended.ended >= running.started


def test_progress_beyond_the_end_is_refused(database: Database, scan: str) -> None:
    with pytest.raises(DBAPIError, match="ck_jobs_progress"), database.transaction() as r:
        r.jobs.add(a_job(scan, progress=1.5))


def test_the_newest_job_of_each_scan(database: Database, scan: str) -> None:
    other = a_scan()
    later = a_job(scan, created=NOON + timedelta(seconds=1))
    with database.transaction() as r:
        r.scans.add(other)
        assert r.jobs.last_of(scan) is None
        r.jobs.add(later)
        r.jobs.add(a_job(scan))
        r.jobs.add(a_job(other.id))
    with database.reading() as r:
        assert r.jobs.last_of(scan) == later
        assert set(r.jobs.last_of_each([scan, other.id, "nobody"])) == {scan, other.id}
        assert r.jobs.last_of_each([]) == {}


def test_the_audit_trail_keeps_its_order(database: Database, scan: str) -> None:
    with database.transaction() as r:
        r.audit.add(scan, "ada", "created", None, "Made the scan.")
        r.audit.add(scan, "bob", "edited", "zones", "Smoothed more.", {"new": 3.0})
    with database.reading() as r:
        first, second = r.audit.of(scan)
    assert first.sequence < second.sequence
    assert (second.who, second.action, second.stage) == ("bob", "edited", "zones")
    assert (second.sentence, second.details) == ("Smoothed more.", {"new": 3.0})
    assert second.when.tzinfo is not None


def test_counts_over_all_scans(database: Database, scan: str) -> None:
    with database.transaction() as r:
        r.frames.add(a_frame(scan))
        r.jobs.add(a_job(scan))
        for duration_s in (1.5, 2.0):
            r.runs.finish(r.runs.start(scan, "zones", "k1", 0), {}, "h", (), duration_s)
        r.runs.start(scan, "fusion", "k2", 0)
    with database.reading() as r:
        counts = r.statistics.counts()
    assert (counts.scans, counts.frames, dict(counts.jobs)) == (1, 1, {"queued": 1})
    assert [(c.stage, c.status, c.count, c.duration_s) for c in counts.runs] == [
        ("fusion", "running", 1, 0.0),
        ("zones", "finished", 2, 3.5),
    ]


# --- tables that only grow ---------------------------------------------------------------------------


@pytest.fixture
def grown(database: Database, scan: str) -> Database:
    with database.transaction() as r:
        run = r.runs.start(scan, "zones", "k1", 0)
        r.edits.add(scan, an_edit(scan))
        r.decisions.add(scan, run, "zones", "k1", Verdict.ACCEPT, "", "ada")
        r.frames.add(a_frame(scan))
        r.audit.add(scan, "ada", "created", None, "Made the scan.")
    return database


CHANGES = {
    "update": "UPDATE {table} SET stage = 'other'",
    "delete": "DELETE FROM {table}",
    "sqlite": "INSERT OR REPLACE INTO {table} SELECT * FROM {table}",
    "postgresql": "TRUNCATE {table}",
}


@pytest.mark.parametrize("change", ["update", "delete", "in the database's own way"])
@pytest.mark.parametrize("table", APPEND_ONLY)
def test_rows_that_record_what_happened_stay(grown: Database, table: str, change: str) -> None:
    statement = CHANGES.get(change, CHANGES[grown.engine.dialect.name]).format(table=table)
    with (
        pytest.raises(DBAPIError, match=f"{table} only grows: its rows are never changed"),
        grown.engine.begin() as connection,
    ):
        connection.execute(text(statement))
    count = f"SELECT count(*) FROM {table} WHERE stage IS NULL OR stage <> 'other'"
    with grown.engine.connect() as connection:
        assert connection.scalar(text(count)) == 1


# --- calibrations ----------------------------------------------------------------------------------


def keep(r: Repositories, scan: str, run: str, **changes: Any) -> CalibrationRow:
    values: dict[str, Any] = {
        "type_name": "TableHomography",
        "rig": "simulated",
        "facts_hash": "f" * 64,
        "calibration_hash": None,
        "document": {"rows": [1.0, -0.0]},
        "hash": "d" * 64,
        "stage": "table",
        "who": "ada",
    }
    return r.calibrations.add(scan=scan, run=run, **(values | changes))


def test_a_calibration_comes_back_as_it_was_kept(database: Database, scan: str) -> None:
    with database.transaction() as r:
        kept = keep(r, scan, r.runs.start(scan, "table", "k", 1))
    with database.reading() as r:
        assert r.calibrations.get(kept.sequence) == kept
        assert r.calibrations.of_rig("simulated") == (kept,)
        assert r.calibrations.of_rig() == (kept,)
        assert r.calibrations.of_rig("another") == ()
        with pytest.raises(NotFoundError, match="no calibration 999"):
            r.calibrations.get(999)


def test_the_newest_one_that_fits_counts_until_it_is_withdrawn(
    database: Database, scan: str
) -> None:
    def newest(**changes: Any) -> dict[str, int]:
        rig: dict[str, Any] = {"rig": "simulated", "facts_hash": "f" * 64, "calibration_hash": None}
        with database.reading() as r:
            found = r.calibrations.newest(["TableHomography", "Ramp"], **(rig | changes))
        return {name: row.sequence for name, row in found.items()}

    with database.transaction() as r:
        run = r.runs.start(scan, "table", "k", 1)
        old, new = keep(r, scan, run), keep(r, scan, run, hash="e" * 64)
        ramp = keep(r, scan, run, type_name="Ramp", calibration_hash="c" * 64)
        keep(r, scan, run, type_name="Other")
    assert newest() == {"TableHomography": new.sequence}
    assert newest(calibration_hash="c" * 64) == {"Ramp": ramp.sequence}
    assert newest(rig="another") == newest(facts_hash="0" * 64) == {}
    with database.transaction() as r:
        first = r.calibrations.withdraw(new.sequence, "bob")
        again = r.calibrations.withdraw(new.sequence, "eve")
    assert first == again
    assert first.withdrawn_by == "bob"
    assert newest() == {"TableHomography": old.sequence}


def test_a_given_result_tells_its_origin_and_can_be_taken_away(
    database: Database, scan: str
) -> None:
    with database.transaction() as r:
        r.given.add(scan, "Ramp", "Ramp", {"a": 1}, "1" * 64, {"calibration": 3})
    with database.transaction() as r:
        taken = r.given.remove(scan, "Ramp")
        assert r.given.remove(scan, "Ramp") is None
        assert r.given.of(scan) == {}
    assert taken == GivenRow("Ramp", "Ramp", {"a": 1}, "1" * 64, {"calibration": 3})
