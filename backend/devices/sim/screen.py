"""The simulated screen: an LCD that shows a pattern from the next refresh on, and follows it with delay."""

import math
import threading
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from backend.devices.protocols import DeviceInfo, Presented, ProjectorCapabilities
from backend.devices.sim.clock import Clock
from backend.devices.sim.display import Display
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.devices.sim.renderer import Shown

_SETTLED = 12.0
"""Time constants after which nothing is left of the pattern before: a millionth."""


@dataclass(frozen=True)
class Lit(Shown):
    """What the screen shows, and what it showed before."""

    before: UInt8[np.ndarray, "h w"]
    since_s: float
    """When the panel began to follow."""


def share_of_before(since_s: float, response_s: float, start_s: float, exposure_s: float) -> float:
    r"""Return which share of an exposure still saw the pattern before.

    Notes
    -----
    The panel's luminance follows as :math:`L = L_1 + (L_0 - L_1) e^{-(t - t_1)/\\tau}` from :math:`t_1` on; this
    is the mean of the exponential, 1 before :math:`t_1`, over the exposure.

    Examples
    --------
    >>> share_of_before(10.0, 0.0, 9.5, 1.0)
    0.5
    """
    early = min(max(since_s - start_s, 0.0), exposure_s)
    begin = max(start_s - since_s, 0.0)
    left = exposure_s - early
    if response_s <= 0 or left <= 0:
        return early / exposure_s
    tail = math.exp(-begin / response_s) * -math.expm1(-left / response_s)
    return (early + response_s * tail) / exposure_s


class SimulatedScreen(Display):
    """A `Projector`. What it shows at the moment is `shown`; the camera reads it when it is triggered."""

    def __init__(self, config: SimulatedLcdConfig, clock: Clock) -> None:
        info = DeviceInfo("unglare", "simulated LCD", serial="SIM-S", simulated=True)
        super().__init__("screen", info, config.screen_size)
        self._clock = clock
        self._period_s = 1e-3 * config.refresh_period_ms
        settle_ms = _SETTLED * config.response_ms if config.settle_ms is None else config.settle_ms
        self._settle_s = 1e-3 * settle_ms
        self._fail_after = config.projector_fail_after_shows
        self._fail_for_good = config.fail_for_good
        self._shows = 0
        self._never = threading.Event()
        dark = self._uniform(0)
        self.shown = Lit(dark, 0, dark, 0.0)

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return ProjectorCapabilities(size=self._size, refresh_hz=1.0 / self._period_s, certain=True)

    def _present(self, pattern: UInt8[np.ndarray, "h w"], index: int) -> Presented:
        if self._fail_after is not None and self._shows >= self._fail_after:
            after, self._fail_after = self._fail_after, None
            raise self._lose_cable(
                f"no answer after {after} patterns", for_good=self._fail_for_good
            )
        self._shows += 1
        since_s = math.ceil(self._clock.now_s() / self._period_s) * self._period_s
        self.shown = Lit(pattern, self.shown.number + 1, self.shown.pattern, since_s)
        if self._settle_s > 0:
            self._clock.wait_until(since_s + self._settle_s, self._never)
        return Presented(index, time.monotonic(), self._clock.now_s(), confirmed=True)
