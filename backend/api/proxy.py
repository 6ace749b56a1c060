"""The way from the one public port to the station on its loopback port: page and websocket."""

import asyncio
import contextlib
import secrets
from collections.abc import Coroutine
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from typing import Any, NamedTuple
from urllib.parse import quote

import websockets
from fastapi import APIRouter, Request, WebSocket
from starlette.concurrency import run_in_threadpool
from starlette.responses import RedirectResponse, Response
from starlette.websockets import WebSocketDisconnect

from backend.api.access import same_origin, session_of
from backend.api.context import Context, context_of
from backend.api.pages import login_by_link, login_page_for, starting_page
from backend.api.sessions import Session
from backend.api.station_page import policy, secured
from backend.api.viser_messages import allowed

ROOT = "/station/"
# The first makes our page obey a foreign server, the second shows a recording from anywhere.
_DANGEROUS = frozenset({"websocket", "playbackPath"})
_FETCH_TIMEOUT_S = 10.0
_SEND_TIMEOUT_S = 60.0
_MOST_SOCKETS = 16

router = APIRouter(include_in_schema=False)


class _Answer(NamedTuple):
    status: int
    kind: str
    body: bytes


@router.get("/station")
async def without_slash() -> Response:
    """Lead to the page; the same address without slash is the websocket."""
    return RedirectResponse(ROOT, 308)


@router.get("/station/{path:path}")
async def page(path: str, request: Request) -> Response:
    """Serve the station's page to whoever is logged in."""
    if "token" in request.query_params:
        return login_by_link(request, ROOT)
    session = session_of(request)
    if session is None:
        return login_page_for(request)
    if _DANGEROUS & set(request.query_params):
        return RedirectResponse(ROOT, 303)
    context = context_of(request)
    port = context.station.port
    try:
        answer = (
            await run_in_threadpool(_fetch, port, path, context.station.secret) if port else None
        )
    except (OSError, HTTPException):
        answer = None  # between two lives of the station
    return starting_page(context) if answer is None else _ours(answer)


@router.websocket("/station")
async def socket(browser: WebSocket) -> None:
    """Carry messages between a browser and the station, as long as its session lasts."""
    session = session_of(browser)
    if session is None or not (browser.headers.get("origin") and same_origin(browser)):
        await browser.close(1008)  # before accepting it: the browser sees 403
        return
    context = context_of(browser)
    if context.sockets.count >= _MOST_SOCKETS:
        await browser.send_denial_response(Response("too many open stations\n", 503))
        return
    with context.sockets.one_more():
        await _connect(browser, session, context)


def _fetch(port: int, path: str, secret: str) -> _Answer:
    # The standard library's client: it never asks the environment for a proxy, and costs no start-up time.
    connection = HTTPConnection("127.0.0.1", port, timeout=_FETCH_TIMEOUT_S)
    with contextlib.closing(connection):
        headers = {"X-Station-Secret": secret, "Accept-Encoding": "identity"}
        connection.request("GET", "/" + quote(path), headers=headers)
        answer = connection.getresponse()
        kind = answer.headers.get("Content-Type", "application/octet-stream")
        return _Answer(answer.status, kind, answer.read())


def _ours(answer: _Answer) -> Response:
    body = answer.body
    headers = {"Cache-Control": "no-cache", "X-Frame-Options": "SAMEORIGIN"}
    if answer.kind.startswith("text/html") and answer.status == HTTPStatus.OK:
        nonce = secrets.token_urlsafe(16)
        body = secured(body, nonce)
        headers["Content-Security-Policy"] = policy(nonce)
    return Response(body, answer.status, media_type=answer.kind, headers=headers)


def _introduction(session: Session, context: Context) -> dict[str, str]:
    return {
        "X-Station-Secret": context.station.secret,
        "X-Station-User": quote(session.user, safe=""),
        "X-Station-Role": quote(session.role.value, safe=""),
        "X-Station-Token": session.station_token,
    }


async def _connect(browser: WebSocket, session: Session, context: Context) -> None:
    try:
        station = await websockets.connect(
            f"ws://127.0.0.1:{context.station.port or 0}/",
            subprotocols=browser.scope["subprotocols"],
            compression=None,
            max_size=None,  # one message may be a cloud of 75 MB
            ping_interval=None,
            proxy=None,
            open_timeout=5,
            additional_headers=_introduction(session, context),
        )
    except (OSError, TimeoutError, websockets.WebSocketException):
        await browser.send_denial_response(Response("the station is starting\n", 503))
        return
    async with station:
        # viser refuses a browser that doesn't get back the version it asked for.
        await browser.accept(subprotocol=station.subprotocol)
        await _first_of(
            _down(station, browser),
            _up(browser, station, session),
            context.sessions.wait_for_end(session),
        )
        with contextlib.suppress(Exception):
            async with asyncio.timeout(2):
                await browser.close(station.close_code or 1000, station.close_reason or "")


async def _down(station: websockets.ClientConnection, browser: WebSocket) -> None:
    async for message in station:
        if isinstance(message, bytes):
            async with asyncio.timeout(_SEND_TIMEOUT_S):  # a stalled browser is cut
                await browser.send_bytes(message)


async def _up(browser: WebSocket, station: websockets.ClientConnection, session: Session) -> None:
    while (event := await browser.receive())["type"] != "websocket.disconnect":
        message = event.get("bytes")
        if message is not None and allowed(message, session.role):
            await station.send(message)


async def _first_of(*works: Coroutine[Any, Any, None]) -> None:
    """Run all until the first one ends, then cancel the others."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        # How a connection ended is nobody's error (RuntimeError: sent after the close); whatever else
        # was raised is ours.
        for outcome in await asyncio.gather(*tasks, return_exceptions=True):
            _reraise_defect(outcome)


def _reraise_defect(outcome: object) -> None:
    expected = (OSError, RuntimeError, WebSocketDisconnect, websockets.WebSocketException)
    if isinstance(outcome, Exception) and not isinstance(outcome, expected):
        raise outcome
