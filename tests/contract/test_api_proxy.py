"""The proxy to the station, attacked with a raw protocol client. A small server plays viser."""

import contextlib
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from queue import Queue

import httpx
import msgspec
import pytest
import viser
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.sync.server import Server, ServerConnection, serve
from websockets.typing import Origin, Subprotocol

from tests.contract.api_server import (
    COOKIE,
    OPERATOR_TOKEN,
    VIEWER_TOKEN,
    Upstream,
    browser,
    toy_server,
)

SUBPROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
PAGE = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_bytes()
SECRET = "known to proxy and station"
CAMERA = msgspec.msgpack.encode({"type": "ViewerCameraMessage"})
CLICK = msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "b", "updates": {"value": 1}})
SHARE = msgspec.msgpack.encode({"type": "ShareUrlRequest"})
DISABLE = msgspec.msgpack.encode(
    {"type": "GuiUpdateMessage", "uuid": "b", "updates": {"update_cb": []}}
)
BIG = bytes(20 * 2**20)


@dataclass
class FakeStation:
    """Serves viser's page, notes what arrives, answers each message with itself."""

    requests: list[Request] = field(default_factory=list)
    messages: Queue[bytes | str] = field(default_factory=Queue)
    connections: list[ServerConnection] = field(default_factory=list)
    ended: Queue[int | None] = field(default_factory=Queue)

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        self.requests.append(request)
        if request.headers.get("X-Station-Secret") != SECRET:
            return connection.respond(HTTPStatus.FORBIDDEN, "forbidden\n")
        if request.headers.get("Upgrade") == "websocket":
            return None
        found = request.path == "/"
        headers = Headers({"Content-Type": "text/html; charset=utf-8", "Connection": "close"})
        body = PAGE if found else b"NOT FOUND"
        headers["Content-Length"] = str(len(body))
        return Response(200 if found else 404, "OK", headers, body)

    def talk(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        with contextlib.suppress(ConnectionClosed):
            connection.send(b"welcome")
            for message in connection:
                self.messages.put(message)
                connection.send(BIG if message == CLICK else message)
        self.ended.put(connection.protocol.close_code)


@contextlib.contextmanager
def upstream(station: FakeStation) -> Iterator[Server]:
    server = serve(
        station.talk,
        "127.0.0.1",
        0,
        process_request=station.answer,
        compression=None,
        max_size=None,
        select_subprotocol=lambda _, offered: next(
            (p for p in offered if p.startswith("viser-v")), None
        ),
    )
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join(timeout=30)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, FakeStation]]:
    station = FakeStation()
    with upstream(station) as server:
        behind = Upstream(server.socket.getsockname()[1], SECRET)
        folder = tmp_path_factory.mktemp("data")
        with toy_server(folder, station=behind) as address:
            yield address, station


@pytest.fixture
def address(place: tuple[str, FakeStation]) -> str:
    return place[0]


@pytest.fixture
def station(place: tuple[str, FakeStation]) -> FakeStation:
    station = place[1]
    station.requests.clear()
    station.connections.clear()
    station.messages, station.ended = Queue(), Queue()
    return station


def cookie_of(client: httpx.Client) -> dict[str, str]:
    return {"Cookie": f"{COOKIE}={client.cookies[COOKIE]}"}


@contextlib.contextmanager
def socket_of(
    address: str, headers: dict[str, str], *, origin: str | None = "", path: str = "/station"
) -> Iterator[Connection]:
    with connect(
        address.replace("http", "ws", 1) + path,
        additional_headers=headers,
        origin=None if origin is None else Origin(origin or address),
        subprotocols=[SUBPROTOCOL],
        max_size=None,
        compression=None,
        proxy=None,
    ) as connection:
        yield connection


def refused(address: str, headers: dict[str, str], origin: str | None = "") -> int:
    with pytest.raises(InvalidStatus) as refusal, socket_of(address, headers, origin=origin):
        pass
    return refusal.value.response.status_code


# ---- the page


def test_strangers_are_led_to_the_login(address: str, station: FakeStation) -> None:
    answer = httpx.get(address + "/station/", trust_env=False)

    assert (answer.status_code, answer.headers["location"]) == (303, "/login")
    assert station.requests == []


