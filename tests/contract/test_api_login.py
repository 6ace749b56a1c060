"""The door: who gets in, how, and what every answer carries. Spoken over a real connection."""

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from backend.api import docs, pages, proxy
from backend.api.sessions import Attempts, Sessions, Tokens
from tests.contract.api_server import (
    COOKIE,
    OPERATOR_TOKEN,
    VIEWER_TOKEN,
    api,
    browser,
    program,
    toy_house,
    toy_server,
)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with toy_server(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture
def stranger(address: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=address, trust_env=False) as client:
        yield client


def test_the_root_leads_to_the_station_and_that_to_the_login(stranger: httpx.Client) -> None:
    root, station = stranger.get("/"), stranger.get("/station/")

    assert (root.status_code, root.headers["location"]) == (303, "/station/")
    assert (station.status_code, station.headers["location"]) == (303, "/login")


def test_the_link_of_the_terminal_logs_in_and_leaves_no_token_behind(
    stranger: httpx.Client,
) -> None:
    answer = stranger.get("/", params={"token": OPERATOR_TOKEN})

    assert (answer.status_code, answer.headers["location"]) == (303, "/station/")
    assert stranger.get("/api/me").json() == {"user": "operator", "role": "operator"}


def test_a_wrong_link_shows_the_form_and_why(stranger: httpx.Client) -> None:
    answer = stranger.get("/", params={"token": "wrong"})

    assert answer.status_code == 401
    assert "The token is wrong" in answer.text
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize(
    ("token", "role"), [(OPERATOR_TOKEN, "operator"), (VIEWER_TOKEN, "viewer")]
)
def test_the_form_makes_a_session_under_the_typed_name(address: str, token: str, role: str) -> None:
    with browser(address, token, name="  Ada  Lovelace ") as client:
        assert client.get("/api/me").json() == {"user": "Ada Lovelace", "role": role}


def test_the_cookie_is_for_this_server_and_no_script(stranger: httpx.Client) -> None:
    answer = stranger.post("/login", data={"name": "Ada", "token": OPERATOR_TOKEN})

    cookie = answer.headers["set-cookie"].lower()
    assert cookie.startswith(COOKIE)
    assert {"httponly", "samesite=strict", "path=/"} <= set(cookie.split("; "))
    assert "secure" not in cookie


@pytest.mark.parametrize(
    ("fields", "status", "sentence"),
    [
        ({"name": "Ada", "token": "wrong"}, 401, "The token is wrong"),
        ({"name": " ", "token": OPERATOR_TOKEN}, 422, "Type your name"),
        ({}, 422, "Type your name"),
    ],
)
def test_a_form_that_isnt_right_says_so(
    stranger: httpx.Client, fields: dict[str, str], status: int, sentence: str
) -> None:
    answer = stranger.post("/login", data=fields)

    assert (answer.status_code, "set-cookie" in answer.headers) == (status, False)
    assert sentence in answer.text


def test_what_was_typed_comes_back_without_markup(stranger: httpx.Client) -> None:
    answer = stranger.post("/login", data={"name": '"><script>', "token": "wrong"})

    assert "&quot;&gt;&lt;script&gt;" in answer.text
    assert '"><script>' not in answer.text


def test_another_page_cant_send_the_form(stranger: httpx.Client) -> None:
    answer = stranger.post(
        "/login",
        data={"name": "Eve", "token": OPERATOR_TOKEN},
        headers={"Origin": "https://evil.example"},
    )

    assert (answer.status_code, "set-cookie" in answer.headers) == (403, False)


@pytest.mark.parametrize(
    ("target", "lands"),
    [
        ("/api/docs", "/api/docs"),
        ("https://evil.example/", "/station/"),
        ("//evil.example/", "/station/"),
        ("/\\evil.example/", "/station/"),
        ("javascript:alert(1)", "/station/"),
        ("", "/station/"),
    ],
)
def test_login_leads_back_but_never_elsewhere(
    stranger: httpx.Client, target: str, lands: str
) -> None:
    answer = stranger.post("/login", data={"name": "Ada", "token": OPERATOR_TOKEN, "next": target})

    assert answer.headers["location"] == lands


def test_logout_ends_the_session(address: str) -> None:
    with browser(address) as client:
        cookie = client.cookies[COOKIE]

        answer = client.post("/logout")

        assert (answer.status_code, answer.headers["location"]) == (303, "/login")
        client.cookies.set(COOKIE, cookie)  # kept by a thief
        assert client.get("/api/me").status_code == 401


@pytest.mark.parametrize("origin", ["https://evil.example", "null", None])
def test_another_page_cant_log_somebody_out(address: str, origin: str | None) -> None:
    with browser(address) as client:
        del client.headers["Origin"]

        answer = client.post("/logout", headers={"Origin": origin} if origin else {})

        assert answer.status_code == 403
        assert client.get("/api/me").status_code == 200


def test_a_browser_without_origin_may_show_that_the_page_was_ours(address: str) -> None:
    with browser(address) as client:
        del client.headers["Origin"]

        assert client.post("/logout", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 403
        assert client.post("/logout", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 303


def test_a_program_shows_a_token_and_a_name(address: str) -> None:
    with program(address) as client:
        me = client.get("/api/me", headers={"X-Unglare-User": "nightly run"}).json()

    assert me == {"user": "nightly run", "role": "operator"}


def test_an_address_may_carry_the_token(stranger: httpx.Client) -> None:
    assert stranger.get("/api/me", params={"token": VIEWER_TOKEN}).json()["role"] == "viewer"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": "Bearer wrong"},
        {"Authorization": f"Basic {OPERATOR_TOKEN}"},
        {"Cookie": f"{COOKIE}=invented"},
        {"Authorization": "Bearer station.invented"},
    ],
)
def test_without_credentials_there_is_a_problem_and_nothing_else(
    stranger: httpx.Client, headers: dict[str, str]
) -> None:
    answer = stranger.get("/api/me", headers=headers)

    assert answer.status_code == 401
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["www-authenticate"] == 'Bearer realm="unglare"'
    assert answer.json()["type"] == "not-logged-in"


def test_a_shown_token_that_is_wrong_counts_although_a_cookie_is_right(address: str) -> None:
    with browser(address) as client:
        answer = client.get("/api/me", headers={"Authorization": "Bearer wrong"})

    assert answer.status_code == 401


def test_who_guesses_too_often_has_to_wait(tmp_path: Path) -> None:
    # An hour: however slow the machine is, no guess is forgiven before the last one.
    attempts = Attempts(recovery_s=3600.0)
    sessions = Sessions(Tokens(OPERATOR_TOKEN, VIEWER_TOKEN), attempts=attempts)
    with toy_server(tmp_path, sessions=sessions) as address:
        with httpx.Client(base_url=address, trust_env=False) as client, browser(address) as ada:
            statuses = [
                client.post("/login", data={"name": "Eve", "token": f"guess {i}"}).status_code
                for i in range(10)
            ]
            refused = client.get("/api/me", headers={"Authorization": f"Bearer {OPERATOR_TOKEN}"})

            assert statuses == [401] * 8 + [429] * 2
            assert refused.status_code == 429
            assert int(refused.headers["retry-after"]) > 0
            assert ada.get("/api/me").status_code == 200


def test_behind_tls_the_cookie_is_secure(tmp_path: Path) -> None:
    with toy_server(tmp_path, trusted_proxies="127.0.0.1") as address:
        with httpx.Client(base_url=address, trust_env=False) as client:
            answer = client.post(
                "/login",
                data={"name": "Ada", "token": OPERATOR_TOKEN},
                headers={"X-Forwarded-Proto": "https"},
            )

    assert "secure" in answer.headers["set-cookie"].lower().split("; ")


ANY_ANSWER = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


@pytest.mark.parametrize("path", ["/login", "/", "/api/me", "/nothing/here", "/assets/logo.svg"])
def test_every_answer_is_guarded(stranger: httpx.Client, path: str) -> None:
    headers = stranger.get(path).headers

    assert {name: headers[name] for name in ANY_ANSWER} == ANY_ANSWER
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert "server" not in headers


def test_pages_hold_no_scripts_of_their_own(stranger: httpx.Client) -> None:
    page = stranger.get("/login").text

    assert re.findall(r"<script[^>]*>", page) == ['<script src="/assets/login.js" defer>']
    assert not re.search(r"\son\w+=|style=", page)


@pytest.mark.parametrize(
    "path", ["/assets/../pyproject.toml", "/assets/login.html", "/assets/%2e%2e%2fREADME.md"]
)
def test_only_public_files_are_served(stranger: httpx.Client, path: str) -> None:
    assert stranger.get(path).status_code == 404


def test_assets_are_sent_once(stranger: httpx.Client) -> None:
    first = stranger.get("/assets/theme.css")

    again = stranger.get("/assets/theme.css", headers={"If-None-Match": first.headers["etag"]})

    assert (first.status_code, again.status_code) == (200, 304)
    assert first.headers["content-type"] == "text/css; charset=utf-8"


def test_the_description_of_the_api_is_for_whoever_is_logged_in(
    stranger: httpx.Client, address: str
) -> None:
    refused, led = stranger.get("/api/openapi.json"), stranger.get("/api/docs")
    with browser(address, VIEWER_TOKEN) as client:
        document, page = client.get("/api/openapi.json"), client.get("/api/docs")

    assert refused.status_code == 401
    assert led.headers["location"] == "/login?next=/api/docs"
    assert document.json()["info"]["title"] == "unglare"
    assert "/api/scans/{scan}/runs" in page.text
    assert "<script" not in page.text


def test_help_is_there_for_everybody(stranger: httpx.Client) -> None:
    page, text = stranger.get("/help"), stranger.get("/assets/help.md")

    assert "<h2>Keys</h2>" in page.text
    assert "<table>" in page.text
    assert text.headers["content-type"] == "text/markdown; charset=utf-8"


def test_the_way_out_is_asked_for_by_name(address: str) -> None:
    with browser(address, name="Ada <b>") as client:
        page = client.get("/logout").text

    assert "Log out, Ada &lt;b&gt;?" in page


def test_people_get_a_page_and_programs_a_problem(stranger: httpx.Client) -> None:
    page = stranger.get("/nothing", headers={"Accept": "text/html,*/*"})
    problem = stranger.get("/nothing")

    assert page.headers["content-type"].startswith("text/html")
    assert "There is nothing at /nothing." in page.text
    assert problem.json() == {
        "type": "not-found",
        "title": "Not found",
        "status": 404,
        "detail": "There is nothing at /nothing.",
        "details": {},
    }


PUBLIC = {
    "/",
    "/login",
    "/login/who",
    "/logout",
    "/import",
    "/help",
    "/assets/{name}",
    "/station",
    "/station/{path:path}",
    "/api/docs",
    "/api/health",
}
"""What a stranger may ask; each of them leads to the login, or tells nothing."""


def test_no_endpoint_forgets_to_ask_who_is_there(tmp_path: Path) -> None:
    with toy_house(tmp_path) as house:
        statuses = asked_by_a_stranger(api(house, tmp_path))

    assert len(statuses) > 20
    assert {name: status for name, status in statuses.items() if status != 401} == {}


def asked_by_a_stranger(app: FastAPI) -> dict[str, int]:
    """Ask every described endpoint without credentials; return the statuses."""
    guarded = {path for path in app.openapi()["paths"] if path not in PUBLIC}

    async def ask_all() -> dict[str, int]:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://here") as client:
            return {
                f"{method} {path}": (
                    await client.request(method, re.sub(r"{\w+}", "0123456789abcdef", path))
                ).status_code
                for path, operations in app.openapi()["paths"].items()
                if path in guarded
                for method in operations
            }

    return asyncio.run(ask_all())


def test_only_known_routes_stand_outside_of_the_guarded_ones() -> None:
    outside = (pages.router, proxy.router, docs.page)

    found = {route.path for router in outside for route in router.routes}  # type: ignore[attr-defined]  # all have one

    assert found | {"/api/health"} == PUBLIC
