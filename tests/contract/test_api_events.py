"""Events over a real connection: they come, they end with the session, and nobody is forgotten."""

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from backend.contract.events import RigChanged, ScanChanged
from backend.domain.states import JobStatus
from backend.jobs.runner import LocalRunner
from backend.services.events import EventHub
from tests.contract.api_server import (
    COOKIE,
    VIEWER_TOKEN,
    api,
    browser,
    program,
    serving,
    toy_house,
)
from tests.scans.toy_house import House, data_folder

MINE, OTHER = ScanChanged(scan="mine", revision=2), ScanChanged(scan="other", revision=5)


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    with toy_house(tmp_path) as house:
        yield house


@pytest.fixture
def address(house: House, tmp_path: Path) -> Iterator[str]:
    with serving(api(house, tmp_path)) as address:
        yield address


@contextlib.contextmanager
def listening(client: httpx.Client, **query: str) -> Iterator[Iterator[str]]:
    """Listen; once inside, the subscription stands: the stream has said its welcome."""
    with client.stream("GET", "/api/events", params=query, timeout=30) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert answer.headers["cache-control"] == "no-store"
        lines = answer.iter_lines()
        assert next(lines).startswith(":")
        yield (line for line in lines if line.startswith(("event:", "data:")))


def gone(hub: EventHub) -> None:
    """Wait until nobody listens any more: each time one leaves, the others hear of it."""
    for _ in range(3000):
        if len(hub) == 0:
            return
        threading.Event().wait(0.01)
    raise AssertionError("a subscription was left behind")


def test_events_come_as_they_happen_to_viewers_too(address: str, house: House) -> None:
    with program(address, VIEWER_TOKEN) as client, listening(client) as lines:
        house.services.events.publish(MINE)
        first = [next(lines), next(lines)]
        house.services.events.publish(RigChanged(rig="toy"))
        second = [next(lines), next(lines)]

    assert first == ["event: scan_changed", f"data: {MINE.model_dump_json()}"]
    assert second[0] == "event: rig_changed"


def test_only_those_of_one_scan(address: str, house: House) -> None:
    with program(address) as client, listening(client, scan="mine") as lines:
        house.services.events.publish(OTHER)
        house.services.events.publish(MINE)

        assert [next(lines), next(lines)][1] == f"data: {MINE.model_dump_json()}"


def test_a_listener_that_leaves_is_forgotten(address: str, house: House) -> None:
    with program(address) as client, listening(client):
        assert len(house.services.events) == 1

    gone(house.services.events)


def test_the_stream_ends_with_its_session(address: str, house: House) -> None:
    with browser(address) as client, browser(address) as other, listening(client) as lines:
        cookies = {"Cookie": f"{COOKIE}={client.cookies[COOKIE]}", "Origin": address}
        httpx.post(address + "/logout", headers=cookies, trust_env=False)

        assert list(lines) == []
        assert other.get("/api/me").status_code == 200

    gone(house.services.events)


def test_open_streams_dont_keep_the_server_alive(
    house: House, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with contextlib.ExitStack() as stack, contextlib.ExitStack() as server:
        address = server.enter_context(serving(api(house, tmp_path)))
        streams = [
            stack.enter_context(listening(stack.enter_context(client)))
            for client in (browser(address), program(address))
        ]

        server.close()

        assert [list(lines) for lines in streams] == [[], []]
    assert "timeout graceful shutdown exceeded" not in caplog.text


def test_a_run_that_the_end_of_the_server_meets_can_be_continued(tmp_path: Path) -> None:
    with toy_house(tmp_path, LocalRunner) as house:
        house.rigs.faults.hold = threading.Event()  # the camera delivers nothing
        with serving(api(house, tmp_path)) as address, program(address) as client:
            with listening(client) as lines:
                scan = house.create().id
                assert client.post(f"/api/scans/{scan}/runs", json={}).status_code == 202
                assert next(line for line in lines if '"stage":"toy_look"' in line)

    with contextlib.closing(data_folder(tmp_path)[0]) as database, database.reading() as rows:
        job = rows.jobs.last_of(scan)
    assert job is not None
    assert job.status is JobStatus.INTERRUPTED


def test_without_a_token_there_are_no_events(address: str) -> None:
    assert httpx.get(address + "/api/events", trust_env=False).status_code == 401
