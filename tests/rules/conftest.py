"""The sources as the rules see them: read once, parsed once."""

import ast
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]


class Source(NamedTuple):
    """One Python file of the project."""

    path: str
    """Relative to the project, with slashes: backend/domain/ids.py"""
    text: str
    tree: ast.Module


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def sources() -> tuple[Source, ...]:
    """Every Python file of app, backend and tests."""
    files = [
        file for folder in ("app", "backend", "tests") for file in (ROOT / folder).rglob("*.py")
    ]
    return tuple(
        Source(file.relative_to(ROOT).as_posix(), text, ast.parse(text))
        for file in sorted(files)
        for text in [file.read_text(encoding="utf-8")]
    )
