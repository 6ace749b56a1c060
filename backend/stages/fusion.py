"""Fuse the exposures: per pixel one phasor for each frequency, from every picture that isn't saturated."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float32, Int16, UInt8, UInt16

from backend.domain.checks import Check, at_most
from backend.domain.errors import StageFailedError
from backend.domain.hints import Mask, Picture, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import Axis
from backend.domain.rig import RigFacts
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics import phasors as numerics
from backend.numerics.phasors import NO_EXPOSURE
from backend.numerics.reasons import Reason
from backend.numerics.sine_code import SineCode
from backend.stages.camera_noise import noise_model
from backend.stages.cloud import REASON_LABELS
from backend.stages.fringe_capture import FringeFrames
from backend.stages.fringe_sets import FringeSet, fringe_sets
from backend.stages.gray_orders import GrayPosition, gray_position
from backend.stages.pre_exposure import Preview
from backend.stages.zones import Zones, zone_of_pixels

Strategy = Literal["weighted", "longest_unsaturated", "masks"]


class FusionParams(Params):
    """How the exposures of a pixel become one."""

    strategy: Strategy = setting("weighted", title="Fusion")
    """weighted: all unsaturated exposures by their noise; longest_unsaturated: one exposure per pixel;
    masks: the zones decide (the paper's rule)."""
    saturation_gray: float | None = setting(
        None, title="Saturated from", unit="gray", ge=1, le=65535, advanced=True
    )
    """Automatic: full scale - 1."""
    steps: int | None = setting(None, title="Steps used", ge=3, le=32, advanced=True)
    """Use only so many of the captured steps, evenly spread; automatic: all of them."""
    first_step: int = setting(0, title="First step used", ge=0, le=31, advanced=True)
    """Which of the possible subsets of steps is used."""


@dataclass(frozen=True)
class AxisPhasors:
    """One camera's phasors along one direction."""

    camera: str
    axis: Axis
    periods: tuple[float, ...]
    shifts_rad: tuple[tuple[float, ...], ...]
    in_phase: Int16[np.ndarray, "k h w"]
    quadrature: Int16[np.ndarray, "k h w"]
    light_gray_per_ms: Float32[np.ndarray, "h w"]
    sigma_gray: Float32[np.ndarray, "h w"]
    exposure_index: UInt8[np.ndarray, "h w"]
    reasons: UInt16[np.ndarray, "h w"]
    step_gray: float
    exposures_ms: tuple[float, ...]
    black_gray: float
    gray: GrayPosition | None
    """Coarse position from a Gray code, if one was projected."""

    @property
    def phasors(self) -> numerics.Phasors:
        """The maps as numerics takes them."""
        return numerics.Phasors(
            self.in_phase,
            self.quadrature,
            self.light_gray_per_ms,
            self.sigma_gray,
            self.exposure_index,
            self.reasons,
            step_gray=self.step_gray,
            exposures_ms=self.exposures_ms,
        )

    @property
    def code(self) -> SineCode:
        """Frequencies and steps."""
        return SineCode(self.periods, self.shifts_rad)


@dataclass(frozen=True)
class Phasors:
    """What all exposures together say of every pixel."""

    sets: tuple[AxisPhasors, ...]
    exposures_ms: tuple[float, ...]
    exposure_names: tuple[str, ...]
    exposure_map: Annotated[
        Mapping[str, UInt8[np.ndarray, "_h _w"]], Mask("Exposure used", names="exposure_names")
    ]
    """1 = shortest exposure ..., 0 = none serves the pixel."""
    fused: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Fused picture", unit="gray/ms", colormap="gray"),
    ]
    reasons: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]], Mask("Missing because", REASON_LABELS, bits=True)
    ]
    served_share: Annotated[float, Value("Pixels served")]
    saturated_share: Annotated[float, Value("Saturated at every exposure")]


def _not_saturated(result: Phasors, params: FusionParams) -> Check:
    return at_most(
        "saturation", result.saturated_share, warning=0.01, failure=0.9,
        sentence=f"{result.saturated_share:.2%} of the pixels are saturated at every exposure",
    )  # fmt: skip


