"""The projector page and its websocket: a browser window that shows patterns, see `backend.devices.pages`."""

import asyncio
import contextlib

from fastapi import APIRouter, Request, WebSocket
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, Response
from starlette.websockets import WebSocketDisconnect

from backend.api.access import same_origin, session_of
from backend.api.assets import asset
from backend.api.context import context_of
from backend.api.pages import keep_in_browser, login_by_link, login_page_for
from backend.api.sessions import Role
from backend.devices.pages import SECOND_PAGE

PATH = "/projector"

router = APIRouter(include_in_schema=False)


@router.get(PATH)
async def page(request: Request) -> Response:
    """Serve the page to whoever is logged in; it takes no part in anything before it is connected."""
    if "token" in request.query_params:
        name = request.query_params.get("name", "")
        return login_by_link(request, f"{PATH}?name={name}" if name else PATH)
    if not (session_of(request) or _has_ticket(request)):
        return login_page_for(request)
    answer = HTMLResponse(asset("projector.html")[0])
    if _may_project(request):
        _give_ticket(answer, request)
    return answer


@router.websocket("/ws/projector")
async def socket(browser: WebSocket, name: str = "projector") -> None:
    """Be the projector `name` as long as the page is open."""
    if not (_may_project(browser) and same_origin(browser)):
        await browser.close(1008)  # before accepting it: the browser sees 403
        return
    await browser.accept()
    connection = _Socket(browser)
    joined = context_of(browser).pages.join(name, connection)
    if joined is None:
        await browser.close(SECOND_PAGE, "another page is this projector")
        return
    sending = asyncio.create_task(connection.send_all())
    try:
        while True:
            joined.told(await browser.receive_text())
    except (WebSocketDisconnect, RuntimeError):
        pass  # closed by either side
    finally:
        joined.left()
        sending.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await sending


def _may_project(connection: HTTPConnection) -> bool:
    """Tell whether this window may be a projector: an operator's, also after his session or the server's end."""
    session = session_of(connection)
    return session.role is Role.OPERATOR if session else _has_ticket(connection)


def _has_ticket(connection: HTTPConnection) -> bool:
    context = context_of(connection)
    return context.sessions.tickets.holds(connection.cookies.get(context.ticket_name, ""))


def _give_ticket(answer: Response, request: Request) -> None:
    context = context_of(request)
    tickets = context.sessions.tickets
    keep_in_browser(
        answer, request, context.ticket_name, tickets.issue(), lifetime_s=tickets.lifetime_s
    )


class _Socket:
    """A websocket that other threads may send to: messages wait in a queue of the event loop."""

    def __init__(self, browser: WebSocket) -> None:
        self._browser = browser
        self._loop = asyncio.get_running_loop()
        self._queue: asyncio.Queue[str | bytes | tuple[int, str]] = asyncio.Queue()

    def send_text(self, text: str) -> None:
        """Send a text message."""
        self._put(text)

    def send_bytes(self, data: bytes) -> None:
        """Send a binary message."""
        self._put(data)

    def close(self, code: int, reason: str) -> None:
        """End the connection."""
        self._put((code, reason))

    async def send_all(self) -> None:
        """Send what is queued, in order, until cancelled."""
        while True:
            message = await self._queue.get()
            try:
                await self._send(message)
            except (WebSocketDisconnect, RuntimeError):
                return  # the reader notices too

    async def _send(self, message: str | bytes | tuple[int, str]) -> None:
        if isinstance(message, str):
            await self._browser.send_text(message)
        elif isinstance(message, bytes):
            await self._browser.send_bytes(message)
        else:
            await self._browser.close(*message)

    def _put(self, message: str | bytes | tuple[int, str]) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and with it the page
            self._loop.call_soon_threadsafe(self._queue.put_nowait, message)
