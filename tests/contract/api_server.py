"""The API on a real port, in this process, around the toy method: tests speak HTTP and websocket to it."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI

from backend.api.application import create_api
from backend.api.context import Context
from backend.api.server import public_socket, server_for
from backend.api.sessions import Sessions, Tokens
from backend.jobs.execution import Workshop
from backend.jobs.runner import InlineRunner, Runner
from tests.scans.toy_house import House, data_folder

OPERATOR_TOKEN = "operators-only-7431"
VIEWER_TOKEN = "viewers-only-1290"
COOKIE = "unglare-test"


@dataclass
class Upstream:
    """Where a test says that the station is."""

    port: int | None = None
    secret: str = "known to proxy and station"
    message: str = "The station is starting."


@contextlib.contextmanager
def toy_house(
    folder: Path, make_runner: Callable[[Workshop], Runner] = InlineRunner
) -> Iterator[House]:
    """Make the services around the toy method and the toy rig."""
    database, store = data_folder(folder)
    house = House(database, store, make_runner)
    try:
        yield house
    finally:
        house.services.close()


def api(house: House, folder: Path, **changes: Any) -> FastAPI:
    """Make the application around a house; `changes` go into its context."""
    values: dict[str, Any] = {
        "services": house.services,
        "sessions": Sessions(Tokens(OPERATOR_TOKEN, VIEWER_TOKEN)),
        "station": Upstream(),
        "version": "0.0.test",
        "cookie_name": COOKIE,
        "data_folder": folder,
        "upload_limit_bytes": 2**20,
    }
    return create_api(Context(**(values | changes)))


@contextlib.contextmanager
def serving(app: FastAPI, *, trusted_proxies: str = "") -> Iterator[str]:
    """Serve an application on a free loopback port; yields its address."""
    listening = public_socket("127.0.0.1", 0)
    port = listening.getsockname()[1]
    server = server_for(app, trusted_proxies=trusted_proxies)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join(timeout=30)
        assert not thread.is_alive()


@contextlib.contextmanager
def toy_server(folder: Path, *, trusted_proxies: str = "", **changes: Any) -> Iterator[str]:
    """Serve the toy method for a test that only needs the address."""
    with toy_house(folder) as house:
        app = api(house, folder, **changes)
        with serving(app, trusted_proxies=trusted_proxies) as address:
            yield address


@contextlib.contextmanager
def browser(address: str, token: str = OPERATOR_TOKEN, name: str = "Ada") -> Iterator[httpx.Client]:
    """Log in as a browser does: with a cookie, and an Origin on whatever changes something."""
    with httpx.Client(base_url=address, headers={"Origin": address}, trust_env=False) as client:
        answer = client.post("/login", data={"name": name, "token": token})
        assert answer.status_code == 303, answer.text
        yield client


def program(address: str, token: str = OPERATOR_TOKEN) -> httpx.Client:
    """Be a program: a token with every request, no cookie."""
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.Client(base_url=address, headers=headers, trust_env=False)
