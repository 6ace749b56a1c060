"""The station's client of the API: what it reads, and what it does with what it can't read."""

import json
import threading
from collections.abc import Callable, Iterator

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.client import ApiClient, ApiError, picture_address, unpack_points
from backend.contract.events import RigChanged, ScanChanged
from backend.contract.requests import RedoStage

Handler = Callable[[httpx.Request], httpx.Response]


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Handler], ApiClient]]:
    made: list[ApiClient] = []

    def make(handler: Handler) -> ApiClient:
        real = httpx.Client
        monkeypatch.setattr(
            httpx, "Client", lambda **kw: real(transport=httpx.MockTransport(handler), **kw)
        )
        made.append(ApiClient("http://api", "the token"))
        return made[-1]

    yield make
    for each in made:
        each.close()


def cloud(n: int, *, colour: bool, scalars: int) -> tuple[bytes, np.ndarray]:
    xyz = np.arange(3 * n, dtype="<f4").reshape(n, 3)
    facts = {
        f"s{i}": {"unit": "mm", "title": f"S {i}", "low": 0.0, "high": 1.0} for i in range(scalars)
    }
    header = json.dumps({"n": n, "total": 10 * n, "scalars": facts}).encode()
    body = len(header).to_bytes(4, "little") + header + xyz.tobytes()
    body += bytes(range(3)) * n if colour else b""
    return body + b"".join(np.full(n, float(i), "<f4").tobytes() for i in range(scalars)), xyz


@given(st.integers(0, 20), st.booleans(), st.integers(0, 3))
def test_a_cloud_is_read_as_it_was_packed(n: int, colour: bool, scalars: int) -> None:
    body, xyz = cloud(n, colour=colour, scalars=scalars)
    found = unpack_points(body)

    assert np.array_equal(found.points_mm, xyz)
    assert found.total == 10 * n
    assert (found.colour is not None) == (colour and n > 0)
    assert [float(s.values.sum()) for s in found.scalars] == [float(i * n) for i in range(scalars)]


def test_a_cloud_with_bytes_missing_is_refused() -> None:
    body, _ = cloud(4, colour=False, scalars=1)

    with pytest.raises(ValueError, match="the cloud has"):
        unpack_points(body[:-2])


def test_limits_that_are_missing_come_from_the_values() -> None:
    header = json.dumps(
        {"n": 3, "total": 3, "scalars": {"s": {"low": None, "high": None}}}
    ).encode()
    values = np.array([1.0, 2.0, np.nan], "<f4").tobytes()
    (scalar,) = unpack_points(
        len(header).to_bytes(4, "little") + header + bytes(36) + values
    ).scalars

    assert (scalar.title, scalar.unit) == ("s", "")
    assert 1.0 <= scalar.low < scalar.high <= 2.0


def test_every_request_shows_the_token(client: Callable[[Handler], ApiClient]) -> None:
    seen: list[str | None] = []

    def answer(request: httpx.Request) -> httpx.Response:
        seen.append(request.headers.get("authorization"))
        return httpx.Response(200, json={"methods": [], "broken": {}})

    assert client(answer).methods() == ()
    assert seen == ["Bearer the token"]


def test_a_problem_keeps_the_server_s_words(client: Callable[[Handler], ApiClient]) -> None:
    problem = {
        "type": "stale-edit",
        "title": "Stale",
        "status": 409,
        "detail": "Bo was faster.",
        "details": {"revision": 3},
    }
    api = client(lambda _: httpx.Response(409, json=problem))

    with pytest.raises(ApiError, match="Bo was faster") as caught:
        api.redo("1", "a/b", RedoStage(revision=2))
    assert caught.value.problem.details == {"revision": 3}


def test_an_answer_that_is_no_problem_document_becomes_a_sentence(
    client: Callable[[Handler], ApiClient],
) -> None:
    api = client(lambda _: httpx.Response(502, text="<html>"))

    with pytest.raises(ApiError, match="502 to /api/scans/1"):
        api.scan("1")


def test_names_are_quoted_in_addresses(client: Callable[[Handler], ApiClient]) -> None:
    asked: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.url.raw_path.decode().partition("?")[0])
        return httpx.Response(204)

    assert client(answer).camera_picture("a b", "ü?") is None
    assert asked == ["/api/rigs/a%20b/cameras/%C3%BC%3F/preview"]


def test_an_array_is_fetched_once(client: Callable[[Handler], ApiClient]) -> None:
    import io

    body = io.BytesIO()
    np.save(body, np.arange(4))
    fetched: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        fetched.append(request.url.path)
        return httpx.Response(200, content=body.getvalue())

    api = client(answer)

    assert api.array("aa").tolist() == api.array("aa").tolist() == [0, 1, 2, 3]
    assert fetched == ["/api/artifacts/aa"]


def test_events_are_read_line_by_line_and_unknown_ones_left_out(
    client: Callable[[Handler], ApiClient],
) -> None:
    lines = [
        ": unglare", "retry: 2000", "", 'event: scan_changed', 'data: {"kind":"scan_changed","scan":"1","revision":2}', "",
        'data: {"kind":"news"}', "", ": still here", "", 'data: {"kind":"rig_changed","rig":"r"}', "",
    ]  # fmt: skip
    api = client(lambda _: httpx.Response(200, text="\n".join(lines) + "\n"))
    events = api.events(threading.Event())

    assert [next(events) for _ in range(3)] == [
        None,
        ScanChanged(scan="1", revision=2),
        RigChanged(rig="r"),
    ]


def test_the_address_of_a_picture_says_how_it_is_drawn() -> None:
    address = picture_address("ab", max_px=640, colormap="turbo", low=-1.5)

    assert (
        address
        == "/api/artifacts/ab/preview?max_px=640&colormap=turbo&kind=picture&format=jpeg&low=-1.5"
    )
