"""A projector's latency by cameras that are triggered: longer and longer after its acknowledgement."""

from collections import defaultdict
from collections.abc import Callable, Mapping

import numpy as np

from backend.devices.protocols import TriggerSource
from backend.domain.shots import Progress
from backend.numerics.settling import COMPLETE, Settling, share_of_change
from backend.services.latency_bench import (
    AGREEING,
    STEADY_S,
    Bench,
    Gray,
    lit,
    refuse_endless,
    steady_after_s,
    words_of,
)


class TriggeredBench(Bench):
    """All cameras expose together, at a delay of our choice: as fine as half a period of the display."""

    trigger = TriggerSource.SOFTWARE

    def resolution_ms(self) -> float:
        """Return the distance of the delays that are tried."""
        return self.period_ms / 2

    def steady(self, level: int) -> list[Gray]:
        """Return what each camera sees of a level that has come to rest."""
        return self._changed(level, 0.0, level, STEADY_S)

    def _changed(self, start: int, steady_s: float, target: int, delay_s: float) -> list[Gray]:
        """Change from one level to another and take the pictures."""

        def change() -> list[Gray]:
            self.blank(start)
            self.clock.sleep(steady_s)
            return self._pictures(target, delay_s)

        return self.persistently(change)

    def _pictures(self, level: int, delay_s: float) -> list[Gray]:
        """Show a level, wait from its acknowledgement on, and take one picture with each camera."""
        self.blank(level)
        acknowledged_s = self.clock.now_s()
        self.clock.sleep(max(0.0, delay_s - (self.clock.now_s() - acknowledged_s)))
        for camera in self.cameras:
            self.ask(camera.name, "being triggered", camera.trigger)
        return [self.picture(camera) for camera in self.cameras]

    def settling(
        self,
        target: int,
        steady: Mapping[int, list[Gray]],
        repetitions: int,
        progress: Progress,
    ) -> Settling:
        """Try longer and longer delays once each until the change is over, then those again many times.

        A delay that was too short once is too short: only those that looked long enough are worth repeating.
        """
        step_ms = self.resolution_ms()
        found: dict[int, list[list[float]]] = defaultdict(list)

        def complete(step: int, *, times: int, steady_s: float, done: float) -> bool:
            delay_ms = step * step_ms
            refuse_endless(delay_ms, target)
            share = min(done, 0.98) / 2 + (0.0 if target else 0.5)
            progress(share, f"{words_of(target)}, {delay_ms:.0f} ms after the acknowledgement")
            for _ in range(times):
                found[step].append(self._shares(target, steady, delay_ms, steady_s))
            return min(map(min, found[step])) >= COMPLETE

        def once(step: int) -> bool:
            return complete(step, times=1, steady_s=STEADY_S, done=step * step_ms / 1000.0)

        first = _first_agreeing(once, 0)
        steady_s = steady_after_s(first * step_ms)

        def often(step: int) -> bool:
            done = 0.4 + 0.6 * (step - first) / AGREEING
            return complete(step, times=repetitions, steady_s=steady_s, done=done)

        _first_agreeing(often, first)
        return _settling_of(found, step_ms)

    def _shares(
        self, target: int, steady: Mapping[int, list[Gray]], delay_ms: float, steady_s: float
    ) -> list[float]:
        start = 255 - target
        pictures = self._changed(start, steady_s, target, delay_ms / 1000.0)
        return [
            share_of_change(gray, before, after, lit(dark, bright))
            for gray, before, after, dark, bright in zip(
                pictures, steady[start], steady[target], steady[0], steady[255], strict=True
            )
        ]


def _first_agreeing(complete: Callable[[int], bool], start: int) -> int:
    """Try step after step until several in a row are complete, and return the first of these."""
    step, agreeing = start, 0
    while agreeing < AGREEING:
        agreeing = agreeing + 1 if complete(step) else 0
        step += 1
    return step - AGREEING


def _settling_of(found: Mapping[int, list[list[float]]], step_ms: float) -> Settling:
    """Write what was found, steps that were tried less often filled up with what they gave."""
    most = max(map(len, found.values()))
    cameras = len(found[0][0])
    shares = [np.resize(np.array(found[step]), (most, cameras)) for step in range(len(found))]
    return Settling(np.arange(len(found)) * step_ms, np.stack(shares, axis=-1))
