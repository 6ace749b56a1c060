"""The simulated projector: patterns, light, and the trigger line to the cameras."""

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import UInt8

from backend.devices.errors import FeatureError
from backend.devices.protocols import DeviceInfo, Presented, ProjectorCapabilities
from backend.devices.sim.clock import Clock
from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.display import Display
from backend.devices.sim.renderer import Shown

TriggerLine = Callable[[Shown, float, float], None]
"""Called at each edge with what is shown, the time in [s] and how long it is shown in [us]."""

_MAX_SEQUENCE = 512


class SimulatedProjector(Display):
    """A `SequenceProjector`. What it shows at the moment is `shown`; cameras read it when they are triggered."""

    def __init__(self, config: SimulatedRigConfig, clock: Clock) -> None:
        super().__init__(
            "projector",
            DeviceInfo("unglare", "simulated DLP", serial="SIM-P", simulated=True),
            config.projector_size,
        )
        self._config = config
        self._clock = clock
        self._period_s = (config.frame_period_ms or 0.0) / 1000.0
        self._shows = 0
        self._failed = False
        self._stop = threading.Event()
        self._sequence: tuple[list[int], float, float] | None = None
        self.trigger_lines: list[TriggerLine] = []
        self.shown = Shown(self._uniform(0), 0)

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        period = self._config.frame_period_ms
        return ProjectorCapabilities(
            size=self._config.projector_size,
            refresh_hz=None if period is None else 1000.0 / period,
            sequence=True,
            max_sequence=_MAX_SEQUENCE,
            linear=self._config.gamma == 1.0,
            trigger_out=True,
            certain=True,
        )

    def arm_sequence(self, indices: Sequence[int], exposure_us: float, period_us: float) -> None:
        """Prepare a run."""
        self._need_link()
        missing = [index for index in indices if not 0 <= index < len(self._patterns)]
        if missing:
            raise FeatureError(self.name, f"there is no pattern {missing[0]}; load it first")
        if len(indices) > _MAX_SEQUENCE:
            raise FeatureError(
                self.name,
                f"{len(indices)} patterns exceed the {_MAX_SEQUENCE} of one sequence; split it",
            )
        if not 0 < exposure_us <= period_us:
            raise FeatureError(
                self.name,
                f"an exposure of {exposure_us:g} us doesn't fit a period of {period_us:g} us; lengthen it",
            )
        self._sequence = (list(indices), exposure_us, period_us)
        self._stop.clear()

    def start_sequence(self) -> None:
        """Run the sequence to its end, firing the trigger line once per pattern."""
        self._need_link()
        if self._sequence is None:
            raise FeatureError(self.name, "no sequence is prepared; call arm_sequence first")
        indices, exposure_us, period_us = self._sequence
        self._sequence = None
        start_s = self._clock.now_s()
        for count, index in enumerate(indices):
            if self._stop.is_set():
                return
            self._present(self._patterns[index], index, settle=False)
            at_s = start_s + count * period_us * 1e-6
            for fire in self.trigger_lines:
                fire(self.shown, at_s, exposure_us)
            self._clock.wait_until(at_s + period_us * 1e-6, self._stop)

    def stop_sequence(self) -> None:
        """Stop a running sequence."""
        self._stop.set()

    # what a controller of its own drives (see `backend.devices.peers.dlpc350`)

    def now_s(self) -> float:
        """Return the rig's time."""
        return self._clock.now_s()

    def light(self, picture: UInt8[np.ndarray, "h w"]) -> None:
        """Show a picture at once, whatever is loaded."""
        self.shown = Shown(self._frozen(picture), self.shown.number + 1)

    def edge(self, time_s: float, shown_us: float) -> None:
        """Fire the trigger line for what is shown since a time, for so long."""
        for fire in self.trigger_lines:
            fire(self.shown, time_s, shown_us)

    def _present(
        self, pattern: UInt8[np.ndarray, "h w"], index: int, *, settle: bool = True
    ) -> Presented:
        limit = self._config.projector_fail_after_shows
        if limit is not None and self._shows >= limit and not self._failed:
            self._failed = True
            raise self._lose_cable(
                f"no answer after {self._shows} patterns", for_good=self._config.fail_for_good
            )
        self._shows += 1
        self.shown = Shown(pattern, self.shown.number + 1)
        if settle:  # a pattern is whole from the next frame period on
            self._clock.wait_until(self._clock.now_s() + self._period_s, self._stop)
        return Presented(index, time.monotonic(), self._clock.now_s(), confirmed=True)
