"""Choose the exposures of the fringes: planned for the measured brightness, or by the paper's rule."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from backend.domain.checks import Check, at_least
from backend.domain.errors import StageFailedError
from backend.domain.hints import Curve, Table, Value
from backend.domain.params import Params, setting
from backend.domain.rig import RigFacts
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.fringe_orders import maximum_likelihood
from backend.numerics.planning import (
    ExposureRange,
    FringeCoding,
    FusionKind,
    Prediction,
    RateHistogram,
    ServiceLimits,
    paper_exposures,
    plan_exposures,
    predict,
    rate_histogram,
    single_exposures,
)
from backend.stages.camera_noise import noise_model
from backend.stages.fringe_design import Aid, Directions, FringeDesign
from backend.stages.pre_exposure import Preview
from backend.stages.zones import Zones

Strategy = Literal["planned", "hdrsia", "single_low", "single_high"]
Budget = Literal["fast", "balanced", "thorough"]

BUDGET_S: dict[Budget, float] = {"fast": 6.0, "balanced": 20.0, "thorough": 60.0}
"""Light time of all fringes that each budget allows."""

WORTHWHILE_GAIN = 0.1
"""One exposure more is planned as long as it lowers the plan's cost (unmeasured pixels and noise) by this share."""


class ExposuresParams(Params):
    """Which exposures and which fringes."""

    strategy: Strategy = setting("planned", title="Strategy")
    """planned: least phase noise within the time budget; hdrsia: one exposure per zone (the paper's rule);
    single_low, single_high: one exposure, as one would set it by hand."""
    exposures_ms: tuple[float, ...] | None = setting(
        None, title="Exposures", unit="ms", auto="exposures_ms", min_length=1, max_length=8
    )
    """Automatic: chosen by the strategy."""
    budget: Budget = setting("balanced", title="Time budget")
    """fast 6 s, balanced 20 s, thorough 60 s of light for all fringes."""
    budget_s: float | None = setting(
        None, title="Time budget in seconds", unit="s", auto="budget_used_s", gt=0, le=3600
    )
    """Overrides the time budget's name."""
    most: int = setting(5, title="At most", unit="exposures", ge=1, le=8)
    """Largest number of exposures that the plan may use."""
    least: int = setting(1, title="At least", unit="exposures", ge=1, le=8, advanced=True)
    optimum_gray: float = setting(
        254.0, title="Optimum gray", unit="gray", gt=0, le=255, advanced=True
    )
    """I_opt of the paper's rule, on the 8-bit scale."""
    snap: bool = setting(True, title="Whole projector frames", advanced=True)
    """Use multiples of the projector's frame period, so that its modulation averages out."""
    periods: tuple[float, ...] = setting(
        (59.0, 64.0, 70.0), title="Frequencies", unit="periods", min_length=1, max_length=8
    )
    """Periods of the fringes over the projector."""
    steps: int = setting(4, title="Steps", ge=3, le=32)
    """Phase steps per frequency."""
    low_gray: float = setting(40.0, title="Darkest code", unit="gray", ge=0, le=254, advanced=True)
    high_gray: float = setting(
        220.0, title="Brightest code", unit="gray", ge=1, le=255, advanced=True
    )
    directions: Directions = setting("x", title="Directions", advanced=True)
    """x codes the projector's columns, y its rows. Two cameras need one only."""
    aid: Aid = setting("none", title="Gray code aid", advanced=True)
    """Also project Gray code of the fringe orders: for parts that break the frequencies' unwrapping."""


@dataclass(frozen=True)
class ExposureRow:
    """One exposure in the table."""

    exposure_ms: float
    served_share: float
    """Share of the lit pixels for which it is the longest unsaturated one."""
    wanted_ms: float
    """Before rounding to the projector's frames and clipping to the camera's range."""


@dataclass(frozen=True)
class Exposures:
    """The chosen exposures, and what they are predicted to give."""

    exposures_ms: tuple[float, ...]
    """Increasing."""
    table: Annotated[tuple[ExposureRow, ...], Table("Exposures", edits="exposures_ms")]
    covered_share: Annotated[float, Value("Predicted coverage")]
    """Share of the lit pixels whose phase will be usable."""
    saturated_share: Annotated[float, Value("Predicted saturation")]
    phase_sigma_rad: Annotated[float, Value("Predicted phase noise, median", unit="rad")]
    time_s: Annotated[float, Value("Exposure time in all", unit="s")]
    budget_used_s: float
    brightness_gray_per_ms: Float[np.ndarray, "bin"]
    predicted_sigma_rad: Annotated[
        Float[np.ndarray, "bin"],
        Curve(
            "Predicted phase noise",
            x="brightness_gray_per_ms",
            x_title="gray/ms",
            unit="rad",
            log_y=True,
        ),
    ]
    """NaN where no exposure serves."""
    clipped: bool
    """True if the camera's range or the projector's frames changed a wanted exposure notably."""
    design: FringeDesign


def _covered(result: Exposures, params: ExposuresParams) -> Check:
    return at_least(
        "coverage", result.covered_share, warning=0.95, failure=0.02,
        sentence=f"{result.covered_share:.1%} of the lit pixels are predicted to be measurable",
        remedy="open the aperture, allow more time, or raise the camera's gain",
    )  # fmt: skip


def _in_range(result: Exposures, params: ExposuresParams) -> Check:
    if not result.clipped:
        return Check("range", Level.OK, "All exposures are within the camera's range")
    return Check("range", Level.WARNING, "The camera's range does not allow all wanted exposures")


