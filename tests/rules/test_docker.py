"""Image and compose file name what exists, and keep to the rules of the house. No engine is needed for that."""

import fnmatch
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from backend.api.health import public
from backend.settings import PREFIX, Settings

FILES = ("docker/Dockerfile", "docker/compose.yaml")
COMPILERS = {"build-essential", "clang", "cmake", "g++", "gcc", "make", "python3-dev"}


class Instruction(NamedTuple):
    """One instruction of a Dockerfile, on one line."""

    name: str
    text: str


@pytest.fixture(scope="module")
def instructions() -> tuple[Instruction, ...]:
    text = Path(__file__).parents[2].joinpath(FILES[0]).read_text(encoding="utf-8")
    lines = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    return tuple(Instruction(*line.split(maxsplit=1)) for line in lines if line.strip())


@pytest.fixture(scope="module")
def last_stage(instructions: tuple[Instruction, ...]) -> tuple[Instruction, ...]:
    start = max(n for n, instruction in enumerate(instructions) if instruction.name == "FROM")
    return instructions[start:]


@pytest.fixture(scope="module")
def variables(last_stage: tuple[Instruction, ...]) -> dict[str, str]:
    """Return the environment of the finished image, as far as the Dockerfile sets it."""
    words = [word for i in last_stage if i.name == "ENV" for word in i.text.split()]
    return dict(word.split("=", 1) for word in words)


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    text = Path(__file__).parents[2].joinpath(FILES[1]).read_text(encoding="utf-8")
    document = yaml.safe_load(text)
    assert isinstance(document, dict)
    return document


@pytest.fixture(scope="module")
def station(compose: dict[str, Any]) -> dict[str, Any]:
    assert list(compose["services"]) == ["station"]
    service = compose["services"]["station"]
    assert isinstance(service, dict)
    return service


def of(instructions: tuple[Instruction, ...], name: str) -> list[str]:
    return [instruction.text for instruction in instructions if instruction.name == name]


def copied(instructions: tuple[Instruction, ...]) -> list[str]:
    """Return what the image takes from the project."""
    copies = [text.split() for text in of(instructions, "COPY") if not text.startswith("--from")]
    return [source.rstrip("/") for words in copies for source in words[:-1]]


def sent(path: str, patterns: list[str]) -> bool:
    """Tell whether `.dockerignore` lets a path pass: the last pattern that fits counts."""
    verdict = True
    parts = path.split("/")
    heads = ["/".join(parts[:n]) for n in range(1, len(parts) + 1)]
    for pattern in patterns:
        fits = any(fnmatch.fnmatchcase(h, pattern.removeprefix("!")) for h in heads)
        verdict = pattern.startswith("!") if fits else verdict
    return verdict


def test_what_is_copied_exists_and_is_sent(
    root: Path, instructions: tuple[Instruction, ...]
) -> None:
    text = (root / ".dockerignore").read_text(encoding="utf-8")
    patterns = [line for line in text.splitlines() if line and not line.startswith("#")]
    paths = copied(instructions)

    assert {"app", "backend", "frontend_assets", "requirements.lock"} <= set(paths)
    assert [path for path in paths if not (root / path).exists()] == []
    assert [path for path in paths if not sent(path, patterns)] == []
    assert [
        path for path in (".env", ".git", ".venv", "data", "tests") if sent(path, patterns)
    ] == []


@pytest.mark.parametrize(
    ("path", "expected"),
    [("app", True), ("app/session.py", True), ("docker/.env", False), ("docker/run.sh", True)],
)
def test_the_last_pattern_that_fits_counts(path: str, expected: bool) -> None:
    assert sent(path, ["*", "!app", "!docker/*.sh"]) is expected


def test_the_image_is_installed_by_the_scripts_of_make(
    root: Path, instructions: tuple[Instruction, ...]
) -> None:
    makefile = (root / "Makefile").read_text(encoding="utf-8")
    runs = " ".join(of(instructions, "RUN"))

    for script in ("docker/install-system-packages.sh", "docker/install-python-packages.sh"):
        assert script in makefile
        assert script in runs
        assert os.access(root / script, os.X_OK)
    assert "requirements.lock /opt/unglare" in runs
    assert re.findall(r"\bapt(?:-get)? install\b|\bpip3? install\b", runs) == []


def test_no_compiler_is_installed(root: Path, instructions: tuple[Instruction, ...]) -> None:
    packages = (root / "docker/packages-run.txt").read_text(encoding="utf-8").split()
    runs = " ".join(of(instructions, "RUN")).split()

    assert COMPILERS.isdisjoint(packages)
    assert COMPILERS.isdisjoint(runs)


