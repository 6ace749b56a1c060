"""The search over intervals: at most 3 s on two cores."""

import time

import pytest

from backend.devices.sim.chains import CHAINS
from backend.numerics.interval_search import search_interval
from tests.unit.test_interval_search import scene

pytestmark = pytest.mark.bench


@pytest.mark.parametrize("letter", ["B", "D"])
def test_all_pairs_are_searched_within_three_seconds(letter: str) -> None:
    problem, ramp = scene(CHAINS[letter], 1)
    times_s = []
    for _ in range(3):
        start = time.perf_counter()
        search_interval(problem, ramp)
        times_s.append(time.perf_counter() - start)

    assert min(times_s) < 3.0
