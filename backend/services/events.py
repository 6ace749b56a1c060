"""What happens, from any thread to every subscriber; whoever is slow gets the newest of each kind."""

import asyncio
import threading
import weakref
from collections.abc import AsyncGenerator, Hashable

from backend.contract.events import Event, FrameCaptured, JobProgress, RigChanged, ScanChanged


class EventHub:
    """Passes events on. Nothing queues without bound: an unread event gives way to a newer one of its kind."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # A subscriber lives as long as the generator that reads it, also if that is never started.
        self._subscribers: weakref.WeakSet[_Subscriber] = weakref.WeakSet()

    def publish(self, event: Event) -> None:
        """Tell everybody, from any thread; returns at once."""
        with self._lock:
            subscribers = list(self._subscribers)
        for subscriber in subscribers:
            subscriber.put(event)

    def subscribe(self) -> AsyncGenerator[Event, None]:
        """Return the events from now on. Called inside an event loop, read in that loop; close it to leave."""
        subscriber = _Subscriber(asyncio.get_running_loop())
        with self._lock:
            self._subscribers.add(subscriber)
        return self._read(subscriber)

    async def _read(self, subscriber: "_Subscriber") -> AsyncGenerator[Event, None]:
        try:
            while True:
                yield await subscriber.get()
        finally:
            with self._lock:
                self._subscribers.discard(subscriber)

    def __len__(self) -> int:
        """Count the subscribers."""
        return len(self._subscribers)


class _Subscriber:
    """What one reader hasn't read yet: one event per thing, oldest first."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._waiting: dict[Hashable, Event] = {}
        self._something = asyncio.Event()

    def put(self, event: Event) -> None:
        with self._lock:
            # Out and in again: the newest stands at the end, after what led to it.
            self._waiting.pop(_thing(event), None)
            self._waiting[_thing(event)] = event
        try:
            self._loop.call_soon_threadsafe(self._something.set)
        except RuntimeError:
            # The loop was closed before its reader let go: nobody reads this any more.
            return

    async def get(self) -> Event:
        while True:
            with self._lock:
                if self._waiting:
                    return self._waiting.pop(next(iter(self._waiting)))
                self._something.clear()
            await self._something.wait()


def _thing(event: Event) -> Hashable:
    """Name what an event is about: of two about one thing the newer says it all."""
    match event:
        case ScanChanged():
            return event.kind, event.scan
        case JobProgress():
            return event.kind, event.job.id
        case FrameCaptured():
            return event.kind, event.rig, event.camera
        case RigChanged():
            return event.kind, event.rig
