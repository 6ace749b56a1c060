"""The station's process, and the private details of viser that it stands on."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
import viser
import viser._messages as viser_messages
import websockets.asyncio.server as websocket_server

from app import station

SECRET = "known to proxy and station"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    running = station.start(SECRET)
    yield running
    running.stop()


def test_only_who_knows_the_secret_gets_an_answer(server: viser.ViserServer) -> None:
    url = f"http://127.0.0.1:{server.get_port()}/"
    with httpx.Client(trust_env=False) as client:
        assert client.get(url).status_code == 403
        assert client.get(url, headers={station.SECRET_HEADER: "guessed"}).status_code == 403
        assert client.get(url, headers={station.SECRET_HEADER: SECRET}).status_code == 200


def test_it_listens_on_loopback_only(server: viser.ViserServer) -> None:
    assert server.get_host() == "127.0.0.1"


def test_nobody_can_ask_for_a_public_tunnel(server: viser.ViserServer) -> None:
    handlers = server._websock_server._incoming_handlers

    assert handlers.get(viser_messages.ShareUrlRequest, []) == []
    assert handlers.get(viser_messages.ShareUrlDisconnect, []) == []


def test_the_library_s_own_serve_is_put_back() -> None:
    before = websocket_server.serve
    with station.guarded_serve(SECRET):
        assert websocket_server.serve is not before
    assert websocket_server.serve is before


def test_a_control_s_id_is_its_element_s(server: viser.ViserServer) -> None:
    button = server.gui.add_button("x")

    assert len(station.element_id(button)) > 8
    button.remove()


def client_with(headers: dict[str, str] | None) -> Any:
    request = None if headers is None else SimpleNamespace(headers=headers)
    sockets = SimpleNamespace(_live_connections={3: SimpleNamespace(request=request)})
    return SimpleNamespace(client_id=3, _viser_server=SimpleNamespace(_websock_server=sockets))


def test_the_proxy_s_introduction_is_read() -> None:
    headers = {
        "X-Station-User": "Zo%C3%AB%20%3Cb%3E",
        "X-Station-Role": "operator",
        "X-Station-Token": "t",
    }
    who = station.introduction_of(client_with(headers))

    assert who == station.Introduction("Zoë <b>", "operator", "t")
    assert who.may_operate


def test_who_isn_t_introduced_is_a_viewer_or_nobody() -> None:
    who = station.introduction_of(client_with({}))

    assert who is not None
    assert not who.may_operate
    assert station.introduction_of(client_with(None)) is None


def test_viser_keeps_the_headers_of_a_connection(server: viser.ViserServer) -> None:
    assert server._websock_server._live_connections == {}


@pytest.fixture
def process() -> Iterator[subprocess.Popen[str]]:
    environment = os.environ | {
        "UNGLARE_STATION_SECRET": SECRET,
        "UNGLARE_API_URL": "http://127.0.0.1:9",
    }
    with subprocess.Popen(
        [sys.executable, "-m", "app"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as started:  # fmt: skip
        yield started
        started.kill()


def test_the_process_reports_its_port_and_ends_with_its_input(
    process: subprocess.Popen[str],
) -> None:
    assert process.stdout is not None
    assert process.stdin is not None
    port = json.loads(process.stdout.readline())["port"]
    with httpx.Client(trust_env=False, headers={station.SECRET_HEADER: SECRET}) as client:
        page = client.get(f"http://127.0.0.1:{port}/").text
    process.stdin.close()

    assert "viser" in page.lower()
    assert process.wait(PATIENCE_S) == 0


def test_without_its_environment_it_says_what_is_missing() -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("UNGLARE_")}
    done = subprocess.run(
        [sys.executable, "-m", "app"], stdin=subprocess.DEVNULL, capture_output=True, text=True, env=environment, timeout=PATIENCE_S
    )  # fmt: skip

    assert done.returncode == 1
    assert "UNGLARE_STATION_SECRET and UNGLARE_API_URL not set" in done.stderr
