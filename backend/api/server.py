"""The public port: its socket, and the server on it."""

import asyncio
import errno
import logging
import re
import socket
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI

from backend.domain.errors import StartupError

_CUT_STALLED_AFTER_MS = 30_000
_LARGEST_MESSAGE_BYTES = 16 * 2**20
_FAREWELL_S = 3

_TOKEN = re.compile(r"(?<=[?&]token=)[^&\s\"']+")


class Server(uvicorn.Server):
    """uvicorn, which says goodbye to open streams before it waits for them to end."""

    def __init__(self, config: uvicorn.Config, goodbye: Callable[[], None]) -> None:
        super().__init__(config)
        self._goodbye = goodbye

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close streams and sockets by ending their sessions, then do as uvicorn does."""
        self._goodbye()
        await asyncio.sleep(0)  # the streams notice
        await super().shutdown(sockets)


def server_for(app: FastAPI, *, trusted_proxies: str = "") -> Server:
    """Make the server of an application.

    Parameters
    ----------
    app
        Made by `create_api`.
    trusted_proxies
        Addresses whose X-Forwarded-* headers are believed, separated by commas; empty: nobody's.
    """
    config = uvicorn.Config(
        app,
        log_config=None,
        log_level=None,  # as the application's logging has it
        access_log=False,  # pages ask every few seconds; errors are logged where they arise
        proxy_headers=bool(trusted_proxies),
        forwarded_allow_ips=trusted_proxies or None,
        server_header=False,
        ws_max_size=_LARGEST_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # would cost ten times the time, clouds don't compress
        timeout_graceful_shutdown=_FAREWELL_S,  # else one stalled browser keeps the process alive
    )
    return Server(config, app.state.context.sessions.end_all)


def public_socket(host: str, port: int) -> socket.socket:
    """Bind and listen, before anything else starts: whoever comes early waits in the queue.

    Raises
    ------
    StartupError
        If the port is in use or the address can't be listened on.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        raise StartupError(
            f"The address {host!r} isn't known ({error.strerror}); set UNGLARE_HOST to one of this machine."
        ) from error
    # Named, because asyncio switches Nagle's algorithm off only where it sees the protocol: else each
    # answer waits 40 ms for the client's acknowledgement.
    listening = socket.socket(family, kind, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            # Accepted sockets inherit it. No keepalive cuts a browser that takes no data; this does.
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _CUT_STALLED_AFTER_MS)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        listening.close()
        raise StartupError(_why_not(host, port, error)) from error
    return listening


def _why_not(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"Port {port} of {host} is in use by another program; stop that one, or choose "
            "another port with --port or UNGLARE_PORT."
        )
    if error.errno == errno.EACCES:
        return f"Port {port} of {host} may only be used by root; choose one above 1023 with --port or UNGLARE_PORT."
    return f"Port {port} of {host} can't be listened on ({error.strerror}); set UNGLARE_HOST to an address of this machine."


class TokensHidden(logging.Filter):
    """Keeps tokens in addresses out of the log."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Replace tokens; every record passes."""
        text = record.getMessage()
        if "token=" in text:
            record.msg, record.args = _TOKEN.sub("***", text), None
        return True
