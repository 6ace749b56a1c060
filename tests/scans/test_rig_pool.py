"""Rigs: opened when needed, one thread each, lent to one at a time, opened anew after a loss."""

import threading

import pytest

from backend.contract.events import Event, RigChanged
from backend.devices.errors import DeviceDisconnected
from backend.devices.protocols import LinkState, Rig
from backend.domain.errors import RigBusyError, RigFailedError
from backend.jobs.rigs import LivePicture, Owner, RigPool
from tests.scans.toy import ToyRig, ToyRigs

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


def newest(place: Place) -> LivePicture | None:
    """Ask twice: the first question asks for a picture that the second one finds."""
    place.pool.live("toy", "left")
    place.pool.use("toy", {}, lambda rig: None)  # waits until the rig's thread has taken it
    return place.pool.live("toy", "left")


def test_an_idle_rig_takes_a_picture_under_white_light_on_request(place: Place) -> None:
    assert place.pool.live("toy", "left") is None, "nobody has opened it"
    place.pool.given("toy", {})
    assert place.pool.live("toy", "left") is None
    picture = newest(place)
    assert picture is not None
    assert picture.gray.max() > 20
    rig = place.rigs.opened[0]
    assert rig.projector.picture.max() == 0, "dark again"
    assert {camera.state for camera in rig.cameras.values()} == {LinkState.READY}


def test_a_lent_rig_isnt_disturbed(place: Place) -> None:
    with place.pool.lease("toy", {}, ADA) as lease:
        shown = LivePicture(place.rigs.opened[0].projector.picture, 8)
        place.pool.show("toy", "left", shown)
        assert place.pool.live("toy", "left") is shown
        lease.call(lambda rig: None)
        assert place.rigs.shots == 0


def test_many_questions_are_one_picture(place: Place) -> None:
    place.pool.given("toy", {})
    blocked, go_on = threading.Event(), threading.Event()

    def before(shot: int) -> None:
        blocked.set()
        assert go_on.wait(10)

    place.rigs.faults.before_shot = before
    place.pool.live("toy", "left")
    assert blocked.wait(10)
    for _ in range(20):
        assert place.pool.live("toy", "left") is None, "never waits"
    go_on.set()
    place.pool.use("toy", {}, lambda rig: None)
    assert place.rigs.shots == 1


def test_a_failing_idle_picture_is_no_error(place: Place) -> None:
    place.pool.given("toy", {})
    place.rigs.faults.errors = {1: [DeviceDisconnected("left", "gone")]}
    assert newest(place) is None or place.rigs.shots > 1
    rig: ToyRig = place.rigs.opened[0]
    assert rig.closed == 0
