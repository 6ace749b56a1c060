"""A screen and a camera as one chain, in a few lines: every pixel sees the screen's light, some a little less."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np

from backend.devices.sim.chains import FULL_WELL_E, READ_NOISE_E, Chain
from backend.domain.frames import Frame, InMemory
from backend.domain.rig import CameraFacts, ProjectorFacts, RigFacts
from backend.domain.shots import Exposed, OneOf, Plan, Shot, Until
from backend.jobs.rendering import render

T = TypeVar("T")


class ChainRig:
    """Drives plans: a mirror that shows the screen pixel by pixel, and a dark frame of 8 px around it."""

    def __init__(self, chain: Chain, *, seed: int, nominal_ms: float = 20.0, bits: int = 8) -> None:
        self._chain, self._nominal_ms, self._bits = chain, nominal_ms, bits
        self._rng = np.random.default_rng(seed)
        self.screen = ProjectorFacts(width_px=96, height_px=48)
        self.shots: list[Shot] = []

    @property
    def facts(self) -> RigFacts:
        height, width = self.screen.height_px + 16, self.screen.width_px + 16
        camera = CameraFacts(width, height, self._bits, 0.1, 2000.0, 0.0, FULL_WELL_E, READ_NOISE_E)
        return RigFacts({"camera": camera}, "camera", self.screen)

    def __call__(self, plan: Plan[T]) -> T:
        try:
            wanted = next(plan)
            while True:
                assert not isinstance(wanted, Until)
                burst = wanted.burst if isinstance(wanted, OneOf) else wanted
                wanted = plan.send(tuple(self.expose(shot) for shot in burst))
        except StopIteration as end:
            result: T = end.value
            return result

    def expose(self, shot: Shot) -> Exposed:
        self.shots.append(shot)
        codes = render(shot.pattern, width_px=self.screen.width_px, height_px=self.screen.height_px)
        light = np.pad(self._chain.luminance(codes), 8)
        gray = self._chain.gray(
            light, shot.exposure_ms / self._nominal_ms, self._rng, bits=self._bits
        )
        frame = Frame("camera", shot.pattern, shot.exposure_ms, InMemory(gray), self._bits)
        found: Mapping[str, Frame] = {"camera": frame}
        return found
