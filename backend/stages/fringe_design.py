"""Which fringes are projected: frequencies, steps, gray range, directions, and the Gray code that may aid them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from backend.domain.patterns import Axis, Pattern, Sine, gray_code
from backend.domain.rig import ProjectorFacts

Aid = Literal["none", "gray", "complementary_gray"]
Directions = Literal["x", "y", "xy"]


@dataclass(frozen=True)
class FringeDesign:
    """The patterns of one exposure."""

    periods: tuple[float, ...]
    """Periods over the projector's width (or height, for rows)."""
    steps: int
    low_gray: float
    high_gray: float
    directions: Directions
    aid: Aid

    def patterns(self, projector: ProjectorFacts) -> tuple[Pattern, ...]:
        """List the patterns of one exposure, in the order in which they are projected."""
        return tuple(p for axis in self.axes for p in self._axis_patterns(axis, projector))

    def count(self, projector: ProjectorFacts) -> int:
        """Count the patterns of one exposure."""
        return len(self.patterns(projector))

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Directions along which the projector is coded."""
        return {"x": ("x",), "y": ("y",), "xy": ("x", "y")}[self.directions]  # type: ignore[return-value]  # a dict of literals loses them

    def _axis_patterns(self, axis: Axis, projector: ProjectorFacts) -> list[Pattern]:
        width = projector.width_px if axis == "x" else projector.height_px
        return [*self._sines(axis), *self._gray(axis, width)]

    def _sines(self, axis: Axis) -> list[Pattern]:
        shifts = 2 * np.pi * np.arange(self.steps) / self.steps
        return [
            Sine(
                axis=axis,
                periods=p,
                shift_rad=float(shift),
                low_gray=self.low_gray,
                high_gray=self.high_gray,
            )
            for p in self.periods
            for shift in shifts
        ]

    def _gray(self, axis: Axis, width_px: int) -> list[Pattern]:
        """Gray code of the orders of the finest fringe; one bit more makes it complementary."""
        if self.aid == "none":
            return []
        codes = int(np.ceil(max(self.periods))) * (2 if self.aid == "complementary_gray" else 1)
        return list(gray_code(axis, codes))
