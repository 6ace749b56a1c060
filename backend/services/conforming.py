"""Try a rig by the suite that every rig has to pass."""

import importlib.util
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from backend.devices.protocols import Rig
from backend.domain.errors import StartupError
from backend.domain.shots import Progress
from backend.jobs.rigs import Owner
from backend.services.context import Context

if TYPE_CHECKING:
    import pytest

_SUITE = "backend.devices.rig_suite"


@dataclass(frozen=True)
class Verdict:
    """What one test of the suite found."""

    test: str
    says: str
    """What the test demands."""
    outcome: str
    """`passed`, `failed` or `skipped`."""
    why: str
    """Empty where it passed."""
    where: str
    """File and line of the failure."""


def conform(
    context: Context,
    name: str,
    options: Mapping[str, Any],
    progress: Progress,
    *,
    light: bool,
    exposure_ms: float,
) -> tuple[Verdict, ...]:
    """Run the conformance suite on a rig, on its own thread.

    Parameters
    ----------
    name, options
        The rig.
    progress
        Is told of every test.
    light
        The cameras see something that the projector lights.
    exposure_ms
        At which the white field gives a good picture.

    Raises
    ------
    StartupError
        If pytest isn't installed.
    RigBusyError, DeviceError
        If the rig can't be had.
    """
    if importlib.util.find_spec("pytest") is None:
        raise StartupError("The conformance suite needs pytest; run: pip install pytest")
    with context.rigs.lease(name, options, Owner("", "conformance suite", "rigs conform")) as lease:
        return lease.call(lambda rig: _run(rig, progress, light=light, exposure_ms=exposure_ms))


def _run(rig: Rig, progress: Progress, *, light: bool, exposure_ms: float) -> tuple[Verdict, ...]:
    import pytest

    from backend.devices.rig_suite import MAKE

    class Listening:
        """Hands the rig over, and hears what came of each test."""

        def __init__(self) -> None:
            self.verdicts: list[Verdict] = []
            self.count = 0

        def pytest_configure(self, config: "pytest.Config") -> None:
            config.stash[MAKE] = lambda: rig

        def pytest_collection_finish(self, session: "pytest.Session") -> None:
            self.count = len(session.items)

        def pytest_runtest_logreport(self, report: "pytest.TestReport") -> None:
            if report.when == "call" or report.outcome != "passed":
                self.verdicts.append(_verdict(report))
                progress(len(self.verdicts) / max(self.count, 1), self.verdicts[-1].test)

    listening = Listening()
    with tempfile.TemporaryDirectory() as nowhere:
        # As if nothing were configured: not by the folder that the command is given in, nor by other packages.
        arguments = [
            *("-c", os.devnull, "--rootdir", nowhere, "-p", _SUITE, "--pyargs", _SUITE),
            *(f"--exposure-ms={exposure_ms}", *(["--light"] if light else [])),
            *(f"-pno:{plugin}" for plugin in ("terminal", "cacheprovider", "randomly", "dash", "xdist", "benchmark")),
        ]  # fmt: skip
        pytest.main(arguments, plugins=[listening])
    return tuple(listening.verdicts)


def _verdict(report: "pytest.TestReport") -> Verdict:
    from backend.devices.conformance import RigConformance

    test = report.nodeid.rpartition("::")[2]
    said = getattr(RigConformance, test.partition("[")[0], None)
    says = " ".join((said.__doc__ or test).split()) if said else test
    why, where = "", ""
    if report.outcome == "skipped" and isinstance(report.longrepr, tuple):
        why = str(report.longrepr[2]).removeprefix("Skipped: ")
    elif report.outcome == "failed":
        why, where = _failure(report)
    return Verdict(test, says, report.outcome, why, where)


def _failure(report: "pytest.TestReport") -> tuple[str, str]:
    crash = getattr(report.longrepr, "reprcrash", None)
    if crash is None:
        return " ".join(report.longreprtext.split()[-40:]), ""
    return " ".join(str(crash.message).split()), f"{crash.path}:{crash.lineno}"
