"""From phasors to the projector coordinate of every pixel: fringe orders, position, noise, reasons."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from backend.domain.checks import Check, at_least
from backend.domain.errors import StageFailedError
from backend.domain.hints import Mask, Picture, Value
from backend.domain.params import Params, setting
from backend.domain.rig import RigFacts
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics import absolute_phase as numerics
from backend.numerics import fringe_orders
from backend.numerics.fringe_orders import FringeOrders
from backend.stages.cloud import REASON_LABELS
from backend.stages.fusion import AxisPhasors, Phasors, first_of_each_camera

Unwrapping = Literal["maximum_likelihood", "cascade", "hierarchical", "gray_code"]

ORDER_SHARE = 0.99
"""Of half the distance between two fringe orders: beyond, the nearest order is a guess."""


class FringePhaseParams(Params):
    """How fringe orders are found and which pixels are accepted."""

    unwrapping: Unwrapping | None = setting(None, title="Fringe orders", auto="unwrapping")
    """Automatic: Gray code if one was projected, from coarse to fine if a frequency has a single period,
    else maximum likelihood over all frequencies. cascade: the paper's heterodyne beats."""
    modulation_min_gray: float = setting(4.0, title="Least modulation", unit="gray", ge=0, le=1000)
    """Amplitude of the fringes in gray levels of the exposure used."""
    residual_max_cycles: float | None = setting(
        None,
        title="Largest contradiction",
        unit="cycles",
        ge=0.0005,
        le=0.5,
        auto="residual_max_cycles",
    )
    """By how much the frequencies may disagree. Automatic: just what mixes up two fringe orders; the cloud judges
    second reflections with more knowledge."""
    guard_band: float = setting(0.002, title="Guard band", ge=0, le=0.2, advanced=True)
    """Share of the projector's width left out at both ends, where the code may wrap."""


@dataclass(frozen=True)
class AbsolutePhase:
    """Where on the projector the light of every pixel comes from."""

    projector_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Projector column", unit="px", colormap="turbo"),
    ]
    """Projector column u, pixel centres at integers; NaN where invalid. Empty if columns weren't coded."""
    projector_row_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Projector row", unit="px", colormap="turbo"),
    ]
    """Projector row v; empty if rows weren't coded."""
    wrapped_rad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Wrapped phase", unit="rad", colormap="twilight"),
    ]
    """Of the highest frequency, in (-pi, pi]."""
    modulation_gray: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Modulation", unit="gray", colormap="viridis"),
    ]
    residual_cycles: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Contradiction", unit="cycles", colormap="inferno", low=0.0),
    ]
    sigma_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Predicted noise", unit="px", colormap="inferno", low=0.0),
    ]
    sigma_row_px: Mapping[str, Float32[np.ndarray, "_h _w"]]
    reasons: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]], Mask("Missing because", REASON_LABELS, bits=True)
    ]
    exposure_index: Mapping[str, UInt8[np.ndarray, "_h _w"]]
    """Exposure of the largest weight, 255 for none."""
    valid_share: Annotated[float, Value("Pixels with a phase")]
    median_sigma_px: Annotated[float, Value("Predicted noise, median", unit="px")]
    unwrapping: Annotated[str, Value("Fringe orders by")]
    residual_max_cycles: float
    full_scale_gray: float


def _enough(result: AbsolutePhase, params: FringePhaseParams) -> Check:
    return at_least(
        "valid share", result.valid_share, warning=0.02, failure=1e-4,
        sentence=f"{result.valid_share:.1%} of all pixels have an absolute phase",
        remedy="look at why pixels are missing, then change the exposures",
    )  # fmt: skip


@stage(title="Phase", version=2, review=Review.ON_WARNING, checks=(_enough,))
def fringe_phase(
    phasors: Phasors, facts: RigFacts, params: FringePhaseParams, progress: Progress
) -> AbsolutePhase:
    """Find the projector position of each pixel from all frequencies together."""
    if facts.projector is None:
        raise StageFailedError(
            "The size of the projected pattern isn't known: add the projector to the capture."
        )
    size_px = {"x": facts.projector.width_px, "y": facts.projector.height_px}
    decoded: dict[str, dict[str, numerics.AbsolutePhase]] = {"x": {}, "y": {}}
    orders: FringeOrders | None = None
    for number, axis in enumerate(phasors.sets):
        progress(number / len(phasors.sets), f"camera {axis.camera}, {axis.axis}")
        orders = prepare_orders(axis, params)
        decoded[axis.axis][axis.camera] = decode(axis, orders, size_px[axis.axis], params)
    assert orders is not None, "fusion returns at least one set"
    return _summarise(phasors, decoded, orders, params, facts)


