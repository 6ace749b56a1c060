"""Events as the lines of a stream."""

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable

from backend.api.events import event_lines
from backend.contract.events import Event, RigChanged, ScanChanged

MINE, OTHER = ScanChanged(scan="mine", revision=3), ScanChanged(scan="other", revision=1)
RIG = RigChanged(rig="simulated")


def run(work: Callable[[], Awaitable[None]]) -> None:
    async def main() -> None:
        async with asyncio.timeout(30):
            await work()

    asyncio.run(main())


async def these(*events: Event) -> AsyncIterator[Event]:
    for event in events:
        yield event


class Quiet:
    """A subscription in which nothing happens; knows whether it was given up."""

    def __init__(self) -> None:
        self.closed = False

    async def events(self) -> AsyncGenerator[Event, None]:
        try:
            await asyncio.Event().wait()
            yield RIG
        finally:
            self.closed = True


def test_an_event_is_its_kind_and_its_document() -> None:
    async def work() -> None:
        welcome, line = [line async for line in event_lines(these(MINE))]
        assert welcome.startswith(":")
        kind, data, *end = line.split("\n")
        assert kind == "event: scan_changed"
        assert json.loads(data.removeprefix("data: ")) == MINE.model_dump()
        assert end == ["", ""]

    run(work)


def test_only_the_scan_asked_for_and_what_belongs_to_none() -> None:
    async def work() -> None:
        lines = [line async for line in event_lines(these(OTHER, MINE, RIG), "mine")]
        assert [line.split("\n")[0] for line in lines[1:]] == [
            "event: scan_changed",
            "event: rig_changed",
        ]
        assert '"mine"' in lines[1]

    run(work)


def test_with_nothing_to_tell_it_says_that_it_is_there_and_loses_no_event() -> None:
    async def work() -> None:
        told = asyncio.Event()

        async def late() -> AsyncIterator[Event]:
            await told.wait()
            yield MINE

        lines = event_lines(late(), heartbeat_s=0.001)
        first = [await anext(lines) for _ in range(3)]
        told.set()
        rest = [line async for line in lines]
        assert first[1:] == [": still here\n\n"] * 2
        assert [line for line in rest if not line.startswith(":")] == [
            f"event: scan_changed\ndata: {MINE.model_dump_json()}\n\n"
        ]

    run(work)


def test_it_ends_with_the_session_and_gives_up_its_subscription() -> None:
    async def work() -> None:
        quiet, logout = Quiet(), asyncio.Event()

        async def session_ends() -> None:
            await logout.wait()

        lines = event_lines(quiet.events(), end=session_ends())
        await anext(lines)
        waiting = asyncio.ensure_future(anext(lines, None))
        await asyncio.sleep(0)
        logout.set()
        assert await waiting is None
        assert quiet.closed

    run(work)


def test_closed_by_the_client_it_gives_up_its_subscription() -> None:
    async def work() -> None:
        quiet = Quiet()
        lines = event_lines(quiet.events())
        await anext(lines)
        waiting = asyncio.ensure_future(anext(lines))
        for _ in range(3):
            await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        await lines.aclose()
        assert quiet.closed

    run(work)
