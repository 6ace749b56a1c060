"""The outermost layer: headers that every answer carries, and defects that end as an answer."""

import logging
import secrets

from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from backend.api import problems
from backend.api.errors import TooLargeError
from backend.api.headers import DEFAULTS
from backend.contract.problems import Problem

_log = logging.getLogger(__name__)

_READING = frozenset({"GET", "HEAD", "OPTIONS", "DELETE"})


class Guard:
    """ASGI middleware; plain, because Starlette's base class would break streams.

    Parameters
    ----------
    app
        What it guards.
    limit_bytes
        Largest body of a request, unless its path is in `unlimited`.
    unlimited
        Paths that count for themselves what arrives.
    """

    def __init__(
        self, app: ASGIApp, *, limit_bytes: int = 8 * 2**20, unlimited: frozenset[str] = frozenset()
    ) -> None:
        self._app = app
        self._limit_bytes = limit_bytes
        self._unlimited = unlimited

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = False

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                headers = MutableHeaders(scope=message)
                for name, value in DEFAULTS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(scope)
        if refusal is not None:
            await problems.answer(refusal)(scope, receive, send_with_headers)
            return
        try:
            await self._app(scope, receive, send_with_headers)
        except ClientDisconnect:
            _log.info("The client went away during %s %s.", scope["method"], scope["path"])
        except Exception:  # the last resort: whatever it is, it is logged whole and answered
            identifier = secrets.token_hex(4)
            _log.exception("Defect %s in %s %s", identifier, scope["method"], scope["path"])
            if started:
                raise  # half an answer is out: only cutting the connection tells the client
            await problems.answer(problems.defect(identifier))(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Problem | None:
        """Return why the body can't be taken, None if it can."""
        if scope["method"] in _READING or scope["path"] in self._unlimited:
            return None
        headers = MutableHeaders(scope=scope)
        length = headers.get("content-length")
        if length is None and "transfer-encoding" in headers:
            sentence = "A body without Content-Length isn't taken; send its length."
            return Problem(
                type="length-required", title="Length required", status=411, detail=sentence
            )
        if length is not None and int(length) > self._limit_bytes:
            error = TooLargeError(
                f"The body has {int(length)} bytes; {scope['path']} takes {self._limit_bytes} at most."
            )
            return problems.problem_of(error)
        return None
