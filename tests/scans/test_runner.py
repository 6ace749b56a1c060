"""Jobs in the service's way: a thread per job, the rig's own thread, a worker process for pure stages."""

import logging
import os
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest

from backend.contract.events import Event, JobProgress, RigChanged, ScanChanged
from backend.contract.requests import StartRun
from backend.devices.errors import DeviceNotFound
from backend.domain.errors import ConflictError, RigBusyError
from backend.domain.states import JobStatus
from backend.jobs.control import JobControl
from backend.jobs.runner import InlineRunner
from backend.jobs.stage_work import StageTask
from backend.jobs.worker import Worker, WorkerSetup
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.database import Database
from tests.scans.toy import toy_registry
from tests.scans.toy_house import Gate, House, inline_house, local_house, stage, statuses, waiting

WAIT_S = 30.0


@pytest.fixture(params=["inline", "local"])
def any_house(
    request: pytest.FixtureRequest, sqlite_database: Database, store: LocalArtifactStore
) -> Iterator[House]:
    """Run pure stages in this process, then in a worker."""
    make = inline_house if request.param == "inline" else local_house
    with make(sqlite_database, store) as house:
        yield house


@pytest.fixture
def local(sqlite_database: Database, store: LocalArtifactStore) -> Iterator[House]:
    with local_house(sqlite_database, store) as house:
        yield house


def test_both_runners_make_the_same_results(
    sqlite_database: Database, store: LocalArtifactStore
) -> None:
    found = []
    for make in (inline_house, local_house):
        with make(sqlite_database, store) as house:
            state = house.run_through(house.create().id)
            found.append([s.result_hash for s in state.stages])
            house.shop.database.engine.dispose()
    assert found[0] == found[1]
    assert None not in found[0]


def test_a_scan_runs_on_every_database(database: Database, store: LocalArtifactStore) -> None:
    with inline_house(database, store) as house:
        state = house.run_through(house.create().id)
        state = house.undo(house.edit(house.redo(state, "toy_fringes"), "toy_levels", step_gray=32))
        state = house.run_through(state.id)
        assert set(statuses(state).values()) == {"done", "accepted"}
        assert house.services.scans()[0].status == "done"
        assert house.services.statistics().frames == 2 * (4 + 8 + 8)


SENTENCES = [
    ("numerics", "frequency 0 has no phase: give one above 0", False),
    ("sentence", "The picture is black: open the iris.", False),
    ("memory", "Phase needs more memory than there is: close other programs or use smaller pictures.", False),
    ("defect", "Defect in stage toy_phase: ZeroDivisionError: division by zero; see the log.", True),
]  # fmt: skip


@pytest.mark.parametrize(("behave", "sentence", "defect"), SENTENCES)
def test_a_failing_stage_ends_in_one_sentence(
    any_house: House, behave: str, sentence: str, defect: bool, caplog: pytest.LogCaptureFixture
) -> None:
    scan = any_house.create(settings={"toy_phase": {"behave": behave}}).id
    with caplog.at_level(logging.ERROR):
        state = any_house.run(scan)
    failed = stage(state, "toy_phase")
    assert (failed.status, failed.message, state.status) == ("failed", sentence, "failed")
    assert state.job is not None
    assert (state.job.status, state.job.error) == ("failed", sentence)
    assert statuses(state)["fringes"] == "done", "the stages before keep their results"
    assert ("Traceback" in caplog.text) == defect
    assert [e.action for e in any_house.services.audit(scan)][-1] == "failed"
    with any_house.shop.database.reading() as repositories:
        assert repositories.runs.get(failed.stage_run or "").defect == defect
    any_house.edit(state, "toy_phase", behave="well")
    assert waiting(any_house.run(scan)) is not None


def test_a_worker_that_dies_is_replaced(local: House) -> None:
    scan = local.create(settings={"toy_phase": {"behave": "die"}}).id
    state = local.run(scan)
    assert stage(state, "toy_phase").message == (
        "The worker process died in stage toy_phase (exit code 3), perhaps out of memory: "
        "close other programs or use smaller pictures, then run again."
    )
    local.edit(state, "toy_phase", behave="well")
    assert waiting(local.run(scan)) is not None


def when(house: House, text: str) -> threading.Event:
    """Return what is set as soon as a job tells that text."""
    seen = threading.Event()

    def look(event: Event) -> None:
        if isinstance(event, JobProgress) and text in event.job.text:
            seen.set()

    house.watchers.append(look)
    return seen


@pytest.mark.parametrize(("behave", "text"), [("report", "reports for ever"), ("hang", "hangs")])
def test_a_pure_stage_is_cancelled_whether_it_listens_or_not(
    local: House, behave: str, text: str
) -> None:
    seen = when(local, text)
    scan = local.create(settings={"toy_phase": {"behave": behave}}).id
    local.services.run(scan, StartRun(), "ada")
    assert seen.wait(WAIT_S)
    state = local.services.scan(scan)
    assert (statuses(state)["phase"], state.status) == ("running", "running")
    assert stage(state, "toy_phase").message == f"Running: {text}."
    local.services.cancel(scan, "bob")
    state = local.services.wait(scan, WAIT_S)
    assert state.job is not None
    assert (state.job.status, state.job.who) == ("cancelled", "ada")
    assert statuses(state)["phase"] == "pending"
    assert stage(state, "toy_phase").message.startswith("Cancelled: captured frames are kept")
    last = local.services.audit(scan)[-1]
    assert (last.action, last.who, last.stage) == ("cancelled", "bob", "toy_phase")
    local.edit(state, "toy_phase", behave="well")
    assert waiting(local.run(scan)) is not None, "the next stage finds a worker"


