"""Which shots of a burst verify one another."""

import numpy as np
import pytest

from backend.domain.frames import InMemory
from backend.domain.patterns import gray_code
from backend.domain.shots import Shot
from backend.jobs.sync_sets import SetKind, Witness, units_of

FACTOR = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
OTHER = FACTOR.copy()


def code(*masks: InMemory) -> tuple[Shot, ...]:
    """Return each pattern beside its inverse, under masks in turn."""
    patterns = gray_code("x", 16)
    return tuple(
        Shot(pattern, 10.0, mask=masks[n % len(masks)]) for n, pattern in enumerate(patterns)
    )


@pytest.mark.parametrize(
    "masks",
    [(InMemory(FACTOR),), (InMemory(FACTOR), InMemory(FACTOR))],
    ids=["one mask", "one mask wrapped anew"],
)
def test_pairs_under_one_mask_verify_one_another_and_cost_one_marker(masks):
    burst = code(*masks)
    units = units_of(burst, dict.fromkeys(range(len(burst)), ("left",)), seed="s")
    kinds = [one.kind for unit in units for one in unit.sets]
    assert kinds == [SetKind.PAIR] * (len(burst) // 2)
    witnesses = [p.witness for unit in units for p in unit.planned if p.witness is not None]
    assert witnesses == [Witness.MARKER]


def test_under_two_masks_there_is_no_pair():
    burst = code(InMemory(FACTOR), InMemory(OTHER))
    units = units_of(burst, dict.fromkeys(range(len(burst)), ("left",)), seed="s")
    assert {one.kind for unit in units for one in unit.sets} == {SetKind.SINGLE}