@stage(title="Fusion", version=2, review=Review.ON_WARNING, checks=(_not_saturated,))
def fusion(
    frames: FringeFrames,
    preview: Preview | None,
    zones: Zones | None,
    facts: RigFacts,
    params: FusionParams,
    progress: Progress,
) -> Phasors:
    """Combine all exposures of each pixel, leaving out the saturated ones."""
    sets = fringe_sets(frames.frames)
    if params.steps is not None:
        sets = tuple(s.subset(params.steps, params.first_step) for s in sets)
    fused = []
    for number, fringes in enumerate(sets):
        progress(number / len(sets), f"camera {fringes.camera}, {fringes.axis}")
        fused.append(_fuse(fringes, preview, zones, facts, params))
    return _summarise(tuple(fused), sets[0].exposures_ms)


def _fuse(
    fringes: FringeSet,
    preview: Preview | None,
    zones: Zones | None,
    facts: RigFacts,
    params: FusionParams,
) -> AxisPhasors:
    noise = noise_model(facts.cameras[fringes.camera], gain_db=fringes.gain_db)
    code = SineCode(fringes.periods, fringes.shifts_rad)
    full_scale_gray = 2.0**fringes.bit_depth - 1
    saturation_gray = params.saturation_gray or full_scale_gray - 1
    result = numerics.fuse_exposures(
        [[f.gray for f in e.sines] for e in fringes.exposures],
        code,
        exposure_ms=fringes.exposures_ms,
        noise=noise,
        saturation_gray=saturation_gray,
        strategy=params.strategy,
        exposure_index=_zone_index(fringes, preview, zones) if params.strategy == "masks" else None,
    )
    return AxisPhasors(
        camera=fringes.camera,
        axis=fringes.axis,
        periods=fringes.periods,
        shifts_rad=fringes.shifts_rad,
        **result._asdict(),
        black_gray=noise.black_gray,
        gray=gray_position(fringes, facts, result.exposure_index, noise),
    )


def _zone_index(
    fringes: FringeSet, preview: Preview | None, zones: Zones | None
) -> UInt8[np.ndarray, "h w"]:
    """Give each zone its exposure: the darkest zone the longest (equation 16)."""
    if preview is None or zones is None:
        raise StageFailedError(
            "Fusion by masks needs the preview and its zones, which this scan doesn't have: choose weighted fusion."
        )
    count = len(fringes.exposures)
    if zones.zone_count != count:
        raise StageFailedError(
            f"Fusion by masks needs one exposure per zone, but there are {zones.zone_count} zones and {count} "
            "exposures: choose the strategy 'hdrsia' for the exposures, or weighted fusion."
        )
    label = zone_of_pixels(
        preview.white[fringes.camera], zones.valleys_gray, preview.foreground[fringes.camera]
    )
    exposure_of_zone = np.array([NO_EXPOSURE, *reversed(range(count))], dtype=np.uint8)
    index: UInt8[np.ndarray, "h w"] = exposure_of_zone[label]
    return index


def first_of_each_camera(sets: tuple[AxisPhasors, ...]) -> dict[str, AxisPhasors]:
    """Return each camera's first set (columns before rows), in the order of the cameras."""
    first: dict[str, AxisPhasors] = {}
    for one in sets:
        first.setdefault(one.camera, one)
    return first


def _summarise(sets: tuple[AxisPhasors, ...], exposures_ms: tuple[float, ...]) -> Phasors:
    first = first_of_each_camera(sets)
    pixels = sum(s.reasons.size for s in first.values())
    saturated = sum(int(np.count_nonzero(s.reasons & Reason.SATURATED)) for s in first.values())
    served = sum(int(np.count_nonzero(s.exposure_index != NO_EXPOSURE)) for s in first.values())
    return Phasors(
        sets=sets,
        exposures_ms=exposures_ms,
        exposure_names=tuple(f"{t:.4g} ms" for t in exposures_ms),
        exposure_map={n: s.exposure_index + np.uint8(1) for n, s in first.items()},
        fused={n: s.light_gray_per_ms for n, s in first.items()},
        reasons={n: s.reasons for n, s in first.items()},
        served_share=served / pixels,
        saturated_share=saturated / pixels,
    )
