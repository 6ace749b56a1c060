"""Rigs: opened when needed, one thread each, lent to one at a time, opened anew after a loss."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from backend.contract.events import Event, RigChanged
from backend.contract.rigs import RigLink
from backend.devices.errors import DeviceDisconnected, DeviceStalled, DeviceTimeout
from backend.devices.protocols import LinkState, Rig
from backend.domain.errors import RigBusyError, RigFailedError
from backend.jobs import rig_thread, rigs
from backend.jobs.live import LivePicture, LiveWish
from backend.jobs.rigs import Owner, RigPool
from tests.scans.toy import ToyRigs

ADA = Owner("1", "bracket", "ada")
BOB = Owner("2", "cover", "bob")


class Place:
    def __init__(self) -> None:
        self.rigs = ToyRigs()
        self.events: list[Event] = []
        self.pool = RigPool(self.rigs, self.events.append)


@pytest.fixture
def place() -> Place:
    return Place()


def test_facts_are_asked_once(place: Place) -> None:
    first = place.pool.given("toy", {"calibrated": True})
    assert place.pool.given("toy", {"calibrated": True}) is first
    assert first.facts.reference == "left"
    assert first.calibration is not None
    assert len(place.rigs.opened) == 1
    assert place.events == [RigChanged(rig="toy")]


def test_a_rig_is_used_by_its_own_thread_only(place: Place) -> None:
    def who(rig: Rig) -> int:
        return threading.get_ident()

    threads = {place.pool.use("toy", {}, who) for _ in range(3)}
    with place.pool.lease("toy", {}, ADA) as lease:
        threads |= {lease.call(who)}
    assert len(threads) == 1
    assert threading.get_ident() not in threads


def test_only_one_owner_at_a_time(place: Place) -> None:
    with place.pool.lease("toy", {}, ADA):
        assert place.pool.owner("toy") == ADA
        with (
            pytest.raises(RigBusyError, match="Rig 'toy' is busy: ada captures scan 'bracket'"),
            place.pool.lease("toy", {}, BOB),
        ):
            pass
        with place.pool.lease("other", {}, BOB):
            assert place.pool.owner("other") == BOB
    assert place.pool.owner("toy") is None
    with place.pool.lease("toy", {}, BOB):
        pass


def test_other_options_close_the_rig_first_but_never_a_lent_one(place: Place) -> None:
    place.pool.given("toy", {"seed": 1})
    place.pool.given("toy", {"seed": 2})
    assert [(rig.options["seed"], rig.closed) for rig in place.rigs.opened] == [(1, 1), (2, 0)]
    with place.pool.lease("toy", {"seed": 2}, ADA):
        assert place.pool.given("toy", {"seed": 1}), "known already"
        assert place.pool.use("toy", {"seed": 2}, lambda rig: rig.name) == "toy"
        with pytest.raises(RigBusyError):
            place.pool.given("toy", {"seed": 3})
    assert place.pool.given("toy", {"seed": 3})


def test_a_busy_rig_refuses_other_options_at_once(place: Place) -> None:
    """Not when its thread has time again."""
    blocked = threading.Event()
    with place.pool.lease("toy", {}, ADA) as lease:
        work = threading.Thread(target=lease.call, args=(lambda rig: blocked.wait(20),))
        work.start()
        for ask in (place.pool.given, place.pool.ask):
            with pytest.raises(RigBusyError):
                ask("toy", {"seed": 9})
        blocked.set()
        work.join()


def test_who_connects_meanwhile_never_changes_a_lent_rig(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also not if he comes while the rig that was open before is being closed."""
    place.pool.given("toy", {"seed": 1})
    closing = threading.Event()
    close = place.rigs.opened[0].close

    def close_slowly() -> None:
        assert closing.wait(20)
        close()

    monkeypatch.setattr(place.rigs.opened[0], "close", close_slowly)
    place.pool.disconnect("toy")

    def capture() -> object:
        with place.pool.lease("toy", {"seed": 2}, ADA) as lease:
            return lease.call(lambda rig: place.rigs.opened[-1].options)

    with ThreadPoolExecutor(1) as others:
        options = others.submit(capture)
        until(lambda: place.pool.owner("toy") == ADA)
        place.pool.connect("toy", {"seed": 3})
        closing.set()
        assert options.result(20) == {"seed": 2}
    assert place.pool.status("toy").link is RigLink.OPEN


