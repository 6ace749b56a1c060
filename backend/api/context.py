"""What the endpoints work with: made once by the composition root, never changed."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Protocol, runtime_checkable

from fastapi import Depends, Request
from starlette.requests import HTTPConnection

from backend.api.sessions import Sessions
from backend.devices.pages import PageDesk
from backend.services.services import Services


@runtime_checkable
class Upstream(Protocol):
    """Where the station is: asked anew for each request, because it may have been restarted."""

    @property
    def port(self) -> int | None:
        """Loopback port; None while it isn't up."""
        ...

    @property
    def secret(self) -> str:
        """What it wants to see in `X-Station-Secret`."""
        ...

    @property
    def message(self) -> str:
        """One sentence on how it is doing."""
        ...


class Sockets:
    """Counts open websockets."""

    def __init__(self) -> None:
        self.count = 0

    @contextlib.contextmanager
    def one_more(self) -> Iterator[None]:
        """Count one more while inside."""
        self.count += 1
        try:
            yield
        finally:
            self.count -= 1


@dataclass(frozen=True)
class Context:
    """Everything an endpoint may use."""

    services: Services
    sessions: Sessions
    station: Upstream
    version: str
    cookie_name: str
    """One per port: browsers don't keep cookies of two ports apart."""
    data_folder: Path
    upload_limit_bytes: int
    sockets: Sockets = field(default_factory=Sockets)
    pages: PageDesk = field(default_factory=PageDesk)
    """Projector pages; the drivers of page projectors look for theirs here."""

    @property
    def ticket_name(self) -> str:
        """Name of the cookie with a projector window's ticket."""
        return f"{self.cookie_name}-projector"


def context_of(connection: HTTPConnection) -> Context:
    """Return the context of the application that serves this connection."""
    context = connection.app.state.context
    assert isinstance(context, Context)
    return context


def _services(request: Request) -> Services:
    return context_of(request).services


Uses = Annotated[Services, Depends(_services)]
"""The services, in the signature of an endpoint."""