def test_the_page_comes_with_a_policy_whose_nonce_its_scripts_carry(address: str) -> None:
    with browser(address) as client:
        one, two = client.get("/station/"), client.get("/station/")

    nonces = [
        re.search(r"script-src 'nonce-([\w-]+)'", a.headers["content-security-policy"])
        for a in (one, two)
    ]
    assert nonces[0] is not None
    assert nonces[1] is not None
    assert nonces[0][1] != nonces[1][1]
    assert one.text.count(f'nonce="{nonces[0][1]}"') >= 2
    assert one.headers["x-frame-options"] == "SAMEORIGIN"
    assert one.headers["cache-control"] == "no-cache"


@pytest.mark.parametrize(
    "query", ["websocket=ws://evil.example/", "playbackPath=/x", "a=1&websocket="]
)
def test_parameters_that_redirect_the_page_are_dropped(
    address: str, station: FakeStation, query: str
) -> None:
    with browser(address) as client:
        answer = client.get(f"/station/?{query}")

    assert (answer.status_code, answer.headers["location"]) == (303, "/station/")
    assert station.requests == []


def test_the_link_of_the_terminal_works_for_the_station_too(address: str) -> None:
    with httpx.Client(base_url=address, trust_env=False) as client:
        answer = client.get("/station/", params={"token": OPERATOR_TOKEN})
        page = client.get(answer.headers["location"])

    assert (answer.status_code, page.status_code) == (303, 200)


def test_the_address_without_slash_leads_to_the_page(address: str) -> None:
    answer = httpx.get(address + "/station", trust_env=False)

    assert (answer.status_code, answer.headers["location"]) == (308, "/station/")


def test_what_the_station_doesnt_have_isnt_there(address: str) -> None:
    with browser(address) as client:
        assert client.get("/station/nothing").status_code == 404


def test_neither_cookie_nor_query_reach_the_station(address: str, station: FakeStation) -> None:
    with browser(address) as client:
        client.get("/station/?a=1")

    [request] = station.requests
    assert request.path == "/"
    assert "Cookie" not in request.headers


@pytest.mark.parametrize("port", [None, 1])
def test_while_the_station_isnt_up_the_page_says_so_and_asks_again(
    tmp_path: Path, port: int | None
) -> None:
    with toy_server(tmp_path, station=Upstream(port)) as address:
        with browser(address) as client:
            page = client.get("/station/")
            socket_status = refused(address, cookie_of(client))

    assert page.status_code == 503
    assert "The station is starting." in page.text
    assert 'http-equiv="refresh"' in page.text
    assert socket_status == 503


# ---- the websocket


def test_a_stranger_gets_no_socket(address: str, station: FakeStation) -> None:
    assert refused(address, {}) == 403
    assert refused(address, {"Cookie": f"{COOKIE}=invented"}) == 403
    assert refused(address, {"Authorization": f"Bearer {OPERATOR_TOKEN}"}) == 403
    assert station.requests == []


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", None, "http://127.0.0.1", "ws://127.0.0.1:1"]
)
def test_a_foreign_page_gets_no_socket_even_with_the_cookie(
    address: str, station: FakeStation, origin: str | None
) -> None:
    with browser(address) as client:
        assert refused(address, cookie_of(client), origin) == 403

    assert station.requests == []


def test_the_station_learns_who_is_there(address: str, station: FakeStation) -> None:
    with browser(address, name="Zoë Łuck") as client:
        with socket_of(address, cookie_of(client)) as connection:
            assert connection.recv() == b"welcome"
            assert connection.subprotocol == SUBPROTOCOL

        headers = station.requests[-1].headers
        token = headers["X-Station-Token"]
        me = httpx.get(
            address + "/api/me", headers={"Authorization": f"Bearer {token}"}, trust_env=False
        )

    assert headers["X-Station-User"] == "Zo%C3%AB%20%C5%81uck"
    assert headers["X-Station-Role"] == "operator"
    assert me.json() == {"user": "Zoë Łuck", "role": "operator"}


def test_a_browser_cant_introduce_itself(address: str, station: FakeStation) -> None:
    with browser(address, VIEWER_TOKEN, name="Eve") as client:
        claims = {"X-Station-Role": "operator", "X-Station-User": "Ada", "X-Station-Secret": "x"}
        with socket_of(address, cookie_of(client) | claims) as connection:
            connection.recv()

    headers = station.requests[-1].headers
    assert headers.get_all("X-Station-Role") == ["viewer"]
    assert headers.get_all("X-Station-User") == ["Eve"]


