"""viser's server, made safe: loopback only, every request with the secret, nothing shared to the outside.

The four private details of viser that this needs stand here and nowhere else; a contract test pins them.
"""

import contextlib
import hmac
import io
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import unquote

import viser
import viser._messages as viser_messages
import websockets.asyncio.server as websocket_server

SECRET_HEADER = "X-Station-Secret"  # noqa: S105 - the header's name, not a secret


@dataclass(frozen=True)
class Introduction:
    """Who sits at a browser, as the proxy says it."""

    user: str
    role: str
    token: str

    @property
    def may_operate(self) -> bool:
        """True if this user may change anything; the API checks it again with each request."""
        return self.role == "operator"


@contextlib.contextmanager
def guarded_serve(secret: str) -> Iterator[None]:
    """While this is open, a websocket server that starts refuses every request without the secret.

    viser has no hook for it, so the library's `serve` is wrapped while viser starts.
    """
    original = websocket_server.serve

    def serve(handler: Any, host: Any, port: Any, *, process_request: Any = None, **kw: Any) -> Any:
        def guard(connection: Any, request: Any) -> Any:
            shown = request.headers.get(SECRET_HEADER, "")
            if not hmac.compare_digest(shown.encode(), secret.encode()):
                return connection.respond(HTTPStatus.FORBIDDEN, "forbidden\n")
            return None if process_request is None else process_request(connection, request)

        return original(handler, host, port, process_request=guard, **kw)

    websocket_server.serve = serve  # type: ignore[assignment,misc] # the point of this function
    try:
        yield
    finally:
        websocket_server.serve = original  # type: ignore[misc] # put back what was there


def start(secret: str) -> viser.ViserServer:
    """Start viser on a free loopback port; only whoever knows the secret gets an answer."""
    # viser greets the terminal, which is nobody's here.
    with guarded_serve(secret), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    # Any browser could ask for a public tunnel through somebody else's server.
    for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)  # noqa: SLF001 - pinned by test
    return server


def introduction_of(client: viser.ClientHandle) -> Introduction | None:
    """Read who is at a browser from the proxy's headers; None if the connection is gone already."""
    sockets = client._viser_server._websock_server  # noqa: SLF001 - pinned by test
    connection = sockets._live_connections.get(client.client_id)  # noqa: SLF001 - pinned by test
    if connection is None or connection.request is None:
        return None
    headers = connection.request.headers
    return Introduction(
        user=unquote(headers.get("X-Station-User", "")),
        role=unquote(headers.get("X-Station-Role", "viewer")),
        token=unquote(headers.get("X-Station-Token", "")),
    )


def element_id(handle: Any) -> str:
    """Return the id that a control's element has in the page, for `<label for=...>`."""
    return str(handle._impl.uuid)  # noqa: SLF001 - pinned by test
