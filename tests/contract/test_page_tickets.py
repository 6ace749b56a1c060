"""A projector window stays one when the sessions are gone, and gets nothing else by it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from backend.api.page_tickets import PageTickets
from backend.api.sessions import Sessions, Tokens
from tests.contract.api_server import COOKIE, OPERATOR_TOKEN, VIEWER_TOKEN, toy_server

TICKET = f"{COOKIE}-projector"
LATER_S = 31 * 24 * 3600.0


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with toy_server(tmp_path_factory.mktemp("data")) as running:
        yield running


@contextmanager
def window_of(address: str, token: str) -> Iterator[httpx.Client]:
    """Open the projector page as a window does that is given a link."""
    with httpx.Client(base_url=address, trust_env=False, follow_redirects=True) as window:
        assert window.get("/projector", params={"token": token}).status_code == 200
        yield window


def is_projector(address: str, cookies: dict[str, str]) -> bool:
    """Tell whether the server takes a window with these cookies for the projector."""
    header = "; ".join(f"{name}={value}" for name, value in cookies.items())
    try:
        with connect(
            f"{address.replace('http', 'ws')}/ws/projector",
            additional_headers={"Cookie": header},
            origin=address,  # type: ignore[arg-type]  # a NewType of str
            proxy=None,
        ) as page:
            page.send('{"t": "hello"}')
            return True
    except InvalidStatus as refusal:
        return refusal.response.status_code != 403


def test_a_window_is_the_projector_again_after_a_restart(address: str, tmp_path: Path) -> None:
    with window_of(address, OPERATOR_TOKEN) as window:
        ticket = window.cookies[TICKET]
    with toy_server(tmp_path) as restarted:
        assert is_projector(restarted, {COOKIE: "a session of before", TICKET: ticket})


def test_a_reloaded_window_gets_a_new_ticket_and_no_login_form(address: str) -> None:
    with window_of(address, OPERATOR_TOKEN) as window:
        window.cookies.delete(COOKIE)
        again = window.get("/projector")
        assert "/projector.js" in again.text
        assert TICKET in again.headers["set-cookie"]


def test_a_ticket_opens_nothing_else(address: str) -> None:
    with window_of(address, OPERATOR_TOKEN) as window:
        ticket = window.cookies[TICKET]
    with httpx.Client(base_url=address, trust_env=False, cookies={TICKET: ticket}) as stranger:
        assert stranger.get("/api/me").status_code == 401
        assert stranger.get("/api/me", headers={"Authorization": f"Bearer {ticket}"}).status_code == 401  # fmt: skip
        assert stranger.get("/station/").headers["location"] == "/login"


def test_a_viewer_gets_no_ticket_and_none_helps_him(address: str) -> None:
    with window_of(address, OPERATOR_TOKEN) as window:
        ticket = window.cookies[TICKET]
    with window_of(address, VIEWER_TOKEN) as window:
        assert TICKET not in window.cookies
        assert not is_projector(address, {COOKIE: window.cookies[COOKIE], TICKET: ticket})


def test_logging_out_takes_the_ticket_away(address: str) -> None:
    with window_of(address, OPERATOR_TOKEN) as window:
        window.post("/logout", headers={"Origin": address})
        assert not dict(window.cookies)


def test_tickets_are_void_with_another_token(address: str, tmp_path: Path) -> None:
    with window_of(address, OPERATOR_TOKEN) as window:
        ticket = window.cookies[TICKET]
    with toy_server(tmp_path, sessions=Sessions(Tokens("another-token-0815"))) as changed:
        assert not is_projector(changed, {TICKET: ticket})


def test_a_ticket_runs_out() -> None:
    now_s = [1.8e9]
    tickets = PageTickets(OPERATOR_TOKEN, clock=lambda: now_s[0])
    ticket = tickets.issue()
    assert tickets.holds(ticket)
    now_s[0] += LATER_S
    assert not tickets.holds(ticket)
    until, signature = ticket.split(".")
    assert not tickets.holds(f"{int(until) + int(LATER_S)}.{signature}")


def test_trying_out_tokens_on_a_ticket_takes_long() -> None:
    ticket = PageTickets(OPERATOR_TOKEN).issue()
    took_s = []
    for guess in ("password", "12345678", "unglare1"):
        began_s = time.perf_counter()
        assert not PageTickets(guess).holds(ticket)
        took_s.append(time.perf_counter() - began_s)
    assert min(took_s) > 1e-3


@given(st.text(max_size=90))
def test_whatever_isnt_a_ticket_is_none(text: str) -> None:
    assert not PageTickets(OPERATOR_TOKEN).holds(text)
