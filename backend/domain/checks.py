"""What a stage says about the quality of its own result."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from backend.domain.states import Level


@dataclass(frozen=True)
class Check:
    """One finding: a value against a limit, and a sentence for the operator."""

    name: str
    level: Level
    sentence: str
    value: float | None = None
    """None where there is nothing to measure; what isn't a finite number becomes None: JSON has none."""
    limit: float | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        """Leave out numbers that can't be stored."""
        for name in ("value", "limit"):
            number = getattr(self, name)
            if number is not None and not math.isfinite(number):
                object.__setattr__(self, name, None)


CheckFunction = Callable[[Any, Any], Check]
"""A pure function of (result, settings)."""


def at_least(
    name: str,
    value: float,
    *,
    warning: float,
    failure: float,
    sentence: str,
    unit: str = "",
    remedy: str = "",
) -> Check:
    """Grade a value that should be large: below `failure` it fails, below `warning` it warns.

    `remedy` says what to do; it follows the sentence where the value is too small.
    """
    if remedy and value < warning:
        sentence = f"{sentence}: {remedy}"
    level = Level.FAILURE if value < failure else Level.WARNING if value < warning else Level.OK
    return Check(
        name, level, sentence, float(value), failure if level is Level.FAILURE else warning, unit
    )


def at_most(
    name: str, value: float, *, warning: float, failure: float, sentence: str, unit: str = ""
) -> Check:
    """Grade a value that should be small: above `failure` it fails, above `warning` it warns."""
    level = Level.FAILURE if value > failure else Level.WARNING if value > warning else Level.OK
    return Check(
        name, level, sentence, float(value), failure if level is Level.FAILURE else warning, unit
    )


def worst(checks: tuple[Check, ...]) -> Level:
    """Return the gravest level among the checks, ok if there are none."""
    order = [Level.OK, Level.WARNING, Level.FAILURE]
    return max((check.level for check in checks), key=order.index, default=Level.OK)
