"""The server as a program: it starts, says where it is, and ends in order; what hinders it is one sentence."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from websockets.sync.client import connect
from websockets.typing import Origin

from backend.contract.requests import CreateScan
from backend.devices.pages import PageDesk
from backend.devices.rig_shelf import RigShelf
from backend.domain.errors import StartupError
from backend.domain.states import JobStatus
from backend.jobs.runner import InlineRunner
from backend.main import build_application, build_services, rig_offers, rig_opener, serve_pages
from backend.settings import Settings, load_settings
from backend.storage.database import utc_now
from backend.storage.rows import JobRow
from tests.scans.toy import Faults, ToyRig

HEAVY = {"open3d", "viser", "pytest", "matplotlib", "plotly", "scipy.interpolate", "scipy.optimize", "scipy.spatial"}  # fmt: skip


def environment(folder: Path, **settings: str) -> dict[str, str]:
    # Without PYTHONUNBUFFERED, as on a plain machine: the address has to come through a pipe at once.
    dropped = ("UNGLARE_", "PYTHONUNBUFFERED")
    kept = {n: v for n, v in os.environ.items() if not n.startswith(dropped)}
    named = {f"UNGLARE_{name.upper()}": value for name, value in settings.items()}
    return kept | {"UNGLARE_DATA_FOLDER": str(folder), "UNGLARE_PORT": "0"} | named


@contextlib.contextmanager
def server(folder: Path, **settings: str) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """Start a server without station; yields process, address and token."""
    process = subprocess.Popen(
        [sys.executable, "-m", "backend.main"],
        env=environment(folder, station="false", **settings),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        address, token = "", ""
        for line in process.stdout:
            if found := re.search(r"(http://[\d.]+:\d+)/\?token=(\S+)", line):
                address, token = found.groups()
                break
        assert address, process.stderr and process.stderr.read()
        yield process, address, token
    finally:
        process.kill()
        process.communicate(timeout=30)


def test_it_serves_with_the_printed_token_and_ends_when_told(tmp_path: Path) -> None:
    with server(tmp_path) as (process, address, token):
        with httpx.Client(base_url=address, trust_env=False, timeout=60) as client:
            me = client.get("/api/me", headers={"Authorization": f"Bearer {token}"}).json()
            status = client.get("/api/health").status_code
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)

    assert (me["role"], status) == ("operator", 200)
    assert len(token) >= 32
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert token not in errors


def test_a_second_server_on_the_same_data_is_kept_out(tmp_path: Path) -> None:
    with server(tmp_path, token="the-chosen-one") as (process, _, token):
        said = failed_start(tmp_path)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)

    assert f"Another server uses the data folder {tmp_path}" in said
    assert token == "the-chosen-one"
    assert process.returncode == 0


def test_what_a_killed_server_left_running_is_interrupted(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    with contextlib.closing(build_services(settings, make_runner=InlineRunner)) as services:
        scan = services.create_scan(CreateScan(method="hdr-fringe"), "Ada").id
        job = JobRow("a job", scan, JobStatus.RUNNING, "Ada", utc_now())
        with services.context.database.transaction() as repositories:
            repositories.jobs.add(job)

    with server(tmp_path) as (_, address, token):
        headers = {"Authorization": f"Bearer {token}"}
        state = httpx.get(
            f"{address}/api/scans/{scan}", headers=headers, trust_env=False, timeout=60
        ).json()

    assert state["job"]["status"] == "interrupted"
    assert "run again to go on" in state["job"]["error"]


def test_a_port_in_use_is_a_sentence_and_a_status(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]

        said = failed_start(tmp_path, port=str(port))

    assert said.startswith(f"Port {port} of 127.0.0.1 is in use by another program; stop that one")
    assert said.count("\n") == 0
    assert not list(tmp_path.iterdir())


def failed_start(folder: Path, **settings: str) -> str:
    """Start a server that can't start; return what it said."""
    done = subprocess.run(
        [sys.executable, "-m", "backend.main"],
        env=environment(folder, station="false", **settings),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    return done.stderr.strip()


def settings_in(folder: Path, **given: object) -> Settings:
    return load_settings(data_folder=folder, token="long enough", **given)


def test_a_folder_that_cant_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    with pytest.raises(StartupError, match=r"data folder .*file/data can't be made"):
        build_services(settings_in(tmp_path / "file" / "data"))


def test_a_database_that_cant_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(StartupError, match="database"):
        build_services(settings_in(tmp_path, database_url="nonsense://"))


def test_the_stations_own_rig_is_offered_first_and_opened_with_its_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[str, dict[str, object]]] = []

    def note(name: str, options: dict[str, object]) -> ToyRig:
        opened.append((name, options))
        return ToyRig(name, options, Faults())

    monkeypatch.setattr("backend.devices.rig_shelf.open_rig", note)
    settings = settings_in(tmp_path, rig="lab.rigs:shiny", rig_options={"port": 7, "fast": True})

    shelf = RigShelf(tmp_path / "rigs", PageDesk())
    opener = rig_opener(settings, shelf)
    opener("lab.rigs:shiny", {"fast": False})
    opener("simulated", {"seed": 1})

    assert [offer.name for offer in rig_offers(settings, shelf)][:2] == [
        "lab.rigs:shiny",
        "simulated",
    ]
    assert opened == [
        ("lab.rigs:shiny", {"port": 7, "fast": False}),
        ("simulated", {"seed": 1}),
    ]


def test_a_command_may_serve_projector_pages_by_itself(tmp_path: Path) -> None:
    said: list[tuple[str, str]] = []

    def announce(*door: str) -> None:
        said.append((door[0], door[1]))

    with serve_pages(settings_in(tmp_path, port=0), announce=announce) as (_, pages):
        address = httpx.URL(f"{said[0][0]}/projector", params={"token": said[0][1]})
        with httpx.Client(trust_env=False) as client:
            assert client.get(address).status_code == 303
            cookie = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
        origin = f"http://{address.host}:{address.port}"
        with connect(
            f"ws://{address.host}:{address.port}/ws/projector?name=bench",
            origin=Origin(origin),
            additional_headers={"Cookie": cookie},
            proxy=None,
        ):
            assert pages.find("bench", 10.0) is not None
        with (
            pytest.raises(StartupError, match="Another server uses the data folder"),
            serve_pages(settings_in(tmp_path, port=0), announce=announce),
        ):
            pass


def test_without_any_token_there_is_no_application(tmp_path: Path) -> None:
    settings = load_settings(data_folder=tmp_path)
    services = build_services(settings, make_runner=InlineRunner)

    with contextlib.closing(services), pytest.raises(StartupError, match="no token"):
        build_application(settings, services, port=8000)


def test_importing_the_application_takes_nothing_heavy_along() -> None:
    code = "import sys, backend.main; print(*sys.modules)"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert HEAVY & set(done.stdout.split()) == set()


def test_importing_the_application_takes_less_than_two_seconds() -> None:
    # As a ratio, because machines differ and are busy: of all that the application imports, numpy
    # is the part whose share everybody knows (0.08 s on a machine that does the whole in 1.2 s).
    def cpu_s(module: str) -> float:
        code = f"import {module}, time; print(time.process_time())"
        runs = [
            subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
            for _ in range(2)
        ]
        return min(float(run.stdout) for run in runs)

    assert cpu_s("backend.main") < 25 * cpu_s("numpy")
