"""How long a series of bursts is going to take."""

import pytest

from backend.domain.shots import OneOf
from backend.jobs.pace import Series


def at(number: int, before: Series | None = None, count: int = 4) -> Series:
    return (before or Series()).followed_by(OneOf((), number, count, "look"))


def test_a_burst_of_its_own_is_all_there_is():
    alone = Series()
    assert (alone.prefix, alone.share(0.25)) == ("", 0.25)
    assert alone.remaining_s(7.0, lambda: 0.0) == 7.0
    assert alone.remaining_s(None, lambda: 0.0) is None


def test_bursts_to_come_take_as_long_as_those_so_far():
    first = at(0).begun(100.0)
    assert first.remaining_s(None, lambda: 100.0) is None
    assert first.remaining_s(8.0, lambda: 102.0) == pytest.approx(8 + 3 * 10)
    third = at(2, at(1, first).begun(112.0)).begun(124.0)
    assert third.prefix == "look 3 of 4: "
    assert third.share(0.5) == pytest.approx(2.5 / 4)
    assert third.remaining_s(None, lambda: 124.0) == pytest.approx(12 + 12)
    assert third.remaining_s(5.0, lambda: 130.0) == pytest.approx(5 + 12)
    last = at(3, third).begun(136.0)
    assert last.remaining_s(5.0, lambda: 130.0) == 5.0


def test_a_burst_that_was_known_in_part_says_nothing_of_the_others():
    resumed = at(1)
    assert resumed.remaining_s(3.0, lambda: 50.0) is None
    whole = at(2, resumed).begun(60.0)
    assert whole.remaining_s(6.0, lambda: 62.0) == pytest.approx(6 + 8)


def test_another_series_begins_anew():
    old = at(1, at(0).begun(0.0)).begun(10.0)
    assert at(2, old, count=5).first_began_s is None
    assert at(0, old).first_began_s is None
