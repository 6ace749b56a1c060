"""The thread-safe side of a job: progress that isn't too much, and a stop that reaches everybody."""

import threading

import pytest

from backend.domain.errors import CancelledError
from backend.jobs.control import JobControl, Live


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_progress_is_told_ten_times_a_second_and_the_last_word_counts() -> None:
    told: list[Live] = []
    clock, last = Clock(), threading.Event()

    def publish(live: Live) -> None:
        told.append(live)
        if live.progress == 0.99:
            last.set()

    control = JobControl(publish, clock=clock)
    control.begin_stage("zones")
    for n in range(100):
        control.progress(n / 100)
    assert len(told) == 1
    assert last.wait(60), "told a moment later"
    clock.now_s = 1.0
    control.progress(1.0)
    assert [live.progress for live in told] == [0.0, 0.99, 1.0]


def test_remaining_time_follows_the_pace() -> None:
    clock = Clock()
    control = JobControl(clock=clock)
    clock.now_s = 100.0
    control.begin_stage("zones")
    control.progress(0.0)
    assert control.live.remaining_s is None
    clock.now_s = 103.0
    control.progress(0.25, "a quarter")
    assert control.live == Live("zones", 0.25, "a quarter", 9.0)


@pytest.mark.parametrize(("reported", "share"), [(-1.0, 0.0), (7.0, 1.0)])
def test_shares_stay_between_0_and_1(reported: float, share: float) -> None:
    control = JobControl()
    control.progress(reported)
    assert control.live.progress == share


def test_a_stop_is_heard_everywhere() -> None:
    control = JobControl()
    control.check()
    control.stop("ada")
    for ask in (
        control.check,
        lambda: control.progress(0.5),
        lambda: control.shots(0.5, "", None),
        lambda: control.pause(60),
        lambda: control.begin_stage("zones"),
    ):
        with pytest.raises(CancelledError, match=r"^Cancelled by ada: finished stages"):
            ask()


def test_the_first_to_stop_is_remembered() -> None:
    control = JobControl()
    control.stop("ada")
    control.stop("bob")
    assert control.stopped_by == "ada"


def test_callbacks_are_called_once_and_only_inside_their_block() -> None:
    control, called = JobControl(), []
    with control.when_stopped(lambda: called.append("before")):
        pass
    with control.when_stopped(lambda: called.append("inside")):
        control.stop("ada")
        control.stop("ada")
    with control.when_stopped(lambda: called.append("late")):
        pass
    assert called == ["inside", "late"]