def prepare_orders(axis: AxisPhasors, params: FringePhaseParams) -> FringeOrders:
    """Choose and prepare the way to the fringe orders."""
    way = params.unwrapping or _automatic(axis)
    if way == "gray_code":
        if axis.gray is None:
            raise StageFailedError(
                "Fringe orders by Gray code need Gray code frames: choose maximum likelihood."
            )
        return fringe_orders.code_aided(axis.periods, codes=axis.gray.codes)
    if way == "cascade":
        return fringe_orders.cascade(axis.periods)
    if way == "hierarchical":
        return fringe_orders.hierarchical(axis.periods)
    return fringe_orders.maximum_likelihood(axis.periods, guard_band=params.guard_band)


def _automatic(axis: AxisPhasors) -> Unwrapping:
    if axis.gray is not None:
        return "gray_code"
    return "hierarchical" if min(axis.periods) <= 1.0 else "maximum_likelihood"


def decode(
    axis: AxisPhasors, orders: FringeOrders, size_px: int, params: FringePhaseParams
) -> numerics.AbsolutePhase:
    """Decode one camera along one direction."""
    limits = numerics.Limits(
        params.modulation_min_gray, _residual_limit(orders, params), params.guard_band
    )
    return numerics.absolute_phase(
        axis.phasors,
        axis.code,
        orders,
        size_px=size_px,
        limits=limits,
        coarse_px=None if axis.gray is None else axis.gray.position_px,
        with_wrapped=True,
    )


def _residual_limit(orders: FringeOrders, params: FringePhaseParams) -> float:
    if params.residual_max_cycles is not None:
        return params.residual_max_cycles
    if orders.strategy == "maximum_likelihood":
        return ORDER_SHARE * orders.distance_cycles / 2
    return orders.default_residual_cycles


def _summarise(
    phasors: Phasors,
    decoded: dict[str, dict[str, numerics.AbsolutePhase]],
    orders: FringeOrders,
    params: FringePhaseParams,
    facts: RigFacts,
) -> AbsolutePhase:
    main = decoded["x"] or decoded["y"]
    first = first_of_each_camera(phasors.sets)
    sigma = {n: _sigma(d) for n, d in main.items()}
    valid = sum(int(np.count_nonzero(d.reasons == 0)) for d in main.values())
    some = np.concatenate([s.ravel()[:: max(1, s.size // 100_000)] for s in sigma.values()])
    finite = some[np.isfinite(some)]
    return AbsolutePhase(
        projector_px={n: d.projector_px for n, d in decoded["x"].items()},
        projector_row_px={n: d.projector_px for n, d in decoded["y"].items()},
        wrapped_rad={n: _wrapped(d) for n, d in main.items()},
        modulation_gray={n: d.modulation_gray for n, d in main.items()},
        residual_cycles={n: d.residual_cycles for n, d in main.items()},
        sigma_px=sigma,
        sigma_row_px={n: _sigma(d) for n, d in decoded["y"].items()},
        reasons={n: d.reasons for n, d in main.items()},
        exposure_index={n: s.exposure_index for n, s in first.items()},
        valid_share=valid / sum(int(d.reasons.size) for d in main.values()),
        median_sigma_px=float(np.median(finite)) if finite.size else float("nan"),
        unwrapping=orders.strategy.replace("_", " "),
        residual_max_cycles=_residual_limit(orders, params),
        full_scale_gray=facts.cameras[facts.reference].full_scale_gray,
    )


def _sigma(decoded: numerics.AbsolutePhase) -> Float32[np.ndarray, "h w"]:
    assert decoded.sigma_px is not None, "absolute_phase always predicts sigma"
    return decoded.sigma_px


def _wrapped(decoded: numerics.AbsolutePhase) -> Float32[np.ndarray, "h w"]:
    assert decoded.wrapped_rad is not None, "decode asks for it"
    return decoded.wrapped_rad
