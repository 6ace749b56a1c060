"""Commands on a rig whose projector is a page: they serve it themselves, or say who has it."""

import json
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin

from backend.cli.application import run
from backend.domain.errors import StageFailedError
from backend.main import serve_pages
from backend.services import kiosk
from backend.services.kiosk import Kiosk, Monitor
from backend.settings import load_settings
from tests.contract.test_plug_ins import Site, example

__all__ = ["example"]  # pytest finds the fixture here

RIG = """
cameras:
  left: {driver: acme, cell: pages, size: 32x24}
projector: {driver: page, size: 64x48, page: wall}
"""


class Page:
    """What a browser does on the projector's monitor: it tells its size, and acknowledges whatever it is told."""

    def __init__(self, address: str) -> None:
        self.address = httpx.URL(address)
        self.loads = 0
        self.shows = 0

    def open(self) -> None:
        """Work until the server is gone."""
        origin = f"http://{self.address.host}:{self.address.port}"
        with httpx.Client(trust_env=False) as client:
            client.get(self.address)  # the link logs in
            cookie = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
        name = self.address.params["name"]
        with connect(
            f"ws://{self.address.host}:{self.address.port}/ws/projector?name={name}",
            origin=Origin(origin), additional_headers={"Cookie": cookie}, proxy=None, max_size=None,
        ) as connection:  # fmt: skip
            self._work(connection)

    def _work(self, connection: Connection) -> None:
        geometry = {"width_px": 64, "height_px": 48, "ratio": 1.0, "refresh_period_ms": 1000 / 60}
        connection.send(json.dumps({"t": "geometry", **geometry}))
        try:
            for message in connection:
                if isinstance(message, bytes):
                    self.loads += 1
                elif "id" in (asked := json.loads(message)):
                    self.shows += asked["t"] == "show"
                    connection.send(
                        json.dumps({"t": "ack", "id": asked["id"], "geometry": geometry})
                    )
        except ConnectionClosed:
            return


@contextmanager
def command(site: Site, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a command; yields it and the address that it asks to open."""
    process = subprocess.Popen(
        [sys.executable, "-m", "backend.cli", *arguments],
        env=site.environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        said = ""
        for line in process.stderr:
            said += line
            if found := re.search(r"http://\S+/projector\?\S+", line):
                yield process, found.group()
                return
        raise AssertionError(f"no address of a page: {said}")
    finally:
        process.kill()
        process.communicate(timeout=30)


@pytest.fixture
def data(tmp_path: Path) -> str:
    (tmp_path / "data/rigs").mkdir(parents=True)
    (tmp_path / "data/rigs/bench.yaml").write_text(RIG)
    return str(tmp_path / "data")


@pytest.mark.parametrize(
    "arguments",
    [("rigs", "check", "--rig", "bench"), ("scan", "--rig", "bench", "--quiet")],
    ids=["check", "scan"],
)
def test_a_command_serves_the_page_of_its_rig_and_uses_it(
    example: Site, data: str, arguments: tuple[str, ...]
) -> None:
    with command(example, *arguments, "--json", "--data", data) as (process, address):
        page = Page(address)
        threading.Thread(target=page.open, daemon=True).start()
        out, err = process.communicate(timeout=120)
    answer: dict[str, Any] = json.loads(out.splitlines()[-1])
    assert page.loads > 0
    assert page.shows > 0
    # The camera looks into its own cell, which nothing lights: that is what is wrong, and nothing else.
    assert process.returncode == 1, err
    assert re.search("doesn't see the projector|lit by the projector", answer["error"]), answer
    if arguments[0] == "rigs":
        assert [device["name"] for device in answer["devices"]] == ["left", "projector"]


@pytest.mark.parametrize(
    "arguments",
    [("scan",), ("rigs", "check"), ("rigs", "latency"), ("rigs", "conform")],
    ids=" ".join,
)
def test_where_a_server_has_the_page_the_command_says_so(
    data: str, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    settings = load_settings(data_folder=data, port=0)
    with serve_pages(settings, announce=lambda *door: None):
        status = run([*arguments, "--rig", "bench", "--data", data])
    assert status == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == (
        f"unglare: Rig bench shows its patterns in projector page 'wall', and a server runs on {data}: the page is with"
        " that one. Use the rig there, in the browser or by the API, or stop the server first."
    )


def test_a_monitor_is_for_rigs_with_a_page(data: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["rigs", "check", "--rig", "simulated", "--monitor", "2", "--data", data]) == 1
    assert (
        "--monitor 2 is for rigs with a projector page, rig simulated has none"
        in capsys.readouterr().err
    )


def test_a_window_that_the_command_opens_needs_no_particular_port(
    data: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opened(kiosk: Kiosk, monitor: Monitor, address: str, **door: str | None) -> None:
        raise StageFailedError(f"opened {address}")

    monkeypatch.setattr(kiosk, "listed_monitors", lambda: (Monitor("M", 0, 0, 64, 48),))
    monkeypatch.setattr(Kiosk, "opened", opened)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setenv("UNGLARE_PORT", str(taken.getsockname()[1]))
        assert run(["rigs", "check", "--rig", "bench", "--monitor", "1", "--data", data]) == 1
    assert "unglare: opened http://127.0.0.1:" in capsys.readouterr().err
