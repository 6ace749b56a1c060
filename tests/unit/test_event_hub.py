"""Events from threads to readers; slow readers get the newest of each kind."""

import asyncio
import gc
import threading

from backend.contract.events import Event, FrameCaptured, JobProgress, RigChanged, ScanChanged
from backend.contract.scans import JobView
from backend.domain.states import JobStatus
from backend.services.events import EventHub


def progress(job: str, share: float) -> JobProgress:
    view = JobView(
        id=job, status=JobStatus.RUNNING, stage="zones", progress=share, text="", remaining_s=None, error=None, who="ada",
    )  # fmt: skip
    return JobProgress(scan="s", job=view)


def frame(camera: str, artifact: str) -> FrameCaptured:
    return FrameCaptured(
        scan="s", rig="r", camera=camera, artifact=artifact, exposure_ms=1.0, text=""
    )


async def take(hub: EventHub, *published: Event) -> list[Event]:
    """Publish while nobody reads, then read what is there."""
    events = hub.subscribe()
    for event in published:
        hub.publish(event)
    hub.publish(RigChanged(rig="last"))
    got: list[Event] = []
    async for event in events:
        if event == RigChanged(rig="last"):
            break
        got.append(event)
    await events.aclose()
    return got


def test_events_come_in_order() -> None:
    published: list[Event] = [
        ScanChanged(scan="a", revision=1),
        progress("j", 0.5),
        ScanChanged(scan="b", revision=2),
    ]
    assert asyncio.run(take(EventHub(), *published)) == published


def test_of_events_about_one_thing_the_newest_is_told() -> None:
    many = [progress("j", n / 1000) for n in range(1000)]
    frames = [frame(camera, str(n)) for n in range(100) for camera in ("left", "right")]
    scans = [ScanChanged(scan="a", revision=n) for n in range(5)]
    got = asyncio.run(take(EventHub(), *scans, *many, progress("other", 0.1), *frames))
    assert got == [scans[-1], many[-1], progress("other", 0.1), *frames[-2:]]


def test_the_newest_stands_after_what_led_to_it() -> None:
    first, second = ScanChanged(scan="a", revision=1), ScanChanged(scan="a", revision=2)
    assert asyncio.run(take(EventHub(), first, progress("j", 1.0), second)) == [
        progress("j", 1.0),
        second,
    ]


def test_every_subscriber_gets_every_event_from_any_thread() -> None:
    async def two() -> list[Event]:
        hub = EventHub()
        readers = [hub.subscribe(), hub.subscribe()]
        threading.Thread(target=hub.publish, args=(RigChanged(rig="r"),)).start()
        got = [await anext(reader) for reader in readers]
        for reader in readers:
            await reader.aclose()
        assert len(hub) == 0
        return got

    assert asyncio.run(two()) == [RigChanged(rig="r")] * 2


def test_a_reader_that_never_began_is_forgotten() -> None:
    async def leave() -> int:
        hub = EventHub()
        events = hub.subscribe()
        assert len(hub) == 1
        del events
        gc.collect()
        return len(hub)

    assert asyncio.run(leave()) == 0


def test_publishing_to_a_closed_loop_does_nothing() -> None:
    hub = EventHub()

    async def subscribe() -> object:
        return hub.subscribe()

    reader = asyncio.run(subscribe())
    hub.publish(RigChanged(rig="r"))
    assert reader is not None
