"""What stages say of their results can always be stored."""

import json
from dataclasses import asdict

import pytest

from backend.domain.checks import Check, at_least, at_most, worst
from backend.domain.states import Level


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_value_that_is_no_number_is_left_out(value):
    check = Check("share", Level.OK, "nothing was measured", value, value)
    assert (check.value, check.limit) == (None, None)
    json.dumps(asdict(check), allow_nan=False)
    assert at_most("share", value, warning=1, failure=2, sentence="a sentence").value is None


def test_values_are_graded_from_both_sides():
    good, middling, bad = (
        at_least("share", v, warning=0.5, failure=0.1, sentence="a sentence")
        for v in (0.9, 0.3, 0.05)
    )
    grades = [good.level, middling.level, bad.level]
    assert grades == [Level.OK, Level.WARNING, Level.FAILURE]
    checks = (good, middling)
    assert worst(checks) is Level.WARNING
    assert worst(()) is Level.OK