def test_a_rig_that_opens_too_late_changes_nothing(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig_thread, "_patience_s", lambda rig: 0.2)
    monkeypatch.setattr(rig_thread, "GRACE_S", 0.0)
    hangs = threading.Event()

    def hang() -> None:
        assert hangs.wait(20)

    place.rigs.faults.before_open = hang
    with pytest.raises(DeviceStalled, match="hasn't come back from opening"):
        place.pool.given("toy", {"seed": 1})
    place.rigs.faults.before_open = lambda: None
    place.pool.given("toy", {"seed": 2})
    hangs.set()
    until(lambda: place.rigs.opened[0].closed > 0)
    status = place.pool.status("toy")
    assert status.link is RigLink.OPEN
    assert [d.device for d in status.devices][:1] == [place.rigs.opened[1].cameras["left"]]


def test_bad_options_are_refused_at_once(place: Place) -> None:
    with pytest.raises(RigFailedError, match="doesn't answer"):
        place.pool.ask("toy", {"broken": True})


def test_options_in_another_order_are_the_same(place: Place) -> None:
    place.pool.given("toy", {"seed": 1, "noise": True})
    place.pool.use("toy", {"noise": True, "seed": 1}, lambda rig: None)
    assert len(place.rigs.opened) == 1


@pytest.mark.parametrize(
    "error",
    [RigFailedError("left: gone."), DeviceDisconnected("left", "gone")],
    ids=["rig", "device"],
)
def test_a_rig_that_failed_is_opened_anew(place: Place, error: Exception) -> None:
    def fail(rig: Rig) -> None:
        raise error

    with pytest.raises(type(error)), place.pool.lease("toy", {}, ADA) as lease:
        lease.call(fail)
    assert place.pool.owner("toy") is None
    assert place.rigs.opened[0].closed == 1
    with place.pool.lease("toy", {}, ADA):
        assert len(place.rigs.opened) == 2


def test_a_rig_that_was_lost_meanwhile_is_opened_anew(place: Place) -> None:
    place.pool.given("toy", {})
    place.rigs.opened[0].cameras["left"].state = LinkState.LOST
    assert place.pool.use("toy", {}, lambda rig: rig.cameras["left"].state) is LinkState.READY
    assert [rig.closed for rig in place.rigs.opened] == [1, 0]


def test_a_rig_that_cant_be_opened_isnt_owned_afterwards(place: Place) -> None:
    for _ in range(2):
        with (
            pytest.raises(RigFailedError, match="Rig 'toy' doesn't answer"),
            place.pool.lease("toy", {"broken": True}, ADA),
        ):
            pass
    assert place.pool.owner("toy") is None


def test_closing_gives_every_rig_back(place: Place) -> None:
    place.pool.given("toy", {})
    place.pool.given("other", {})
    place.pool.close()
    assert [rig.closed for rig in place.rigs.opened] == [1, 1]


# live pictures

WISH = LiveWish(exposure_ms=10.0)


def settled(place: Place) -> None:
    """Wait until the rig's thread has done what it was asked for."""
    place.pool.use("toy", {}, lambda rig: None)


def newest(place: Place, wish: LiveWish = WISH) -> LivePicture | None:
    place.pool.wish("toy", wish)
    place.pool.watch("toy")
    settled(place)
    return place.pool.live("toy", "left")


def test_looking_asks_for_nothing(place: Place) -> None:
    assert place.pool.live("toy", "left") is None, "nobody has opened it"
    place.pool.given("toy", {})
    place.pool.wish("toy", WISH)
    assert place.pool.live("toy", "left") is None
    settled(place)
    assert place.pool.live("toy", "left") is None
    assert all(camera.frames == 0 for camera in place.rigs.opened[0].cameras.values())


def test_a_watched_rig_takes_pictures_as_wished_and_stays_armed(place: Place) -> None:
    place.pool.given("toy", {})
    first, second = newest(place), newest(place)
    assert first is not None
    assert second is not None
    assert second.number > first.number
    assert first.exposure_ms == pytest.approx(10.0)
    assert first.gray.max() > 200, "white"
    rig = place.rigs.opened[0]
    assert {camera.state for camera in rig.cameras.values()} == {LinkState.ARMED}
    assert rig.configured == 2, "once for each camera"
    gray = newest(place, LiveWish(exposure_ms=5.0, pattern="gray", level=100))
    assert gray is not None
    assert gray.gray.max() == pytest.approx(50, abs=1)


def test_rest_disarms_and_darkens(place: Place) -> None:
    place.pool.given("toy", {})
    newest(place)
    place.pool.rest("toy")
    settled(place)
    rig = place.rigs.opened[0]
    assert {camera.state for camera in rig.cameras.values()} == {LinkState.READY}
    assert rig.projector.picture.max() == 0
    assert not place.pool.status("toy").is_live


