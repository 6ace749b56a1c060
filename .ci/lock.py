"""Write the lock files, or check that they fit pyproject.toml.

python .ci/lock.py write [--upgrade]   resolve and write (network; needs uv)
python .ci/lock.py check               compare, without network

Each lock starts with a digest of everything in pyproject.toml that says what is needed, so the check
neither asks a registry nor turns red because somebody published something.
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RUN_LOCK = ROOT / "requirements.lock"
DEV_LOCK = ROOT / "requirements-dev.lock"
DIGEST = "# digest of the dependencies in pyproject.toml: "
HEADER = """\
# {what}
# Written by `make lock`; installed by docker/install-python-packages.sh. Don't edit.
{digest_line}{digest}
"""
# What hatchling asks for besides itself when it builds an editable wheel.
EDITABLE_BACKEND = "editables>=0.5"


class Lock(NamedTuple):
    """One lock file and what goes into it."""

    path: Path
    what: str
    options: tuple[str, ...]


# The development lock first: it asks for more. The run-time lock holds the same versions, so that one
# can follow the other in a virtual environment.
LOCKS = (
    Lock(
        DEV_LOCK, "What unglare needs to run, to be tested and to be developed.", ("--extra=dev",)
    ),
    Lock(
        RUN_LOCK,
        "What unglare needs to run, and what builds its package.",
        ("--extra=postgres", f"--constraint={DEV_LOCK.name}"),
    ),
)


def project() -> dict[str, Any]:
    """Return pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def digest(toml: dict[str, Any]) -> str:
    """Hash all sections that decide what has to be installed; comments and order of tables don't count."""
    needs = [
        toml["project"]["requires-python"],
        toml["project"]["dependencies"],
        toml["project"]["optional-dependencies"],
        toml["build-system"]["requires"],
        EDITABLE_BACKEND,
    ]
    return hashlib.sha256(json.dumps(needs, sort_keys=True).encode()).hexdigest()


def pins(text: str) -> dict[str, set[str]]:
    """Return package -> versions of a lock file's text; several if they depend on the platform."""
    found: dict[str, set[str]] = {}
    for name, version in re.findall(r"^([a-z0-9._-]+)==(\S+)", text, re.MULTILINE):
        found.setdefault(name, set()).add(version)
    return found


def resolve(lock: Lock, toml: dict[str, Any], *, upgrade: bool) -> str:
    """Let uv resolve for all Pythons and platforms at once; without --upgrade it keeps today's pins."""
    command = [
        *("uv", "pip", "compile", "--universal", "--generate-hashes", "--quiet"),
        "--no-config",  # a developer's own indexes have no say here
        "--default-index=https://pypi.org/simple",
        "--no-emit-index-url",
        "--no-emit-find-links",
        "--no-header",
        "--no-annotate",
        # One version of numpy for all Pythons: the same frames give the same hashes everywhere.
        "--fork-strategy=fewest",
        f"--python-version={toml['project']['requires-python'].split(',')[0].lstrip('>=')}",
        f"--output-file={lock.path.name}",
        *(["--upgrade"] if upgrade else []),
        *lock.options,
        "pyproject.toml",
        "-",
    ]
    building = "\n".join([*toml["build-system"]["requires"], EDITABLE_BACKEND])
    subprocess.run(command, cwd=ROOT, input=building, text=True, check=True)  # noqa: S603  fixed command
    return lock.path.read_text(encoding="utf-8")


def write(*, upgrade: bool) -> None:
    """Resolve and write all locks."""
    toml = project()
    for lock in LOCKS:
        body = resolve(lock, toml, upgrade=upgrade)
        body = "".join(line for line in body.splitlines(keepends=True) if not line.startswith("#"))
        header = HEADER.format(what=lock.what, digest_line=DIGEST, digest=digest(toml))
        lock.path.write_text(header + body, encoding="utf-8")


def complaints() -> list[str]:
    """Return what is wrong with the locks, a sentence each."""
    want = digest(project())
    found = []
    for lock in LOCKS:
        text = lock.path.read_text(encoding="utf-8")
        if f"{DIGEST}{want}\n" not in text:
            found.append(f"{lock.path.name} is older than pyproject.toml's dependencies")
        if foreign := re.search(r"^.*(://|\s@\s|^--(?!hash)).*$", text, re.MULTILINE):
            found.append(f"{lock.path.name} names an index or a path: {foreign[0].strip()}")
    dev, run = (pins(lock.path.read_text(encoding="utf-8")) for lock in LOCKS)
    differing = sorted(
        name for name, versions in run.items() if not versions <= dev.get(name, set())
    )
    if differing:
        found.append(f"the two locks differ in {', '.join(differing)}")
    return found


def main() -> int:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("action", choices=["write", "check"])
    parser.add_argument("--upgrade", action="store_true", help="take the newest versions allowed")
    arguments = parser.parse_args()
    if arguments.action == "write":
        write(upgrade=arguments.upgrade)
    found = complaints()
    for sentence in found:
        sys.stderr.write(f"{sentence}; run: make lock\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