def test_a_capture_is_cancelled_and_the_rig_is_usable(local: House) -> None:
    gate = Gate(local.rigs, shot=7)
    scan = local.create().id
    local.services.run(scan, StartRun(), "ada")
    assert gate.reached.wait(WAIT_S)
    local.services.cancel(scan, "bob")
    gate.open.set()
    state = local.services.wait(scan, WAIT_S)
    assert statuses(state)["fringes"] == "pending"
    taken = local.rigs.shots
    state = local.run(scan)
    assert statuses(state)["fringes"] == "done"
    assert local.rigs.shots < taken + 8, "captured frames count"


def test_one_job_at_a_time_per_scan(local: House) -> None:
    gate = Gate(local.rigs, shot=7)
    state = local.create()
    local.services.run(state.id, StartRun(), "ada")
    assert gate.reached.wait(WAIT_S)
    sentence = "A run of 'part' that ada started is going on at Fringes: wait for it or cancel it."
    with pytest.raises(ConflictError, match=sentence) as caught:
        local.services.run(state.id, StartRun(), "bob")
    assert caught.value.details["who"] == "ada"
    with pytest.raises(ConflictError, match=sentence):
        local.redo(state, "toy_look")
    gate.open.set()
    local.services.wait(state.id, WAIT_S)


def test_an_edit_made_while_a_job_runs_counts(local: House) -> None:
    gate = Gate(local.rigs, shot=7)
    state = local.create()
    local.services.run(state.id, StartRun(unattended=True), "ada")
    assert gate.reached.wait(WAIT_S)
    local.edit(state, "toy_levels", who="bob", step_gray=16)
    gate.open.set()
    state = local.services.wait(state.id, WAIT_S)
    assert statuses(state)["cloud"] == "done"
    assert stage(state, "toy_levels").settings["step_gray"].value == 16


def test_one_capture_at_a_time_per_rig(local: House) -> None:
    gate = Gate(local.rigs, shot=2)
    first, second = local.create(name="bracket").id, local.create(name="cover").id
    local.services.run(first, StartRun(), "ada")
    assert gate.reached.wait(WAIT_S)
    sentence = (
        "Rig 'toy' is busy: ada captures scan 'bracket'; wait until that is done or cancel it."
    )
    with pytest.raises(RigBusyError, match=sentence) as caught:
        local.services.run(second, StartRun(), "bob")
    assert caught.value.details == {"scan": first, "who": "ada"}
    assert local.services.scan(second).job is None, "nothing is left of a refused run"
    gate.open.set()
    local.services.wait(first, WAIT_S)
    assert statuses(local.run(second))["look"] == "done"


def test_the_rig_is_free_while_pure_stages_run(local: House) -> None:
    seen = when(local, "hangs")
    slow = local.create(settings={"toy_phase": {"behave": "hang"}}).id
    local.services.run(slow, StartRun(), "ada")
    assert seen.wait(WAIT_S)
    state = local.run(local.create().id, until="toy_look")
    assert statuses(state)["look"] == "done"
    local.services.cancel(slow, "ada")
    local.services.wait(slow, WAIT_S)


def test_a_busy_rig_doesnt_keep_a_scan_from_being_made(local: House) -> None:
    """The rig captures with other options: its facts are asked at the scan's first run."""
    gate = Gate(local.rigs, shot=2)
    busy = local.create(name="bracket").id
    local.services.run(busy, StartRun(), "ada")
    assert gate.reached.wait(WAIT_S)
    later = local.create(rig_options={"noise": True})
    assert stage(later, "toy_look").message == "Not run yet: the rig is asked for its facts first."
    assert set(statuses(later).values()) == {"pending"}
    gate.open.set()
    assert statuses(local.services.wait(busy, WAIT_S))["look"] == "done"
    assert waiting(local.run(later.id)) is not None
    assert [rig.closed for rig in local.rigs.opened] == [1, 0], "one rig of a name is open"


def test_a_slow_rig_doesnt_keep_a_scan_from_being_made(house: House) -> None:
    """It is opened in the background, and what it says follows."""
    ready, known = threading.Event(), threading.Event()
    house.rigs.faults.before_open = lambda: assert_true(ready.wait(WAIT_S))
    house.services.context = replace(house.services.context, rig_patience_s=0.0)
    state = house.create()
    assert stage(state, "toy_look").key is None
    house.watchers.append(lambda event: known.set() if isinstance(event, RigChanged) else None)
    ready.set()
    assert known.wait(WAIT_S)
    house.shop.rigs.use(
        "toy", {}, lambda rig: None
    )  # after what the rig's thread does with the answer
    assert stage(house.services.scan(state.id), "toy_look").key is not None