@stage(title="Exposures", version=1, review=Review.ALWAYS, checks=(_covered, _in_range))
def exposures(
    preview: Preview, zones: Zones, facts: RigFacts, params: ExposuresParams
) -> Exposures:
    """Choose exposures that measure bright and dark parts alike, and predict coverage and noise."""
    design = _design(params)
    planner = _Planner(preview, facts, params, design)
    wanted_ms, clipped = planner.choose(zones)
    prediction = planner.predict(wanted_ms)
    shares = [
        float(planner.light.pixels[prediction.served_by == i].sum() / planner.light.pixels.sum())
        for i in range(len(prediction.exposures_ms))
    ]
    return Exposures(
        exposures_ms=tuple(float(t) for t in prediction.exposures_ms),
        table=tuple(
            ExposureRow(float(t), share, float(w))
            for t, share, w in zip(prediction.exposures_ms, shares, np.sort(wanted_ms), strict=True)
        ),
        covered_share=prediction.coverage,
        saturated_share=prediction.saturated,
        phase_sigma_rad=prediction.phase_sigma_median_rad,
        time_s=prediction.time_s,
        budget_used_s=planner.budget_s,
        brightness_gray_per_ms=planner.light.rates_gray_per_ms,
        predicted_sigma_rad=prediction.phase_sigma_rad,
        clipped=clipped,
        design=design,
    )


def _design(params: ExposuresParams) -> FringeDesign:
    if params.low_gray >= params.high_gray:
        raise StageFailedError(
            f"The fringes' darkest code {params.low_gray:g} isn't below the brightest {params.high_gray:g}: lower it."
        )
    _check_unwrapping(params)
    return FringeDesign(
        periods=params.periods,
        steps=params.steps,
        low_gray=params.low_gray,
        high_gray=params.high_gray,
        directions=params.directions,
        aid=params.aid,
    )


def _check_unwrapping(params: ExposuresParams) -> None:
    """Refuse frequencies that can't be told apart before anything is captured with them."""
    if params.aid == "none" and min(params.periods) > 1.0:
        maximum_likelihood(params.periods)


class _Planner:
    """The rig and the scene in the words of numerics.planning."""

    def __init__(
        self, preview: Preview, facts: RigFacts, params: ExposuresParams, design: FringeDesign
    ) -> None:
        if facts.projector is None:
            raise StageFailedError("The rig has no projector: fringes need one.")
        self.preview, self.params = preview, params
        period = facts.projector.frame_period_ms if params.snap else None
        cameras = facts.cameras.values()
        camera = facts.cameras[facts.reference]
        self.noise = noise_model(camera)
        self.limits = ServiceLimits(full_scale_gray=camera.full_scale_gray)
        self.grid = ExposureRange(
            min_ms=max(c.exposure_min_ms for c in cameras),
            max_ms=min(c.exposure_max_ms for c in cameras),
            period_ms=period,
        )
        self.coding = FringeCoding(
            steps=design.steps,
            low_share=(design.low_gray / 255) ** facts.projector.gamma,
            high_share=(design.high_gray / 255) ** facts.projector.gamma,
            frames=design.count(facts.projector),
        )
        self.light = light_of(preview)
        self.budget_s = params.budget_s or BUDGET_S[params.budget]
        self.fusion: FusionKind = "weighted"

    def choose(self, zones: Zones) -> tuple[Float[np.ndarray, "exposure"], bool]:
        """Return the wanted exposures in [ms] and whether the rig clips one of them."""
        if self.params.exposures_ms is not None:
            wanted = np.array(sorted(set(self.params.exposures_ms)))
            return wanted, self._outside(wanted)
        if self.params.strategy == "hdrsia":
            scale = (self.preview.full_scale_gray + 1) / 256
            paper = paper_exposures(
                self.preview.t_pre_ms,
                zones.peaks_gray,
                self.grid,
                optimum_gray=self.params.optimum_gray * scale,
                black_gray=self.noise.black_gray,
            )
            return np.unique(paper.exposures_ms), bool(paper.clipped.any())
        if self.params.strategy == "planned":
            return self._planned().exposures_ms, False
        low, high = single_exposures(
            self.light, self.noise, self.grid, coding=self.coding, limits=self.limits
        )
        return np.array([low if self.params.strategy == "single_low" else high]), False

    def predict(self, exposures_ms: Float[np.ndarray, "exposure"]) -> Prediction:
        """Predict what exposures will give."""
        return predict(
            self.light,
            np.clip(exposures_ms, self.grid.min_ms, self.grid.max_ms),
            self.noise,
            coding=self.coding,
            limits=self.limits,
            fusion=self.fusion,
        )

    def _planned(self) -> Prediction:
        if self.params.least > self.params.most:
            raise StageFailedError(
                f"At least {self.params.least} exposures but at most {self.params.most}: swap them."
            )
        return plan_exposures(
            self.light,
            self.noise,
            self.grid,
            budget_s=self.budget_s,
            count_range=(self.params.least, self.params.most),
            coding=self.coding,
            limits=self.limits,
            fusion=self.fusion,
            gain_min=WORTHWHILE_GAIN,
        ).chosen

    def _outside(self, wanted_ms: Float[np.ndarray, "exposure"]) -> bool:
        return bool((wanted_ms < self.grid.min_ms).any() or (wanted_ms > self.grid.max_ms).any())


def light_of(preview: Preview) -> RateHistogram:
    """Pool the brightness of all lit pixels of all cameras."""
    lit = [
        np.where(preview.foreground[name], rate, np.float32(np.nan))
        for name, rate in preview.rate_gray_per_ms.items()
    ]
    return rate_histogram(lit)
