"""What one way to measure a scene reached, beside others: figures per part, pictures."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from backend.numerics.scoring import Score, Scores
from backend.services.contact_sheet import Panel
from backend.services.variants import Variant

WHOLE = "all"
"""Name of the whole scene among its parts."""

FIGURES = (
    "completeness",
    "outlier_share",
    "over_exposed_share",
    "mean_mm",
    "std_mm",
    "rms_mm",
)
"""Figures of a part that comparisons show."""


@dataclass(frozen=True)
class Measured:
    """What one variant reached."""

    variant: Variant
    error: str | None = None
    """Why it reached nothing."""
    exposure_ms: float | None = None
    refinements: int | None = None
    scores: Scores | None = None
    widening_px: Mapping[str, float] | None = None
    """By how much white stripes are wider than black ones, median per part, in projector pixels."""
    light_s: float | None = None
    """Exposure time of the fringes or the code."""
    all_light_s: float | None = None
    """Of every picture, what was captured before included."""
    panels: tuple[Panel, ...] = ()

    @property
    def all_parts(self) -> dict[str, Score]:
        """The whole scene, then its parts."""
        return {} if self.scores is None else {WHOLE: self.scores.total, **self.scores.parts}

    def good_points(self, part: str) -> int | None:
        """Count the points of a part that are no outliers; None if nobody knows."""
        found = self.all_parts.get(part)
        if found is None:
            return None
        share = found.outlier_share if math.isfinite(found.outlier_share) else 0.0
        return round(found.accepted * (1.0 - share))

    def figures(self, part: str) -> dict[str, Any]:
        """Return the figures of a part as JSON values; what can't be said is None."""
        found = self.all_parts.get(part)
        return {name: known(getattr(found, name)) if found else None for name in FIGURES}

    @property
    def headline(self) -> str:
        """Say the variant and what is complete of each part in one line."""
        if self.scores is None:
            return f"{self.variant.title}: {self.error or 'no points'}"
        parts = ", ".join(f"{n} {s.completeness:.1%}" for n, s in self.scores.parts.items())
        return f"{self.variant.title}: {parts} complete"


def known(value: float | None) -> float | None:
    """Return a figure as JSON can hold it; None for what isn't a number."""
    return None if value is None or not math.isfinite(value) else round(value, 6)


def ratio(points: int | None, of: int | None) -> float | None:
    """Return the share that points are of others; None where it can't be said."""
    return None if points is None or not of else round(points / of, 6)
