"""What runs in the processes that `test_kill` kills."""

import contextlib
from pathlib import Path

from backend.contract.requests import StartRun
from backend.domain.errors import ConflictError
from backend.jobs.runner import InlineRunner, LocalRunner
from tests.scans.toy_house import House, data_folder


def carry_on(folder: str, scan: str) -> None:
    """Start as the service does after a crash, and run the scan to its end."""
    database, store = data_folder(Path(folder))
    house = House(database, store, InlineRunner)
    house.services.recover()
    with contextlib.suppress(ConflictError):
        house.run(scan, unattended=True)
    house.services.close()


def hang_in_a_worker(folder: str, scan: str) -> None:
    """Start a job whose pure stage never ends, write the worker's process id, and wait to be killed."""
    database, store = data_folder(Path(folder))
    house = House(database, store, LocalRunner)
    runner = house.services.context.runner
    assert isinstance(runner, LocalRunner)
    (worker,) = runner._workers._all
    (Path(folder) / "worker.pid").write_text(str(worker.pid))
    house.services.run(scan, StartRun(unattended=True), "ada")
    house.services.wait(scan, 60.0)
