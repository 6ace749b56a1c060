"""Rules of the house that no linter knows; ARCHITECTURE.md gives the reasons."""

import ast
import io
import re
import tokenize
import types
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

FOLDERS = {"app", "backend", "docker", "frontend_assets", "tests"}
MADE_BY_TOOLS = {"build", "data", "dist"}
"""In .gitignore: not part of the project."""

NAMES_THAT_SAY_NOTHING = {"utils", "util", "helpers", "helper", "common", "misc"}
MOST_CODE_LINES = 600
"""Docstrings, comments and blank lines don't count: a formula explained is no burden."""


def test_top_level_folders_are_the_agreed_ones(root: Path) -> None:
    found = {
        entry.name
        for entry in root.iterdir()
        if entry.is_dir() and not entry.name.startswith((".", "__")) and entry.suffix != ".egg-info"
    }

    assert found - MADE_BY_TOOLS - FOLDERS == set()


def test_every_module_is_named_for_its_subject(sources: tuple[Any, ...]) -> None:
    assert [s.path for s in sources if Path(s.path).stem in NAMES_THAT_SAY_NOTHING] == []


def test_no_file_is_too_long_to_read(sources: tuple[Any, ...]) -> None:
    lines = {source.path: code_lines(source.text, source.tree) for source in sources}

    assert {path: count for path, count in lines.items() if count > MOST_CODE_LINES} == {}


def code_lines(text: str, tree: ast.Module) -> int:
    """Count the lines that do something."""
    strings = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    return sum(
        1
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#") and number not in strings
    )


def test_code_lines_are_those_that_do_something() -> None:
    text = '"""Two\nlines."""\n\n# why\nx = 1\nfor _ in ():\n    pass\n'

    assert code_lines(text, ast.parse(text)) == 3


def test_assets_are_data_without_python(root: Path) -> None:
    assert [str(file) for file in (root / "frontend_assets").rglob("*.py")] == []


def test_every_exception_from_a_check_has_code_and_reason(sources: tuple[Any, ...]) -> None:
    assert list(bare_exceptions(sources)) == []


EXCEPTION = re.compile(r"#\s*(?:ruff: )?(?:noqa|type:\s*ignore)\b(?P<rest>.*)", re.IGNORECASE)
CODE_AND_REASON = re.compile(
    r"(:\s*[A-Z]+\d+([, ]+[A-Z]+\d+)*|\[[a-z, -]+\])"  # which check
    r"[\s#:(-]+\w+.*"  # why
)


def bare_exceptions(sources: Iterable[Any]) -> Iterator[str]:
    """Name the lines that switch a check off without saying which or why."""
    for source in sources:
        for token in tokenize.generate_tokens(io.StringIO(source.text).readline):
            found = EXCEPTION.search(token.string) if token.type == tokenize.COMMENT else None
            if found and not CODE_AND_REASON.fullmatch(found["rest"]):
                yield f"{source.path}:{token.start[0]}"


@pytest.mark.parametrize(
    ("comment", "accepted"),
    [
        ("# noqa: BLE001  foreign code raises what it likes", True),
        ("# ruff: noqa: ANN001, ANN202 - numba takes types from the call", True),
        ("# noqa: D102 (see Runner)", True),
        ("# type: ignore[misc]  # put back what was there", True),
        ("# noqa", False),
        ("# noqa: ANN001, ANN202", False),
        ("# type: ignore", False),
        ("# type: ignore[misc]", False),
    ],
)
def test_what_counts_as_code_and_reason(comment: str, accepted: bool) -> None:
    source = types.SimpleNamespace(path="x.py", text=f"x = 1  {comment}\n")

    assert (list(bare_exceptions([source])) == []) is accepted


def calls(tree: ast.AST, *names: str) -> list[int]:
    """Return the lines on which a function of one of these dotted endings is called."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(names)
    ]


def asks_whether_simulated(tree: ast.AST) -> list[int]:
    """Return the lines of conditions that mention the simulated rig, by name or by string."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.If | ast.IfExp | ast.While)
        and re.search(r"simulated|is_sim\b", ast.unparse(node.test))
    ]


Rule = tuple[str, Callable[[ast.AST], list[int]], str, tuple[str, ...]]

RULES: tuple[Rule, ...] = (
    (
        "only the unit of work commits",
        lambda tree: calls(tree, ".commit"),
        "backend/",
        ("backend/storage/",),
    ),
    (
        "nobody asks whether the rig is simulated",
        asks_whether_simulated,
        "backend/",
        ("backend/devices/sim/",),
    ),
    (
        "nobody asks whether the rig is simulated, nor does the station",
        asks_whether_simulated,
        "app/",
        (),
    ),
    ("tests wait for events, not for time", lambda tree: calls(tree, "time.sleep"), "tests/", ()),
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule[0])
def test_rule(rule: Rule, sources: tuple[Any, ...]) -> None:
    _, offending_lines, folder, exempt = rule
    offences = [
        f"{source.path}:{line}"
        for source in sources
        if source.path.startswith(folder) and not source.path.startswith(exempt or ("\0",))
        for line in offending_lines(source.tree)
    ]

    assert offences == []


@pytest.mark.parametrize(
    ("code", "finds"),
    [
        ("if rig.simulated: pass", True),
        ("x = 1 if rig == 'simulated' else 2", True),
        ("simulated = open_rig()", False),
    ],
)
def test_the_simulated_rule_finds_conditions_and_only_those(code: str, finds: bool) -> None:
    assert bool(asks_whether_simulated(ast.parse(code))) is finds
