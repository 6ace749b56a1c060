"""The lock files fit pyproject.toml, and the check would say so if they didn't."""

import importlib.util
import shutil
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def lock(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the lock tool at work on a copy."""
    specification = importlib.util.spec_from_file_location("lock", root / ".ci" / "lock.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    for name in ("pyproject.toml", "requirements.lock", "requirements-dev.lock"):
        shutil.copy(root / name, tmp_path / name)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    locks = tuple(lock._replace(path=tmp_path / lock.path.name) for lock in module.LOCKS)
    monkeypatch.setattr(module, "LOCKS", locks)
    return module


def replace(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_locks_are_up_to_date(lock: ModuleType) -> None:
    assert lock.complaints() == []


def test_a_comment_in_pyproject_does_not_outdate_the_lock(lock: ModuleType, tmp_path: Path) -> None:
    replace(tmp_path / "pyproject.toml", "# numerics", "# numbers")

    assert lock.complaints() == []


def test_a_new_dependency_outdates_both_locks(lock: ModuleType, tmp_path: Path) -> None:
    replace(tmp_path / "pyproject.toml", "dependencies = [", 'dependencies = [\n"wheel",')

    assert [sentence.split()[0] for sentence in lock.complaints()] == [
        "requirements-dev.lock",
        "requirements.lock",
    ]


@pytest.mark.parametrize(
    "line",
    [
        "--extra-index-url https://example.org/simple",
        "--find-links /wheels",
        "numpy @ file:///wheels/numpy.whl",
    ],
)
def test_a_lock_that_names_an_index_or_a_path_is_refused(
    lock: ModuleType, tmp_path: Path, line: str
) -> None:
    with (tmp_path / "requirements.lock").open("a", encoding="utf-8") as file:
        file.write(line + "\n")

    assert [line in sentence for sentence in lock.complaints()] == [True]


def test_locks_that_differ_in_a_version_are_refused(lock: ModuleType, tmp_path: Path) -> None:
    version = lock.pins((tmp_path / "requirements.lock").read_text(encoding="utf-8"))["numpy"]
    replace(tmp_path / "requirements.lock", f"numpy=={min(version)}", "numpy==0.1")

    assert lock.complaints() == ["the two locks differ in numpy"]


def test_every_locked_package_has_hashes(root: Path) -> None:
    for name in ("requirements.lock", "requirements-dev.lock"):
        lines = (root / name).read_text(encoding="utf-8").splitlines()
        pins = [number for number, line in enumerate(lines) if "==" in line]

        assert pins
        assert [lines[n] for n in pins if not lines[n + 1].startswith("    --hash=sha256:")] == []
