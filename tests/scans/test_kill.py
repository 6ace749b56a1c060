"""Kill -9 at any moment: what was finished or captured counts, nothing is half-written, the scan goes on."""

import itertools
import multiprocessing
import random
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from backend.domain.states import JobStatus
from backend.jobs.runner import InlineRunner
from backend.storage.codec import references
from backend.storage.rows import RunStatus
from tests.scans import killed
from tests.scans.toy_house import House, data_folder, hashes, statuses

KILLS = 20
SETTINGS = {"toy_levels": {"most": 9.0}, "toy_fringes": {"exposures_ms": [1.0, 2.0, 4.0, 8.0]}}
CONTEXT = multiprocessing.get_context("forkserver")
# Forked from a process that has imported everything already: a child takes milliseconds, not seconds.
CONTEXT.set_forkserver_preload(["tests.scans.killed"])


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    """Look at the data from outside; the scans run in other processes."""
    house = House(*data_folder(tmp_path), InlineRunner)
    yield house
    house.services.close()


def start(target: object, house: House, scan: str, tmp_path: Path) -> BaseProcess:
    process = CONTEXT.Process(target=target, args=(str(tmp_path), scan))  # type: ignore[arg-type]  # the tests' own functions
    process.start()
    return process


def look(house: House, scan: str) -> tuple[int, int]:
    """Check that everything the database speaks of is whole; return the numbers of frames and results."""
    with house.shop.database.reading() as repositories:
        frames = repositories.frames.of_scan(scan)
        runs = repositories.runs.of(scan)
    for frame in frames:
        house.shop.store.verify(frame.artifact)
    finished = [run for run in runs if run.status is RunStatus.FINISHED]
    for run in finished:
        for artifact in references(run.document):
            house.shop.store.verify(artifact)
    return len(frames), len({run.key for run in finished})


def test_a_scan_survives_being_killed_at_any_moment(house: House, tmp_path: Path) -> None:
    for _ in range(2):  # the first one waits for the imports of what the others are forked from
        reference = house.create(settings=SETTINGS).id
        began_s = time.monotonic()
        whole = start(killed.carry_on, house, reference, tmp_path)
        whole.join()
        took_s = time.monotonic() - began_s
        assert whole.exitcode == 0
    wanted = hashes(house.services.scan(reference))
    assert set(statuses(house.services.scan(reference)).values()) == {"done"}

    moments = random.Random(5)
    scan, before, in_the_middle = "", (0, 0), 0
    for kills in itertools.count(1):
        if not scan or set(statuses(house.services.scan(scan)).values()) == {"done"}:
            scan, before = house.create(settings=SETTINGS).id, (0, 0)
        began_s = time.monotonic()
        process = start(killed.carry_on, house, scan, tmp_path)
        process.join(moments.uniform(0.0, took_s))
        process.kill()
        process.join()
        if (
            process.exitcode == 0
        ):  # the machine is quicker than it was: the next moments come sooner
            took_s = min(took_s, time.monotonic() - began_s)
        in_the_middle += process.exitcode != 0
        after = look(house, scan)
        assert after >= before, "what counted before still counts"
        before = after
        if kills >= KILLS and in_the_middle >= KILLS // 2:
            break
        assert kills < 5 * KILLS, "most kills have to hit a running scan"

    last = start(killed.carry_on, house, scan, tmp_path)
    last.join()
    assert last.exitcode == 0
    assert hashes(house.services.scan(scan)) == wanted, "the same result as without being killed"
    with house.shop.database.reading() as repositories:
        assert repositories.jobs.unfinished() == []
        assert repositories.runs.unfinished() == []


def test_a_killed_service_leaves_no_worker_and_an_interrupted_job(
    house: House, tmp_path: Path
) -> None:
    scan = house.create(settings={"toy_phase": {"behave": "hang"}}).id
    process = start(killed.hang_in_a_worker, house, scan, tmp_path)
    pause = multiprocessing.Event()
    while statuses(house.services.scan(scan))["phase"] != "running":
        assert process.is_alive()
        pause.wait(0.05)
    process.kill()
    process.join()
    worker = Path("/proc") / (tmp_path / "worker.pid").read_text()
    while worker.exists() and "Z" not in (worker / "stat").read_text().rpartition(")")[2]:
        pause.wait(0.05)

    assert house.services.scan(scan).status == "running", "nobody has looked yet"
    assert house.services.recover() == 1
    state = house.services.scan(scan)
    assert state.job is not None
    assert state.job.status is JobStatus.INTERRUPTED
    assert statuses(state) == {
        "look": "done", "levels": "done", "fringes": "done", "phase": "pending", "cloud": "pending",
    }  # fmt: skip
    assert house.services.audit(scan)[-1].action == "interrupted"
    assert house.services.recover() == 0


def test_a_job_whose_process_is_gone_can_be_cancelled_away(house: House, tmp_path: Path) -> None:
    scan = house.create(settings={"toy_phase": {"behave": "hang"}}).id
    process = start(killed.carry_on, house, scan, tmp_path)
    pause = multiprocessing.Event()
    while statuses(house.services.scan(scan))["phase"] != "running":
        pause.wait(0.05)
    process.kill()
    process.join()
    state = house.services.cancel(scan, "bob")
    assert state.job is not None
    assert state.job.status is JobStatus.INTERRUPTED
