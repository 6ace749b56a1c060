"""The import contracts bite: each forbidden import below breaks the contract that forbids it."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest


class Violation(NamedTuple):
    """One line somewhere that mustn't be there."""

    name: str
    module: str
    line: str
    contract: str


VIOLATIONS = (
    Violation(
        "upwards",
        "backend/domain/ids.py",
        "import backend.services",
        "A module of the backend looks down only",
    ),
    Violation(
        "sideways",
        "backend/storage/__init__.py",
        "import backend.methods",
        "A module of the backend looks down only",
    ),
    Violation(
        "package without layer",
        "backend/stray/__init__.py",
        "",
        "A module of the backend looks down only",
    ),
    Violation(
        "station past the contract",
        "app/__init__.py",
        "from backend.domain import ids",
        "The station knows nothing of the backend",
    ),
    Violation(
        "backend to station",
        "backend/api/__init__.py",
        "import app",
        "The backend never imports the station",
    ),
    Violation(
        "backend to toolkit",
        "backend/services/__init__.py",
        "import viser",
        "The backend never imports the station",
    ),
    Violation(
        "framework in numerics",
        "backend/numerics/__init__.py",
        "import pydantic",
        "Numerics knows no framework",
    ),
    Violation(
        "stage to simulator",
        "backend/stages/__init__.py",
        "import backend.devices.sim",
        "A stage does no I/O",
    ),
)


@pytest.fixture
def skeleton(root: Path, tmp_path: Path) -> Path:
    """Return a copy of the packages without their contents: contracts look at imports alone."""
    for package in ("app", "backend"):
        for file in (root / package).rglob("__init__.py"):
            copy = tmp_path / file.relative_to(root)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.touch()
    (tmp_path / "backend/domain/ids.py").touch()
    (tmp_path / "pyproject.toml").write_bytes((root / "pyproject.toml").read_bytes())
    return tmp_path


def lint_imports(folder: Path) -> str:
    program = str(Path(sys.executable).with_name("lint-imports"))
    command = [program, "--no-cache", "--no-logo"]
    done = subprocess.run(
        command, cwd=folder, text=True, capture_output=True, check=False, env={"PYTHONPATH": "."}
    )
    return done.stdout


def broken(report: str) -> list[str]:
    return [line for line in report.splitlines() if line.endswith("BROKEN")]


def test_the_skeleton_keeps_all_contracts(skeleton: Path) -> None:
    report = lint_imports(skeleton)

    assert " kept, 0 broken" in report, report


@pytest.mark.parametrize("violation", VIOLATIONS, ids=lambda violation: violation.name)
def test_violation_breaks_its_contract(skeleton: Path, violation: Violation) -> None:
    file = skeleton / violation.module
    file.parent.mkdir(exist_ok=True)
    file.write_text(violation.line + "\n", encoding="utf-8")

    found = broken(lint_imports(skeleton))

    assert [line.startswith(violation.contract) for line in found] == [True]
