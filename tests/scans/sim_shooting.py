"""Capturing stages on a simulated rig, without database and jobs: frames in memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from backend.devices.sim import create_rig
from backend.domain.frames import Frame, InMemory
from backend.domain.shots import Burst, Exposed, OneOf, Plan, Until
from backend.jobs.control import JobControl
from backend.jobs.rendering import render
from backend.jobs.shooting import Shooter


@dataclass
class SimShoot:
    """A `Shoot` for stages that are called as functions."""

    rig: Any
    shooter: Shooter

    def __call__(self, plan: Plan[Any]) -> Any:
        """Drive a plan to its end."""
        try:
            burst = next(plan)
            while True:
                assert not isinstance(burst, Until)
                shots = burst.burst if isinstance(burst, OneOf) else burst
                burst = plan.send(self._burst(shots))
        except StopIteration as end:
            return end.value

    def _burst(self, burst: Burst) -> tuple[Exposed, ...]:
        width, height = self.shooter.projector_size
        gamma = self.rig.facts().projector.gamma
        found = []
        for shot in burst:
            mask = None if shot.mask is None else shot.mask.load()
            picture = render(shot.pattern, width_px=width, height_px=height, gamma=gamma, mask=mask)
            self.shooter.load([picture])
            names = shot.cameras or tuple(self.rig.cameras)
            taken = self.shooter.take(
                0, exposure_ms=shot.exposure_ms, gain_db=shot.gain_db, cameras=names
            )
            found.append(
                {
                    name: Frame(
                        name, shot.pattern, shot.exposure_ms, InMemory(frame.data), frame.bits,
                        shot.gain_db, shot.role,
                    )
                    for name, frame in taken.items()
                }
            )  # fmt: skip
        return tuple(found)


@contextmanager
def sim_shoot(**options: object) -> Iterator[SimShoot]:
    """Open a simulated rig and what captures with it."""
    with create_rig(options) as rig, Shooter(rig, JobControl()) as shooter:
        yield SimShoot(rig, shooter)
