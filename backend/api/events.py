"""What happens, as it happens: server-sent events."""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Coroutine
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.responses import StreamingResponse
from starlette.types import Send

from backend.api.access import Who
from backend.api.context import context_of
from backend.contract.events import Event

HEARTBEAT_S = 15.0
"""A comment so often: a dead connection is noticed, and no proxy in between takes it for idle."""

router = APIRouter(tags=["events"])


class EventStream(StreamingResponse):
    """A stream that gives up its subscription at once when the client goes away."""

    media_type = "text/event-stream"

    async def stream_response(self, send: Send) -> None:
        """Send until the events or the client end."""
        lines = self.body_iterator
        try:
            await super().stream_response(send)
        finally:
            # Cancelled while sending, the generator would wait for the garbage collector.
            if isinstance(lines, AsyncGenerator):
                await lines.aclose()


@router.get(
    "/events",
    response_class=EventStream,
    responses={200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}}},
)
async def event_stream(
    request: Request,
    who: Who,
    scan: Annotated[
        str | None, Query(max_length=64, description="Only this scan's events.")
    ] = None,
) -> EventStream:
    """Tell events as they come (`event: kind`, `data: JSON`); who may have missed some asks for the state."""
    context = context_of(request)
    end = context.sessions.wait_for_end(who.session)
    lines = event_lines(context.services.events.subscribe(), scan, end)
    return EventStream(lines, headers={"X-Accel-Buffering": "no"})


async def event_lines(
    events: AsyncIterator[Event],
    scan: str | None = None,
    end: Coroutine[Any, Any, None] | None = None,
    *,
    heartbeat_s: float = HEARTBEAT_S,
) -> AsyncGenerator[str, None]:
    """Write events as the stream's lines.

    Parameters
    ----------
    events
        What to tell; closed at the end.
    scan
        Events of other scans are left out; None tells all.
    end
        The stream ends when this returns; None: never.
    heartbeat_s
        With nothing to tell for so long [s], a comment is written.
    """
    yield ": unglare\nretry: 2000\n\n"
    ended: asyncio.Future[Any] = asyncio.ensure_future(end or asyncio.Event().wait())
    following: asyncio.Future[Any] | None = None
    try:
        while not ended.done():
            following = following or asyncio.ensure_future(anext(events))
            await asyncio.wait(
                {following, ended}, timeout=heartbeat_s, return_when=asyncio.FIRST_COMPLETED
            )
            if following.done():
                event, following = following.result(), None
                if getattr(event, "scan", scan) == scan or scan is None:
                    yield f"event: {event.kind}\ndata: {event.model_dump_json()}\n\n"
            elif not ended.done():
                yield ": still here\n\n"
    except StopAsyncIteration:
        return
    finally:
        tasks = [ended] if following is None else [ended, following]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if isinstance(events, AsyncGenerator):
            await events.aclose()
