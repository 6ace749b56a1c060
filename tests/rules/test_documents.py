"""README, ARCHITECTURE and the decision records name what exists."""

import json
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import typer
from pydantic import TypeAdapter

from backend.contract.capture import Capture
from backend.domain.patterns import Pattern
from backend.settings import PREFIX, Settings

DOCUMENTS = ("README.md", "ARCHITECTURE.md")
OF_OTHER_PROGRAMS = {"UNGLARE_DATA", "UNGLARE_PUBLISH"}
"""Read by the tests and by the compose file, not by the application."""


@pytest.fixture(scope="module")
def readme() -> str:
    return Path(__file__).parents[2].joinpath("README.md").read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def shell_lines(text: str) -> Iterator[list[str]]:
    """Return the words of every command in the shell blocks, and of those in backticks."""
    lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    for line in lines + inline:
        if re.match(r"(make|unglare|docker) ", line):
            yield shlex.split(line, comments=True)


def test_the_readme_opens_with_the_two_commands(readme: str) -> None:
    commands = [words[:2] for words in shell_lines(readme)][:2]

    assert readme.index("```sh") < 20
    assert commands == [["make", "demo"], ["make", "test"]]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_targets_of_make_exist(root: Path, document: str) -> None:
    makefile = (root / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)[0].split())
    text = (root / document).read_text(encoding="utf-8")
    named = {words[1] for words in shell_lines(text) if words[0] == "make"}

    assert named <= targets
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in named)


@pytest.fixture(scope="module")
def commands() -> Mapping[str, Any]:
    """Return the commands of the command line with their options."""
    from backend.cli.application import application

    group: Any = typer.main.get_command(application)
    known: Mapping[str, Any] = group.commands
    return known


@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_and_options_exist(root: Path, document: str, commands: Mapping[str, Any]) -> None:
    text = (root / document).read_text(encoding="utf-8")
    for words in shell_lines(text):
        if words[0] != "unglare" or words[1] == "COMMAND":
            continue
        command = meant(commands, words[1:])
        assert command is not None, words
        options = {option for p in command.params for option in p.opts}
        assert {w for w in words[2:] if w.startswith("--")} - options == set(), words


def meant(commands: Mapping[str, Any], words: list[str]) -> Any:
    """Return the command that words name, also one of a group."""
    command = commands.get(words[0])
    group = getattr(command, "commands", None)
    return meant(group, words[1:]) if group and len(words) > 1 else command


def test_every_command_is_shown(readme: str, commands: Mapping[str, Any]) -> None:
    shown = {words[1] for words in shell_lines(readme) if words[0] == "unglare"}

    assert shown - {"COMMAND"} == set(commands)


def test_settings_of_stages_in_examples_hold(readme: str) -> None:
    from backend.cli.options import parse_settings
    from backend.jobs.edits import check_recipe
    from backend.methods import registry

    method = registry().get("hdr-fringe")
    for words in shell_lines(readme):
        given = [words[n + 1] for n, word in enumerate(words) if word == "--set"]
        check_recipe(method, None, parse_settings(given), lambda _: True)


def test_the_stages_are_those_of_the_method(readme: str) -> None:
    from backend.methods import registry

    table = re.findall(r"^\| `(\w+)` \| .* \| (always|on a \w+) \|$", readme, re.MULTILINE)
    stages = registry().get("hdr-fringe").stages

    assert [(name, rule.replace(" a ", "_")) for name, rule in table] == [
        (stage.name, stage.review.value) for stage in stages
    ]


def test_the_capture_in_the_readme_can_be_imported(readme: str) -> None:
    examples = [json.loads(block) for block in blocks(readme, "json")]

    assert [Capture.model_validate(example).method for example in examples] == ["hdr-fringe"]


def test_the_patterns_in_the_readme_are_patterns(readme: str) -> None:
    pattern: TypeAdapter[Any] = TypeAdapter(Pattern)
    examples = [json.loads(text) for text in re.findall(r"`(\{\"kind\".*?\})`", readme)]
    kinds = [pattern.validate_python(example).kind for example in examples]

    assert sorted(kinds) == ["gray", "picture", "sine", "stripe", "uniform"]


def test_addresses_of_the_api_exist(root: Path, readme: str) -> None:
    known = json.loads((root / "tests/golden/openapi.json").read_text(encoding="utf-8"))["paths"]
    paths = [re.sub(r"\{\w+\}", r"[^/]+", path) for path in known]
    paths += ["/api/docs", "/api/openapi.json"]
    named = set(re.findall(r"/api/[\w$./-]+", readme))

    assert len(named) > 5
    assert [n for n in sorted(named) if not any(re.fullmatch(p, n) for p in paths)] == []


def test_every_setting_is_explained(readme: str) -> None:
    named = set(re.findall(r"UNGLARE_[A-Z_]+", readme)) - OF_OTHER_PROGRAMS

    assert named == {PREFIX + name.upper() for name in Settings.model_fields}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(root: Path, document: str) -> None:
    text = (root / document).read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#]+)\)", text)

    assert [t for t in targets if "://" not in t and not (root / t).is_file()] == []


@pytest.mark.parametrize("document", DOCUMENTS)
def test_paths_exist(root: Path, document: str) -> None:
    text = (root / document).read_text(encoding="utf-8")
    words = re.findall(r"`([\w./-]+)`", text)
    tops = ("app", "backend", "docker", "frontend_assets", "tests")
    paths = [word for word in words if word.startswith(tuple(f"{top}/" for top in tops))]

    assert paths
    assert [path for path in paths if not (root / path).exists()] == []


def test_decisions_are_numbered_without_gaps(root: Path) -> None:
    files = sorted(file.name for file in (root / "backend/decisions").iterdir())
    numbers = [re.match(r"(\d{4})-[a-z0-9-]+\.md$", name) for name in files]

    assert [found and int(found[1]) for found in numbers] == list(range(1, len(files) + 1))


def test_decisions_bear_their_number_and_say_what_was_decided(root: Path) -> None:
    for file in (root / "backend/decisions").iterdir():
        text = file.read_text(encoding="utf-8")

        assert text.startswith(f"# {int(file.name[:4])} "), file.name
        assert re.search(r"^\*\*Decision", text, re.MULTILINE), file.name


def test_decisions_that_are_referred_to_exist(root: Path, sources: tuple[Any, ...]) -> None:
    named = {
        (source.path, name)
        for source in sources
        for name in re.findall(r"decisions/(\d{4}-[a-z0-9-]+\.md)", source.text)
    }

    assert [n for n in sorted(named) if not (root / "backend/decisions" / n[1]).is_file()] == []