def test_python_is_one_that_the_project_supports(instructions: tuple[Instruction, ...]) -> None:
    base = of(instructions, "FROM")[0]

    assert re.fullmatch(r"python:3\.1[123]-slim-bookworm AS system", base)


def test_the_application_is_not_run_by_root(
    last_stage: tuple[Instruction, ...], station: dict[str, Any]
) -> None:
    user, group = of(last_stage, "USER")[-1].split(":")
    runs = " ".join(of(last_stage, "RUN"))

    assert int(user) > 0
    assert f"--uid {user} --gid {group}" in runs
    assert station["user"] == f"{user}:{group}"


def test_what_has_to_be_written_is_on_volumes(
    last_stage: tuple[Instruction, ...],
    variables: dict[str, str],
    compose: dict[str, Any],
    station: dict[str, Any],
) -> None:
    mounts = dict(reversed(mount.split(":")) for mount in station["volumes"])
    owned = next(text for text in of(last_stage, "RUN") if "install --directory" in text).split()
    needed = {variables["UNGLARE_DATA_FOLDER"], variables["NUMBA_CACHE_DIR"]}

    assert station["read_only"] is True
    assert set(mounts) == needed
    assert set(mounts.values()) == set(compose["volumes"])
    assert needed <= set(owned)
    assert yaml.safe_load(of(last_stage, "VOLUME")[0]) == sorted(needed, reverse=True)
    assert variables["MPLCONFIGDIR"].startswith(f"{station['tmpfs'][0]}/")


def test_kernels_are_kept_where_the_image_says(tmp_path: Path) -> None:
    program = "from backend.numerics import decoding_kernels as k, kernels; print(next(v._cache.cache_path for v in vars(k).values() if isinstance(getattr(v, '_cache', None), kernels._SourceCache)))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        text=True,
        capture_output=True,
        check=True,
    )

    assert Path(done.stdout.strip()).is_relative_to(tmp_path)


def test_settings_of_the_application_exist(
    variables: dict[str, str], station: dict[str, Any]
) -> None:
    named = {*variables, *station["environment"]}
    settings = {name.removeprefix(PREFIX).lower() for name in named if name.startswith(PREFIX)}

    assert {"host", "port", "data_folder", "token"} <= settings
    assert settings - Settings.model_fields.keys() == set()


def test_image_and_compose_file_check_health_alike(
    last_stage: tuple[Instruction, ...], variables: dict[str, str], station: dict[str, Any]
) -> None:
    options, command = re.split(r"\s+CMD\s+", of(last_stage, "HEALTHCHECK")[0])
    check = dict(station["healthcheck"])
    addresses = [f"/api{route.path}" for route in public.routes if hasattr(route, "path")]

    assert ["CMD", *yaml.safe_load(command)] == check.pop("test")
    assert dict(re.findall(r"--([a-z-]+)=(\S+)", options)) == {
        name.replace("_", "-"): str(value) for name, value in check.items()
    }
    assert f"http://127.0.0.1:{variables['UNGLARE_PORT']}{addresses[0]}" in command


def test_one_command_and_one_port(
    last_stage: tuple[Instruction, ...], variables: dict[str, str], station: dict[str, Any]
) -> None:
    assert yaml.safe_load(of(last_stage, "CMD")[-1]) == ["unglare", "serve"]
    assert variables["UNGLARE_HOST"] == "0.0.0.0"  # the container's own network
    assert of(last_stage, "EXPOSE") == [variables["UNGLARE_PORT"]]
    assert [port.rpartition(":")[2] for port in station["ports"]] == [variables["UNGLARE_PORT"]]
    assert station["restart"] == "unless-stopped"


def test_the_compose_file_builds_our_image(root: Path, station: dict[str, Any]) -> None:
    context = (root / "docker" / station["build"]["context"]).resolve()

    assert context == root
    assert (context / station["build"]["dockerfile"]).is_file()


def compose_program() -> list[str] | None:
    """Return the command that reads compose files, None where there is none."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]):
            asked = subprocess.run([*command, "version"], capture_output=True, check=False)
            if asked.returncode == 0:
                return command
    return None


def test_compose_accepts_its_file(root: Path) -> None:
    command = compose_program()
    if command is None:
        pytest.skip("Neither docker compose nor docker-compose is installed here.")
    done = subprocess.run(
        [*command, "--file", str(root / FILES[1]), "config"],
        text=True,
        capture_output=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr


def test_hadolint_finds_nothing(root: Path) -> None:
    program = shutil.which("hadolint")
    if program is None:
        pytest.skip("hadolint isn't installed here.")
    done = subprocess.run(
        [program, str(root / FILES[0])], text=True, capture_output=True, check=False
    )

    assert done.returncode == 0, done.stdout
