"""How long a capture is going to take: told from what it has taken so far."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from backend.domain.shots import OneOf


class Pace:
    """Estimates how long the rest of a burst takes: its light time, and what each shot took on top so far."""

    def __init__(self, exposures_ms: Sequence[float], clock: Callable[[], float]) -> None:
        self._light_s = np.concatenate([[0.0], np.cumsum(exposures_ms) / 1000.0])
        self._clock = clock
        self._began = clock()

    def remaining_s(self, done: int) -> float | None:
        """Return the seconds left after `done` shots; None before the first, and for a single shot."""
        count = len(self._light_s) - 1
        if done == 0 or count == 1:
            return None
        light_s = self._light_s[done]
        left_s = self._light_s[-1] - light_s
        elapsed_s = self._clock() - self._began
        if elapsed_s < light_s:
            # Faster than light: a simulated rig doesn't wait for its exposures.
            return float(left_s * elapsed_s / light_s)
        return float(left_s + (elapsed_s - light_s) / done * (count - done))


@dataclass(frozen=True)
class Series:
    """Bursts that are alike, one after the other; a burst of its own is a series of one."""

    number: int = 0
    """Of the present burst, from 0."""
    count: int = 1
    word: str = ""
    first: int = 0
    """The first that was exposed from its beginning on."""
    first_began_s: float | None = None
    began_s: float | None = None
    """When the present one began; None while it hasn't, or where part of it was known."""

    def followed_by(self, burst: OneOf) -> "Series":
        """Return the same series at its next burst, or a new one."""
        goes_on = self.count == burst.count and self.number == burst.number - 1
        before = self if goes_on else Series()
        return replace(
            before, number=burst.number, count=burst.count, word=burst.word, began_s=None
        )

    def begun(self, now_s: float) -> "Series":
        """Return it with a present burst all of which is going to be exposed."""
        if self.first_began_s is not None:
            return replace(self, began_s=now_s)
        return replace(self, first=self.number, first_began_s=now_s, began_s=now_s)

    @property
    def prefix(self) -> str:
        """What the present burst is called, in front of what is exposed."""
        return f"{self.word} {self.number + 1} of {self.count}: " if self.count > 1 else ""

    def share(self, of_burst: float) -> float:
        """Return the share of all bursts done."""
        return (self.number + of_burst) / self.count

    def remaining_s(self, of_burst_s: float | None, clock: Callable[[], float]) -> float | None:
        """Return the seconds left of all bursts; those to come take as long as those so far.

        Parameters
        ----------
        of_burst_s
            Left of the present one; None: not known yet.
        clock
            What time it is.
        """
        following = self.count - 1 - self.number
        if not following:
            return of_burst_s
        if self.began_s is None or self.first_began_s is None:
            return None
        elapsed_s = clock() - self.began_s
        if self.number > self.first:
            burst_s = (self.began_s - self.first_began_s) / (self.number - self.first)
        elif of_burst_s is not None:
            burst_s = elapsed_s + of_burst_s
        else:
            return None
        left_s = max(0.0, burst_s - elapsed_s) if of_burst_s is None else of_burst_s
        return left_s + following * burst_s