def test_pictures_end_by_themselves_when_nobody_looks(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rigs, "LIVE_HOLD_S", 0.05)
    place.pool.given("toy", {})
    newest(place)
    rig = place.rigs.opened[0]
    until(lambda: all(camera.state is LinkState.READY for camera in rig.cameras.values()))


def test_a_capture_finds_cameras_at_rest_and_isnt_disturbed(place: Place) -> None:
    place.pool.given("toy", {})
    newest(place)
    with place.pool.lease("toy", {}, ADA) as lease:
        states = lease.call(lambda rig: {camera.state for camera in rig.cameras.values()})
        assert states == {LinkState.READY}
        frames = place.rigs.opened[0].cameras["left"].frames
        shown = LivePicture(place.rigs.opened[0].projector.picture, 8)
        place.pool.show("toy", "left", shown)
        place.pool.watch("toy")
        assert place.pool.live("toy", "left") is shown
        lease.call(lambda rig: None)
        assert place.rigs.opened[0].cameras["left"].frames == frames
    later = newest(place)
    assert later is not shown


def test_many_questions_are_one_picture(place: Place) -> None:
    place.pool.given("toy", {})
    place.pool.wish("toy", WISH)
    place.rigs.faults.hold = threading.Event()
    for _ in range(20):
        place.pool.watch("toy")
        assert place.pool.live("toy", "left") is None, "never waits"
    place.rigs.faults.hold.set()
    settled(place)
    assert place.rigs.opened[0].cameras["left"].frames == 1


def test_a_picture_that_fails_is_a_sentence_and_the_next_one_is_tried(place: Place) -> None:
    place.pool.given("toy", {})
    place.rigs.faults.errors = {0: [DeviceTimeout("left", "no frame came")]}
    assert newest(place) is None
    assert place.pool.status("toy").failure == "left: no frame came"
    assert newest(place) is not None
    assert place.pool.status("toy").failure is None


# without a scan


def test_connecting_and_disconnecting(place: Place) -> None:
    assert place.pool.status("toy").link is RigLink.CLOSED
    place.pool.connect("toy", {"seed": 3})
    settled_with(place, {"seed": 3})
    status = place.pool.status("toy")
    assert (status.link, status.options) == (RigLink.OPEN, {"seed": 3})
    assert [known.info.model for known in status.devices] == ["camera", "camera", "projector"]
    place.pool.connect("toy", {})
    assert len(place.rigs.opened) == 1, "an open one stays as it is"
    place.pool.disconnect("toy")
    until(lambda: place.pool.status("toy").link is RigLink.CLOSED)
    assert place.rigs.opened[0].closed == 1
    place.pool.watch("toy")
    place.pool.reconnect("toy")
    until(lambda: place.pool.status("toy").link is RigLink.OPEN)
    assert [rig.options for rig in place.rigs.opened] == [{"seed": 3}, {"seed": 3}]


def test_a_rig_that_cant_be_connected_says_why(place: Place) -> None:
    place.pool.connect("toy", {"broken": True})
    until(lambda: place.pool.status("toy").failure is not None)
    status = place.pool.status("toy")
    assert (status.link, status.failure) == (
        RigLink.CLOSED,
        "Rig 'toy' doesn't answer: switch it on.",
    )


def test_a_lent_rig_isnt_disconnected(place: Place) -> None:
    with place.pool.lease("toy", {}, ADA):
        for refused in (place.pool.disconnect, place.pool.reconnect):
            with pytest.raises(RigBusyError, match="ada captures scan 'bracket'"):
                refused("toy")
    assert place.rigs.opened[0].closed == 0


def test_disconnecting_ends_a_picture_that_doesnt_come(place: Place) -> None:
    place.pool.given("toy", {})
    place.pool.wish("toy", WISH)
    place.rigs.faults.hold = threading.Event()
    place.pool.watch("toy")
    until(lambda: place.rigs.opened[0].cameras["left"].frames == 1)
    place.pool.disconnect("toy")
    until(lambda: place.pool.status("toy").link is RigLink.CLOSED)
    assert place.rigs.opened[0].closed == 1


def settled_with(place: Place, options: dict[str, Any]) -> None:
    place.pool.use("toy", options, lambda rig: None)


def until(condition: Callable[[], bool]) -> None:
    """Wait for what happens on another thread."""
    pause = threading.Event()
    deadline_s = time.monotonic() + 60.0
    while time.monotonic() < deadline_s:
        if condition():
            return
        pause.wait(0.01)
    raise AssertionError("it didn't happen within 60 s")
