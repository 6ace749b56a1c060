"""The place within a stripe of the Gray code, from shifted stripes: maps of one camera along one direction."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt16

from backend.domain.errors import StageFailedError
from backend.domain.rig import CameraFacts, ProjectorFacts
from backend.numerics.edge_positions import EdgePositions, edge_positions
from backend.numerics.line_shift import LineShift, LineShiftLimits, Stripes, decode_line_shift
from backend.numerics.mixed_light import separate_lights
from backend.numerics.reasons import Reason
from backend.stages.camera_noise import noise_model
from backend.stages.code_frames import CodeSet
from backend.stages.intensity_mask import IntensityMask

_SPARE_PX = 1.5
"""Blur and noise may move a coarse position so far beyond the stripe that it names."""


@dataclass(frozen=True)
class ShiftedEdges:
    """Sub-pixel coordinate of every pixel, and the edges along the camera's rows (or columns)."""

    located: LineShift
    edges: EdgePositions


def shifted_edges(
    code: CodeSet,
    coarse_px: Float32[np.ndarray, "h w"],
    *,
    coarse_width_px: float,
    projector: ProjectorFacts,
    camera: CameraFacts,
    limits: LineShiftLimits,
    mask: IntensityMask | None,
    across_px: Float32[np.ndarray, "h w"] | None,
    separate: bool,
) -> ShiftedEdges:
    """Locate the stripes of a set, whose Gray code names each pixel's stripe.

    `coarse_px` is the middle of the Gray code's stripe, NaN where it can't be read, `coarse_width_px` that stripe's
    width, `across_px` the coordinate along the stripes, by which the mask is looked up.
    """
    assert code.stripes is not None, "only sets with stripes come here"
    size_px = projector.width_px if code.axis == "x" else projector.height_px
    stripes = code.stripes.stripes(size_px)
    limits = limits._replace(coarse_error_px=_coarse_error_px(coarse_width_px, stripes))
    patterns = [f.gray for f in code.stripes.patterns]
    inverses = [f.gray for f in code.stripes.inverses]
    factor = None if mask is None else _factor(mask, code.axis, projector)
    noise = noise_model(camera, gain_db=code.stripes.patterns[0].gain_db)
    located = decode_line_shift(
        patterns,
        inverses,
        stripes,
        coarse_px,
        size_px=size_px,
        noise=noise,
        limits=limits,
        mask=factor,
        across_px=across_px,
    )
    if separate:
        found = separate_lights(
            patterns, inverses, stripes, located, noise=noise, mask=factor, across_px=across_px
        )
        located = located._replace(projector_px=found.projector_px, sigma_px=found.sigma_px)
    return ShiftedEdges(located, _edges(code, located, stripes, size_px))


def with_coarse_reasons(
    located: LineShift, coarse: UInt16[np.ndarray, "h w"]
) -> UInt16[np.ndarray, "h w"]:
    """Say of pixels without a coarse position why they have none."""
    lacks_code = (located.reasons == np.uint16(Reason.MISSING_DATA)) & (coarse != 0)
    return np.where(lacks_code, coarse, located.reasons)


def _coarse_error_px(coarse_width_px: float, stripes: Stripes) -> float:
    """Refuse a Gray code too coarse to tell one period from the next."""
    error_px = coarse_width_px / 2 + _SPARE_PX
    if error_px > stripes.period_px / 2:
        raise StageFailedError(
            f"The Gray code tells stripes of {coarse_width_px:g} px, too coarse for shifted stripes with a period of "
            f"{stripes.period_px:g} px: capture finer bits or wider stripes."
        )
    return error_px


def _factor(
    mask: IntensityMask, axis: str, projector: ProjectorFacts
) -> Float32[np.ndarray, "across along"]:
    factor = np.asarray(mask.factor, np.float32)
    if factor.shape != (projector.height_px, projector.width_px):
        raise StageFailedError(
            f"The intensity mask is {factor.shape[1]} x {factor.shape[0]} px, the projector {projector.width_px} x "
            f"{projector.height_px}: make it anew for this projector."
        )
    return factor if axis == "x" else np.ascontiguousarray(factor.T)


def _edges(code: CodeSet, located: LineShift, stripes: Stripes, size_px: int) -> EdgePositions:
    """Place the edges along rows for columns, along columns for rows."""
    assert code.stripes is not None, "only sets with stripes come here"
    patterns = [f.gray for f in code.stripes.patterns]
    inverses = [f.gray for f in code.stripes.inverses]
    place = located.projector_px
    if code.axis == "y":
        patterns = [np.ascontiguousarray(p.T) for p in patterns]
        inverses = [np.ascontiguousarray(p.T) for p in inverses]
        place = np.ascontiguousarray(place.T)
    return edge_positions(patterns, inverses, stripes, place, size_px=size_px)
