"""The whole backend of an installation in a folder of its own, everything in this process."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from backend.contract.requests import StartRun
from backend.contract.scans import ScanState, StageState
from backend.jobs.runner import InlineRunner
from backend.main import build_services
from backend.services.services import Services
from backend.settings import load_settings


@contextlib.contextmanager
def real_house(folder: Path) -> Iterator[Services]:
    """Open services with the real methods and rigs."""
    with contextlib.closing(
        build_services(load_settings(data_folder=folder), make_runner=InlineRunner)
    ) as services:
        yield services


def run_unattended(services: Services, scan: str, until: str | None = None) -> ScanState:
    """Run a scan's stages and return its state at the end."""
    services.run(scan, StartRun(until=until, unattended=True), "test")
    return services.wait(scan)


def stage_of(state: ScanState, name: str) -> StageState:
    return next(s for s in state.stages if s.name == name)
