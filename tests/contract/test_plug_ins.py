"""Packages from outside: an example as an author writes it, and every way in which one can be broken."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.contract.test_server_start import server

EXAMPLE = Path(__file__).parents[1] / "example_driver"
BENCH = """
cameras:
  left: {driver: acme, cell: bench, size: 32x24}
  right: {driver: acme, cell: bench, size: 32x24}
projector: {driver: acme, cell: bench, size: 32x20}
"""

BROKEN = {
    # name: its module, and a part of the sentence that says what is wrong with it
    "fails": ("raise RuntimeError('no licence')\n", "can't be loaded (RuntimeError: no licence)"),
    "needs": ("import acme_sdk_that_isnt_there\n", "No module named 'acme_sdk_that_isnt_there'"),
    "exits": ("import sys\nsys.exit('trial version is over')\n", "SystemExit: trial version is over"),
    "interrupts": ("raise KeyboardInterrupt\n", "can't be loaded (KeyboardInterrupt)"),
    "hangs": ("import threading\nthreading.Event().wait()\n", "is still being imported after"),
    "empty": ("", "has no attribute 'make'"),
    "constant": ("make = 3\n", "is a int, not a function that makes a"),
    "schema": ("def make(*_):\n    pass\nmake.options_model = 3\n", "it has to be a pydantic model"),
}  # fmt: skip
MAKING = {
    "nothing": ("def make(*_):\n    return None\n", "a NoneType without name, info"),
    "leaves": ("import sys\ndef make(*_):\n    sys.exit(3)\n", "failed with SystemExit: 3"),
}


@dataclass
class Site:
    """A folder with packages that are installed there."""

    folder: Path

    def add(self, name: str, module: str, entry_points: str, version: str = "1.0") -> None:
        """Install a package without any installer: its module and its metadata."""
        (self.folder / f"{name}_driver.py").write_text(module)
        info = self.folder / f"{name}_driver-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "entry_points.txt").write_text(entry_points)
        if version:
            (info / "METADATA").write_text(
                f"Metadata-Version: 2.1\nName: {name}-driver\nVersion: {version}\n"
            )

    def environment(self) -> dict[str, str]:
        return {**os.environ, "PYTHONPATH": str(self.folder), "UNGLARE_PORT": "0"}

    def python(self, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *arguments], cwd=cwd, env=self.environment(), capture_output=True, text=True, timeout=300
        )  # fmt: skip

    def unglare(self, *commands: tuple[str, ...], cwd: Path) -> list[dict[str, Any]]:
        """Run commands in one new process; return their JSON answers, with their exit status."""
        data = str(cwd / "data")
        script = (
            "import sys\nfrom backend.cli.application import run\n"
            f"for command in {commands!r}:\n"
            f"    status = run([*command, '--json', *(['--data', {data!r}] if command[0] != 'drivers' else [])])\n"
            "    print('status', status, flush=True)\n"
        )
        done = self.python("-c", script, cwd=cwd)
        lines = done.stdout.splitlines()
        assert len(lines) == 2 * len(commands), done.stdout + done.stderr
        return [
            json.loads(answer) | {"status": int(status.split()[1])}
            for answer, status in zip(lines[::2], lines[1::2], strict=True)
        ]


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """The example, installed as its user would: `pip install .`, but beside this Python and without a network."""
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--offline", "--no-deps", "--no-build-isolation",
         "--python", sys.executable, "--target", folder, EXAMPLE],
        check=True, timeout=120,
    )  # fmt: skip
    return Site(folder)


@pytest.fixture(scope="module")
def broken(example: Site, tmp_path_factory: pytest.TempPathFactory) -> Site:
    """Every broken package at once, beside one that works."""
    site = Site(tmp_path_factory.mktemp("broken"))
    for name, (module, _) in (BROKEN | MAKING).items():
        groups = ("rigs", "cameras", "projectors")
        entries = "\n".join(f"[unglare.{group}]\n{name} = {name}_driver:make\n" for group in groups)
        site.add(name, module, entries)
    site.add("torn", "def make(*_):\n    pass\n", "[unglare.rigs]\ntorn = torn_driver:make\n", "")
    site.add("odd", "", "[unglare.rigs]\nodd = not a place at all\n")
    for path in example.folder.iterdir():
        (site.folder / path.name).symlink_to(path)
    return site


# the example


def test_an_installed_package_is_listed_described_and_used(example: Site, tmp_path: Path) -> None:
    (tmp_path / "bench.yaml").write_text(BENCH)
    listed, drivers, added, checked, conforming, refused = example.unglare(
        ("rigs", "list"),
        ("drivers", "acme"),
        ("rigs", "add", "bench.yaml"),
        ("rigs", "check", "--rig", "bench"),
        ("rigs", "conform", "--rig", "bench", "--light"),
        ("rigs", "check", "--rig", "acme-cell", "--rig-option", "siez=9x9"),
        cwd=tmp_path,
    )
    assert ("acme-cell", "unglare-acme 1.0", None) in [
        (rig["name"], rig["doc"], rig["error"]) for rig in listed["rigs"]
    ]
    assert [driver["kind"] for driver in drivers["drivers"]] == ["camera", "projector"]
    options = {option["name"]: option for option in drivers["drivers"][0]["options"]}
    assert options["size"]["values"] == "size, e.g. 1280x800"
    assert options["cell"]["text"] == "Which box it is in."
    assert added["status"] == 0
    assert checked["ok"], checked
    assert conforming["ok"], conforming
    assert sum(test["outcome"] == "passed" for test in conforming["tests"]) > 20
    assert "there is no option 'siez'; the options are cell, size" in refused["error"]


def test_the_suite_runs_by_pytest_as_its_documentation_says(example: Site, tmp_path: Path) -> None:
    suite = "backend.devices.rig_suite"
    common = (
        "-m",
        "pytest",
        "-p",
        "no:dash",
        "-p",
        suite,
        "--pyargs",
        suite,
        "-q",
        "-k",
        "frame or light or names",
    )
    passed = example.python(*common, "--rig", "acme-cell", "--light", cwd=tmp_path)
    assert passed.returncode == 0, passed.stdout + passed.stderr
    assert " passed" in passed.stdout
    nameless = example.python(*common, "-x", cwd=tmp_path)
    assert "say which rig: --rig NAME" in nameless.stdout


# broken ones


def test_no_broken_package_stops_the_lists_or_another_rig(broken: Site, tmp_path: Path) -> None:
    (tmp_path / "bench.yaml").write_text(BENCH)
    listed, drivers, added, checked = broken.unglare(
        ("rigs", "list"), ("drivers",), ("rigs", "add", "bench.yaml"), ("rigs", "check", "--rig", "bench"), cwd=tmp_path
    )  # fmt: skip
    rigs = {rig["name"]: rig["error"] for rig in listed["rigs"]}
    problems = {(d["kind"], d["name"]): d["problem"] for d in drivers["drivers"]}
    for name, (_, sentence) in BROKEN.items():
        assert sentence in rigs[name], name
        for kind in ("camera", "projector"):
            assert sentence in problems[kind, name], (kind, name)
    assert "odd-driver 1.0 can't be loaded" in rigs["odd"]
    assert rigs["torn"] is None, "without version it can be used still"
    assert rigs["acme-cell"] is rigs["simulated"] is None
    assert problems["camera", "acme"] is None
    assert not any("\n" in said for said in (*rigs.values(), *problems.values()) if said)
    assert added["status"] == 0
    assert checked["ok"], checked


def test_whoever_uses_a_broken_package_is_told_why_it_cant_be(broken: Site, tmp_path: Path) -> None:
    told = {
        name: said for name, said in (BROKEN | MAKING).items() if name not in ("hangs", "schema")
    }
    commands = []
    for name in told:
        text = BENCH.replace("driver: acme", f"driver: {name}", 1)
        (tmp_path / f"{name}.yaml").write_text(text)
        commands += [
            ("rigs", "check", "--rig", name),
            ("rigs", "add", f"{name}.yaml", "--name", f"with-{name}"),
        ]
    answers = broken.unglare(*commands, cwd=tmp_path)
    for name, rig, file in zip(told, answers[::2], answers[1::2], strict=True):
        assert (rig["status"], file["status"]) == (1, 1)
        assert told[name][1] in rig["error"], name
        assert told[name][1] in file["error"], name
        assert file["error"].startswith("left: "), file["error"]


def test_a_server_offers_every_rig_and_says_what_is_wrong_with_some(
    broken: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(broken.folder))
    with server(tmp_path) as (_, address, token):
        headers = {"Authorization": f"Bearer {token}"}
        with httpx.Client(base_url=address, headers=headers, trust_env=False, timeout=60) as client:
            offers = {rig["name"]: rig["error"] for rig in client.get("/api/rigs").json()}
            health = client.get("/api/health").json()
            scan = client.post("/api/scans", json={"method": "hdr-fringe", "rig": "fails"})
    assert offers["acme-cell"] is None
    assert "is still being imported" in offers["hangs"]
    assert "SystemExit" in offers["exits"]
    assert {part["name"]: part["status"] for part in health["parts"]}["rig"] == "warning"
    assert scan.status_code == 422
    assert "no licence" in scan.text