def test_a_rig_that_doesnt_answer_in_time_is_told_by_the_first_run(house: House) -> None:
    ready = threading.Event()

    def fail() -> None:
        ready.wait(WAIT_S)
        raise DeviceNotFound("left", "nothing answers at 10.0.0.2; check its cable")

    house.rigs.faults.before_open = fail
    house.services.context = replace(house.services.context, rig_patience_s=0.0)
    scan = house.create().id
    ready.set()
    state = house.run(scan)
    assert state.job is not None
    assert state.job.error == "left: nothing answers at 10.0.0.2; check its cable"
    assert set(statuses(state).values()) == {"pending"}
    house.rigs.faults.before_open = lambda: None
    assert waiting(house.run(scan)) is not None


def assert_true(value: bool) -> None:
    assert value


def test_nothing_to_cancel(local: House) -> None:
    scan = local.create().id
    with pytest.raises(ConflictError, match="Nothing runs in 'part'"):
        local.services.cancel(scan, "ada")


def test_closing_interrupts_and_the_next_start_goes_on(
    sqlite_database: Database, store: LocalArtifactStore
) -> None:
    house = House(sqlite_database, store, InlineRunner)
    gate = Gate(house.rigs, shot=7)
    scan = house.create().id
    job = threading.Thread(target=house.services.run, args=(scan, StartRun(), "ada"))
    job.start()
    assert gate.reached.wait(WAIT_S)
    runner = house.services.context.runner
    assert isinstance(runner, InlineRunner)
    control = next(iter(runner._started.values())).execution.control
    with control.when_stopped(gate.open.set):
        runner.close()
    job.join()
    state = house.services.scan(scan)
    assert state.job is not None
    assert state.job.status == "interrupted"
    assert stage(state, "toy_fringes").message == (
        "Interrupted: captured frames are kept, run again to go on."
    )
    house.services.context.rigs.close()
    with inline_house(sqlite_database, store) as again:
        assert waiting(again.run(scan)) is not None
        assert house.rigs.shots + again.rigs.shots <= 5 + 8 + 1


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Let SIGINT be what Ctrl+C sends: programs that a shell starts in the background ignore it from birth."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_on_the_command_line_cancels_and_keeps_the_frames(house: House) -> None:
    runner = house.services.context.runner
    assert isinstance(runner, InlineRunner)

    def press(shot: int) -> None:
        if shot == 7:
            (job,) = runner._started.values()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            assert job.execution.control._stopping.wait(WAIT_S)

    house.rigs.faults.before_shot = press
    scan = house.create().id
    with pytest.raises(KeyboardInterrupt):
        house.services.run(scan, StartRun(), "ada")
    state = house.services.scan(scan)
    assert state.job is not None
    assert state.job.status == "cancelled"
    assert statuses(state)["fringes"] == "pending"
    house.rigs.faults.before_shot = lambda shot: None
    taken = house.rigs.shots
    assert waiting(house.run(scan)) is not None
    assert house.rigs.shots < taken + 8


def test_events_tell_every_change_and_not_too_many(local: House) -> None:
    scan = local.create().id
    local.run(scan)
    changes = [e for e in local.events if isinstance(e, ScanChanged)]
    progress = [e.job for e in local.events if isinstance(e, JobProgress)]
    assert len(changes) >= 1 + 4 * 2
    assert progress[-1].status is JobStatus.AWAITING_REVIEW
    assert {p.stage for p in progress} >= {"toy_look", "toy_levels", "toy_fringes", "toy_phase"}
    assert all(0 <= p.progress <= 1 for p in progress)


# the worker alone


@pytest.fixture
def worker(store: LocalArtifactStore) -> Iterator[Worker]:
    worker = Worker(WorkerSetup(toy_registry, store))
    yield worker
    worker.close()


def task(house: House, behave: str = "well") -> StageTask:
    """Make a task of a scan's phase stage."""
    state = house.run(house.create().id, until="toy_fringes")
    with house.shop.database.reading() as repositories:
        documents = {
            name: repositories.runs.get(stage(state, f"toy_{name}").stage_run or "").document
            for name in ("fringes", "levels")
        }
    return StageTask("toy", "toy_phase", {"behave": behave}, documents)


def test_a_worker_runs_one_task_after_another(house: House, worker: Worker) -> None:
    order = task(house)
    first = worker.run(order, JobControl())
    again = worker.run(order, JobControl())
    assert first.hash == again.hash
    assert first.document["mean_rad"] == again.document["mean_rad"]


def test_a_worker_ends_with_its_parent(worker: Worker) -> None:
    """What a killed parent looks like to the worker: the end of the pipe."""
    process = worker._process
    worker._pipe.close()
    process.join(WAIT_S)
    assert process.exitcode == 0
    worker._spawn()


def test_a_worker_killed_between_tasks_is_replaced(house: House, worker: Worker) -> None:
    order = task(house)
    assert worker.pid
    os.kill(worker.pid, signal.SIGKILL)
    worker._process.join(WAIT_S)
    assert worker.run(order, JobControl()).hash
