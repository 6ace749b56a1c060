"""The station's process: started, watched, started again, ended."""

import asyncio
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import textwrap
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from backend.api import station as station_module
from backend.api.station import Phase, Station, child_environment

# Say which port, then do nothing until the end.
READY = 'import json, signal; print(json.dumps({"port": 4711}), flush=True); signal.pause()'


def script(text: str) -> tuple[str, ...]:
    return (sys.executable, "-c", textwrap.dedent(text))


@contextlib.asynccontextmanager
async def running(station: Station) -> AsyncIterator[None]:
    task = asyncio.create_task(station.run())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30):
        while not condition():  # noqa: ASYNC110  there is no event to wait for: the phase is a plain value
            await asyncio.sleep(0.005)


def run(work: Callable[[], Awaitable[None]]) -> None:
    async def main() -> None:
        await work()

    asyncio.run(main())


def test_it_is_up_when_the_child_has_said_its_port() -> None:
    station = Station("http://127.0.0.1:8000", script(READY))
    assert station.message == "The station is starting."

    async def work() -> None:
        async with running(station):
            await until(lambda: station.phase is Phase.UP)
            assert station.port == 4711

    run(work)

    assert station.phase is Phase.STOPPED
    assert station.port is None


def test_the_child_learns_secret_and_address_but_no_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNGLARE_TOKEN", "for operators only")
    told = tmp_path / "environment.json"
    command = script(
        f"""
        import json, os, signal
        json.dump(dict(os.environ), open({str(told)!r}, "w"))
        {READY.partition("; ")[2]}
        """
    )
    station = Station("http://127.0.0.1:8123", command)

    async def work() -> None:
        async with running(station):
            await until(lambda: station.phase is Phase.UP)

    run(work)

    environment = json.loads(told.read_text())
    assert environment["UNGLARE_STATION_SECRET"] == station.secret
    assert environment["UNGLARE_API_URL"] == "http://127.0.0.1:8123"
    assert "UNGLARE_TOKEN" not in environment
    assert len(station.secret) >= 32


def test_a_child_that_dies_is_started_again() -> None:
    says_its_pid = READY.replace("4711", "os.getpid()").replace("import json", "import json, os")
    station = Station("http://127.0.0.1:8000", script(says_its_pid), pause_s=0.001)
    lives: list[int] = []

    async def work() -> None:
        async with running(station):
            for _ in range(3):
                await until(lambda: station.port not in [None, *lives])
                lives.append(station.port or 0)
                os.kill(lives[-1], signal.SIGKILL)

    run(work)

    assert len(set(lives)) == 3


def test_what_happened_to_it_is_said(caplog: pytest.LogCaptureFixture) -> None:
    station = Station("http://127.0.0.1:8000", script("raise SystemExit(3)"), pause_s=30.0)

    async def work() -> None:
        async with running(station):
            await until(lambda: station.phase is Phase.WAITING)
            assert station.message == "The station ended with status 3 and is being started again."

    run(work)

    assert "The station ended with status 3; next start in 30.0 s." in caplog.text


def test_pauses_double_up_to_half_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 8:
            raise asyncio.CancelledError

    async def die(_self: Station) -> str:
        return "ended"

    monkeypatch.setattr("backend.api.station.asyncio.sleep", pause)
    monkeypatch.setattr(Station, "_one_life", die)

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(Station("http://127.0.0.1:8000", pause_s=0.5).run())

    assert pauses == [0.5, 1, 2, 4, 8, 16, 30, 30]


def test_a_long_life_makes_the_next_pause_short_again(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    times = iter([0, 1, 10, 11, 20, 85, 100, 101])  # beginnings and ends of four lives

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 4:
            raise asyncio.CancelledError

    async def die(_self: Station) -> str:
        return "ended"

    monkeypatch.setattr("backend.api.station.asyncio.sleep", pause)
    monkeypatch.setattr(Station, "_one_life", die)

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(Station("u", pause_s=0.5, clock=lambda: float(next(times))).run())

    assert pauses == [0.5, 1, 0.5, 1]


def test_its_lines_go_to_our_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "unglare.station")
    talk = """
        import json, sys
        print("before", flush=True)
        print(json.dumps({"port": 1}), flush=True)
        print("x" * 200_000, flush=True)
        print("to the error output", file=sys.stderr, flush=True)
        """
    station = Station("http://127.0.0.1:8000", script(talk), pause_s=30.0)

    async def work() -> None:
        async with running(station):
            await until(lambda: station.phase is Phase.WAITING)

    run(work)

    lines = [record.getMessage() for record in caplog.records]
    assert "before" in lines
    assert "to the error output" in lines
    assert any(line.startswith("The station is up") for line in lines)


def test_a_program_that_isnt_there_is_tried_again_and_named() -> None:
    station = Station("http://127.0.0.1:8000", ("/does/not/exist",), pause_s=30.0)

    async def work() -> None:
        async with running(station):
            await until(lambda: station.phase is Phase.WAITING)

    run(work)

    assert station.starts == 1


def test_a_child_that_doesnt_listen_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(station_module, "_FAREWELL_S", 0.05)
    stubborn = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + READY
    station = Station("http://127.0.0.1:8000", script(stubborn))

    async def work() -> None:
        async with running(station):
            await until(lambda: station.phase is Phase.UP)

    run(work)

    assert station.phase is Phase.STOPPED


def test_the_child_dies_with_its_parent_however_that_ends() -> None:
    parent = f"""
        import asyncio, os, signal, sys
        from backend.api.station import Station
        child = 'import json, os, signal; print(json.dumps({{"port": os.getpid()}}), flush=True); signal.pause()'
        station = Station("http://127.0.0.1:1", ({sys.executable!r}, "-c", child))
        async def main():
            asyncio.create_task(station.run())
            while station.port is None:
                await asyncio.sleep(0.01)
            print(station.port, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        asyncio.run(main())
        """
    done = subprocess.run(script(parent), stdout=subprocess.PIPE, text=True, timeout=60)
    child = int(done.stdout)

    assert done.returncode == -signal.SIGKILL
    with contextlib.suppress(ProcessLookupError):  # gone already
        handle = os.pidfd_open(child)
        try:
            assert select.select([handle], [], [], 30)[0], "the child outlived its parent"
        finally:
            os.close(handle)


def test_the_environment_keeps_what_isnt_ours() -> None:
    ours = {"PATH": "/bin", "UNGLARE_VIEWER_TOKEN": "secret", "PYTHONPATH": "/elsewhere"}

    environment = child_environment(ours, "s", "http://x")

    assert environment["PATH"] == "/bin"
    assert "UNGLARE_VIEWER_TOKEN" not in environment
    assert environment["PYTHONPATH"].endswith(os.pathsep + "/elsewhere")
