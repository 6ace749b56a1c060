"""A projector's latency by cameras that run freely: by the first frame that saw the whole change.

Nothing says when such a camera exposes. A frame that was complete here at the time a began to be exposed before a - E,
E its exposure: readout and transport, which nobody knows, only move that further back. So where a frame shows the whole
change, the change was over by a - E. The bound holds whatever the camera does; it is too late by at most the distance of
two frames and what readout and transport take.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from backend.devices.protocols import TriggerSource
from backend.domain.shots import Progress
from backend.numerics.settling import COMPLETE, Settling, share_of_change
from backend.services.latency_bench import (
    AGREEING,
    STEADY_S,
    Bench,
    Gray,
    Taking,
    lit,
    refuse_endless,
    steady_after_s,
    words_of,
)

_MOST_FRAMES = 1000
"""Of one change: a camera whose frames come as fast as they are asked for (a file) doesn't let time go on."""


@dataclass(frozen=True)
class _Seen:
    """One frame of a change."""

    over_by_ms: float
    """If it is complete, the change was over so long after the acknowledgement, or earlier."""
    share: float


class FreeRunBench(Bench):
    """Each camera by itself: while one is listened to, frames of the others would grow old."""

    trigger = TriggerSource.FREE_RUN
    _frame_period_ms = 0.0

    def resolution_ms(self) -> float:
        """Return the distance of two frames, and of two delays that are told apart."""
        return self._frame_period_ms + self.period_ms / 2

    def steady(self, level: int) -> list[Gray]:
        """Return what each camera sees of a level that has come to rest; learns how fast frames come."""
        self.blank(level)
        self.clock.sleep(STEADY_S)
        watched = [partial(self._watched, camera, STEADY_S) for camera in self.cameras]
        return [self.persistently(watch) for watch in watched]

    def settling(
        self,
        target: int,
        steady: Mapping[int, list[Gray]],
        repetitions: int,
        progress: Progress,
    ) -> Settling:
        """Change to a level again and again, and watch one camera after the other."""
        changes: list[list[Sequence[_Seen]]] = []
        rounds = len(self.cameras) * repetitions
        for camera, dark, bright in zip(self.cameras, steady[0], steady[255], strict=True):
            judge = _Judge(target, dark, bright)
            seen: list[Sequence[_Seen]] = []
            for turn in range(repetitions):
                done = (len(changes) * repetitions + turn) / rounds / 2
                progress(
                    done + (0.0 if target else 0.5), f"{words_of(target)}, seen by {camera.name}"
                )
                steady_s = steady_after_s(_over_ms(seen[0])) if seen else STEADY_S
                seen.append(self._change(camera, judge, steady_s, turn / repetitions))
            changes.append(seen)
        return _settling_of(changes, self.period_ms / 2)

    def _change(
        self, camera: Taking, judge: "_Judge", steady_s: float, phase: float
    ) -> Sequence[_Seen]:
        """Change once, and watch until it is over; `phase` says where between two frames to begin."""

        def change() -> Sequence[_Seen]:
            self.blank(255 - judge.target)
            self._watched(camera, steady_s)
            # A frame has just come: without this every change would begin at the same place between two of them.
            self.clock.sleep(phase * self._frame_period_ms / 1000.0)
            self.blank(judge.target)
            return self._watched_change(camera, judge)

        return self.persistently(change)

    def _watched(self, camera: Taking, duration_s: float) -> Gray:
        """Fetch frames for a while, so that none grows old, and return the last."""
        began_s = self.clock.now_s()
        waiting = camera.capabilities.buffered_frames + 1
        arrived: list[float] = []
        while True:
            picture = self.picture(camera)
            arrived.append(self.clock.now_s())
            long_enough = arrived[-1] - began_s >= duration_s and len(arrived) > waiting + 2
            if long_enough or len(arrived) >= _MOST_FRAMES:
                break
        spacing_ms = 1000.0 * float(np.median(np.diff(arrived[waiting:])))
        self._frame_period_ms = max(self._frame_period_ms, spacing_ms)
        return picture

    def _watched_change(self, camera: Taking, judge: "_Judge") -> Sequence[_Seen]:
        acknowledged_s = self.clock.now_s()
        exposure_ms = camera.settings.exposure_us / 1000.0
        if self._frame_period_ms:
            exposure_ms = min(
                exposure_ms, self._frame_period_ms
            )  # what a rig file says may be wrong
        seen: list[_Seen] = []
        while sum(one.share >= COMPLETE for one in seen[-AGREEING:]) < AGREEING:
            share = judge.share(self.picture(camera))
            since_ms = 1000.0 * (self.clock.now_s() - acknowledged_s)
            seen.append(_Seen(since_ms - exposure_ms, share))
            refuse_endless(since_ms if len(seen) < _MOST_FRAMES else np.inf, judge.target)
        return seen


@dataclass(frozen=True)
class _Judge:
    """Says of one camera's pictures how far a change has come."""

    target: int
    dark: Gray
    bright: Gray

    def share(self, picture: Gray) -> float:
        before, after = (self.dark, self.bright) if self.target else (self.bright, self.dark)
        return share_of_change(picture, before, after, lit(self.dark, self.bright))


def _over_ms(seen: Sequence[_Seen]) -> float:
    """Return by when a change was over: the last frames are complete."""
    return max(0.0, seen[-AGREEING].over_by_ms)


def _settling_of(changes: Sequence[Sequence[Sequence[_Seen]]], step_ms: float) -> Settling:
    """Write changes, first by camera, then by repetition, over delays as they are tried by triggered cameras."""
    longest_ms = max(_over_ms(seen) for camera in changes for seen in camera)
    delays_ms = np.arange(int(np.ceil(longest_ms / step_ms)) + AGREEING) * step_ms
    shares = [[_at(delays_ms, seen) for seen in camera] for camera in changes]
    return Settling(delays_ms, np.swapaxes(np.array(shares), 0, 1))


def _at(delays_ms: Float[np.ndarray, "delay"], seen: Sequence[_Seen]) -> Float[np.ndarray, "delay"]:
    """Return what the last frame showed that was exposed by each delay for sure; nothing where there was none."""
    exposed_ms = np.array([one.over_by_ms for one in seen])
    last = np.searchsorted(exposed_ms, delays_ms, side="right") - 1
    shown = np.array([one.share for one in seen])
    return np.where(last >= 0, shown[np.maximum(last, 0)], 0.0)
