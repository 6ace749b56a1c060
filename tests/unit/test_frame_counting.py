"""Numbers of frames out of the block numbers that cameras send."""

import pytest

from backend.devices.frame_counting import FrameCounter

INVALID = 2**64 - 1


@pytest.mark.parametrize(
    ("blocks", "numbers"),
    [
        ((1, 2, 3), [0, 1, 2]),
        ((0, 1, 2), [0, 1, 2]),
        ((1, 3), [0, 2]),
        ((2,), [1]),
        ((65534, 65535, 1, 2), [65533, 65534, 65535, 65536]),
        ((0, 0, 0), [0, 1, 2]),
        ((1, INVALID, 3), [0, 1, 2]),
        ((INVALID, 2), [0, 1]),
    ],
    ids=["from 1", "from 0", "gap", "first lost", "wraps", "not counted", "failed", "first failed"],
)
def test_every_frame_that_was_exposed_counts_once(blocks, numbers):
    counter = FrameCounter()
    assert [counter.count(block) for block in blocks] == numbers


def test_an_acquisition_goes_on_where_the_one_before_ended():
    counter = FrameCounter()
    counter.count(1)
    counter.restart()
    assert counter.count(1) == 1


def test_a_camera_that_counts_from_anywhere_begins_with_the_next():
    counter = FrameCounter(first_block=None)
    assert [counter.count(block) for block in (INVALID, 77, 78, 80)] == [0, 1, 2, 4]