def test_messages_go_both_ways_large_ones_too(address: str, station: FakeStation) -> None:
    with browser(address) as client, socket_of(address, cookie_of(client)) as connection:
        connection.recv()
        connection.send(CLICK)
        assert connection.recv(timeout=30) == BIG

    assert station.messages.get(timeout=30) == CLICK


@pytest.mark.parametrize(
    ("token", "dropped"),
    [
        pytest.param(VIEWER_TOKEN, CLICK, id="a viewer's forged click"),
        pytest.param(OPERATOR_TOKEN, DISABLE, id="update of another attribute"),
        pytest.param(OPERATOR_TOKEN, SHARE, id="share request"),
        pytest.param(OPERATOR_TOKEN, b"\xc1\x00garbage", id="garbage"),
        pytest.param(OPERATOR_TOKEN, b"", id="nothing"),
        pytest.param(OPERATOR_TOKEN, CLICK.decode("latin-1"), id="text"),
    ],
)
def test_what_a_browser_may_not_send_never_arrives(
    address: str, station: FakeStation, token: str, dropped: bytes | str
) -> None:
    with browser(address, token) as client, socket_of(address, cookie_of(client)) as connection:
        connection.recv()
        connection.send(dropped)
        connection.send(CAMERA)  # allowed, and behind it: when it is back, the other was dropped
        assert connection.recv(timeout=30) == CAMERA

    assert station.messages.get(timeout=30) == CAMERA
    assert station.messages.empty()


def test_a_message_that_is_too_large_ends_the_connection(
    address: str, station: FakeStation
) -> None:
    with browser(address) as client, socket_of(address, cookie_of(client)) as connection:
        connection.recv()
        with contextlib.suppress(ConnectionClosed):  # cut before or after all of it is out
            connection.send(BIG)
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=30)

    station.ended.get(timeout=30)
    assert station.messages.empty()


def test_logout_closes_the_socket_and_kills_its_token(address: str, station: FakeStation) -> None:
    with browser(address) as client, socket_of(address, cookie_of(client)) as connection:
        connection.recv()
        client.post("/logout")
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=30)

    token = station.requests[-1].headers["X-Station-Token"]
    answer = httpx.get(
        address + "/api/me", headers={"Authorization": f"Bearer {token}"}, trust_env=False
    )
    assert answer.status_code == 401
    station.ended.get(timeout=30)  # the station's side is closed too


def test_other_sessions_stay(address: str, station: FakeStation) -> None:
    with browser(address, name="Ada") as ada, browser(address, name="Eve") as eve:
        with socket_of(address, cookie_of(ada)) as connection:
            connection.recv()
            eve.post("/logout")
            connection.send(CAMERA)
            assert connection.recv(timeout=30) == CAMERA


def test_a_browser_that_leaves_frees_the_station(address: str, station: FakeStation) -> None:
    with browser(address) as client, socket_of(address, cookie_of(client)) as connection:
        connection.recv()
        connection.close()

    station.ended.get(timeout=30)


def test_a_station_that_dies_closes_the_browsers_socket(address: str, station: FakeStation) -> None:
    with browser(address) as client, socket_of(address, cookie_of(client)) as connection:
        connection.recv()
        station.connections[-1].close(1012, "restarting")
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=30)

    assert connection.close_code == 1012


def test_a_browser_of_another_viser_is_told_so(address: str, station: FakeStation) -> None:
    with browser(address) as client:
        with connect(
            address.replace("http", "ws", 1) + "/station",
            additional_headers=cookie_of(client),
            origin=Origin(address),
            subprotocols=[Subprotocol("something-else")],
            proxy=None,
        ) as connection:
            assert connection.subprotocol is None


def test_only_so_many_stations_are_open_at_once(station: FakeStation, tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        behind = Upstream(stack.enter_context(upstream(station)).socket.getsockname()[1], SECRET)
        address = stack.enter_context(toy_server(tmp_path, station=behind))
        client = stack.enter_context(browser(address))
        for _ in range(16):
            stack.enter_context(socket_of(address, cookie_of(client))).recv()

        assert refused(address, cookie_of(client)) == 503
