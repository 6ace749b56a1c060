"""The real API, proxy and station in front of services that measure nothing.

`python -m tests.ui.served` serves it to be looked at by hand.
"""

import contextlib
import os
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

from backend.api import proxy, viser_messages
from backend.api.application import create_api
from backend.api.context import Context
from backend.api.server import public_socket, server_for
from backend.api.sessions import Role, Sessions, Tokens
from backend.api.station import Station
from backend.contract.requests import CreateScan
from backend.services.services import Services
from tests.ui.fake_services import FakeServices

TOKENS = {Role.OPERATOR: "operators-only-7431", Role.VIEWER: "viewers-only-1290"}
_FULL_RIGHTS = Role.OPERATOR


@dataclass
class Messages:
    """What browsers sent through the proxy, and whether it let them."""

    seen: list[tuple[bytes, Role, bool]] = field(default_factory=list)

    def refused_operators(self) -> list[bytes]:
        """Return the messages of operators that the proxy dropped: none, or its list lacks something."""
        return [m for m, role, passed in self.seen if role is _FULL_RIGHTS and not passed]


@dataclass(frozen=True)
class Served:
    """A running server with its station."""

    url: str
    services: Any
    """Those that it was made with: fakes, or real ones around a rig of the tests."""
    station: Station
    messages: Messages

    def address(self, user: str = "Anna", role: Role = Role.OPERATOR) -> str:
        """Return the address that logs a user in."""
        return f"{self.url}/?token={TOKENS[role]}&user={user}"


@contextlib.contextmanager
def serve(services: Services, *, port: int = 0) -> Iterator[Served]:
    """Serve until the block ends."""
    listening = public_socket("127.0.0.1", port)
    number = listening.getsockname()[1]
    url = f"http://127.0.0.1:{number}"
    station = Station(url)
    with tempfile.TemporaryDirectory() as folder, recorded() as messages:
        context = Context(
            services=services, sessions=Sessions(Tokens(TOKENS[Role.OPERATOR], TOKENS[Role.VIEWER])),
            station=station, version="0.0.test", cookie_name=f"unglare-{number}", data_folder=Path(folder), upload_limit_bytes=2**20,
        )  # fmt: skip
        server = server_for(create_api(context, station=station))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield Served(url, services, station, messages)
        finally:
            server.should_exit = True
            thread.join(timeout=30)
            assert not thread.is_alive()


@contextlib.contextmanager
def recorded() -> Iterator[Messages]:
    """Write down every message that the proxy judges."""
    messages, judge = Messages(), viser_messages.allowed

    def judged(message: bytes, role: Role) -> bool:
        passed = judge(message, role)
        messages.seen.append((message, role, passed))
        return passed

    # The name as the proxy imported it.
    setattr(proxy, "allowed", judged)  # noqa: B010 - mypy takes imported names for private
    try:
        yield messages
    finally:
        setattr(proxy, "allowed", judge)  # noqa: B010 - as above


def fill(services: FakeServices) -> None:
    """Make a few scans as an operator would find them in the morning."""
    for days, name in (
        (3, "Bracket, black anodised"),
        (2, "Turbine blade 7"),
        (1, "Bust and book"),
    ):
        state = services.create_scan(CreateScan(method="hdr-fringe", name=name), "Bo")
        services.find(state.id).created -= timedelta(days=days, minutes=37 * days)


if __name__ == "__main__":
    demo = FakeServices(tick_s=float(os.environ.get("TICK_S", "0.2")))
    fill(demo)
    with serve(demo, port=int(os.environ.get("PORT", "8099"))) as served:
        print(served.address(), flush=True)
        threading.Event().wait()
