"""What each camera pixel makes of projected light: uniform fields, and a line through their gray levels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from backend.domain.checks import Check, at_most
from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Frames, Picture, Table, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import BLACK, WHITE, Uniform
from backend.domain.rig import RigFacts
from backend.domain.shots import Exposed, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.response_fit import ResponseFit, fit_response, light_of_code
from backend.stages.base_exposure import BaseExposure

_LEAST_SAMPLES = 3
"""Unsaturated samples that end the ladder: the black field and two that are lit."""


class PixelResponseParams(Params):
    """Which uniform fields are captured."""

    fields: tuple[int, ...] = setting((50, 100, 150), title="Fields", unit="code", min_length=1)
    """Projected codes, 1 to 255, that every pixel is measured with."""
    darker_fields: tuple[int, ...] = setting((25, 12, 6, 3, 1), title="Darker fields", unit="code")
    """Captured as well, two by two, as long as bright pixels have fewer than two unsaturated fields."""
    few_share: float = setting(1e-4, title="Pixels that needn't", ge=0, le=0.5, advanced=True)
    """Share of the lit pixels that may stay without two unsaturated fields: hot pixels must not decide."""
    black_and_white: bool = setting(True, title="Use black and white field", advanced=True)
    """The fields of the base exposure are samples too. Off: only the fields above, as in the paper, for a
    projector whose gamma isn't known."""


@dataclass(frozen=True)
class FieldRow:
    """One uniform field."""

    code_gray: int
    light: float
    """0 to 255, proportional to the projector's light."""
    saturated_share: float
    """Of the lit pixels."""


@dataclass(frozen=True)
class PixelResponse:
    """The line I = k P + b of every pixel; P is the projected light, 255 for the white field."""

    frames: Annotated[
        tuple[Frame, ...], Frames("Uniform fields", x="light", slope="gain", offset="offset_gray")
    ]
    light: Float64[np.ndarray, "n_fields"]
    """Light of each field in 0..255, darkest first; the frames of each camera are in this order."""
    gain: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Response k", unit="gray per light", colormap="inferno"),
    ]
    """NaN where fewer than two samples aren't saturated."""
    offset_gray: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]], Picture("Offset b", unit="gray")
    ]
    residual_gray: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Residual of the line", unit="gray", colormap="viridis"),
    ]
    samples: Annotated[
        Mapping[str, UInt8[np.ndarray, "_h _w"]],
        Picture("Unsaturated fields", colormap="viridis"),
    ]
    fields: Annotated[tuple[FieldRow, ...], Table("Uniform fields")]
    unknown_share: Annotated[float, Value("Lit pixels without a response")]
    median_residual_gray: Annotated[float, Value("Residual, median", unit="gray")]
    gamma: Annotated[float, Value("Projector gamma used")]
    """Fields are meant in light: code 128 of a projector of gamma 2 counts as 64. 1: linear or not known."""
    full_scale_gray: float = 255.0


def _known(result: PixelResponse, params: PixelResponseParams) -> Check:
    return at_most(
        "response known", result.unknown_share, warning=0.005, failure=0.5,
        sentence=f"{result.unknown_share:.2%} of the lit pixels saturate even under the darkest field",
    )  # fmt: skip


def _straight(result: PixelResponse, params: PixelResponseParams) -> Check:
    share = result.median_residual_gray / result.full_scale_gray
    return at_most(
        "straight line", share, warning=0.02, failure=0.2,
        sentence=f"the lines miss their samples by {result.median_residual_gray:.2f} gray (median); "
        "much more than noise means that the projector's gamma isn't known",
    )  # fmt: skip


@stage(title="Response", version=1, review=Review.ON_WARNING, checks=(_known, _straight))
def pixel_response(
    base: BaseExposure, facts: RigFacts, params: PixelResponseParams, shoot: Shoot
) -> PixelResponse:
    """Measure how bright each pixel gets per projected light; pixels that saturate get darker fields."""
    if facts.projector is None:
        raise StageFailedError("The rig has no projector: its response can't be measured.")
    codes = (*params.fields, *params.darker_fields)
    if not all(1 <= code <= 255 for code in codes):
        raise StageFailedError(
            f"Uniform fields need codes from 1 to 255, but {min(codes)} to {max(codes)} were asked for."
        )
    return shoot(fields_plan(base, facts, params))


def fields_plan(
    base: BaseExposure, facts: RigFacts, params: PixelResponseParams
) -> Plan[PixelResponse]:
    """Capture the ladder, then darker fields as long as bright pixels need them."""
    taken: dict[int, Exposed] = {}
    if params.black_and_white:
        taken = {0: _kept(base, facts, black=True), 255: _kept(base, facts, black=False)}
    codes = tuple(dict.fromkeys(params.fields))
    darker = [c for c in sorted(set(params.darker_fields), reverse=True) if c not in codes]
    while codes:
        new = tuple(code for code in codes if code not in taken)
        exposed = yield tuple(
            Shot(Uniform(gray=c), base.exposure_ms, gain_db=base.gain_db, role="field") for c in new
        )
        taken |= dict(zip(new, exposed, strict=True))
        wanted = _LEAST_SAMPLES if params.black_and_white else _LEAST_SAMPLES - 1
        if _unmeasured_share(taken, base, facts, wanted) <= params.few_share:
            break
        codes, darker = tuple(darker[:2]), darker[2:]
    return _summarise(dict(sorted(taken.items())), base, facts)


def _kept(base: BaseExposure, facts: RigFacts, *, black: bool) -> Exposed:
    """Return a field that the base exposure brought, as a frame."""
    pictures, pattern = (base.black, BLACK) if black else (base.white, WHITE)
    return {
        name: Frame(
            name,
            pattern,
            base.exposure_ms,
            InMemory(pictures[name]),
            facts.cameras[name].bit_depth,
            base.gain_db,
            "field",
        )
        for name in facts.cameras
    }


def saturation_gray(facts: RigFacts, camera: str) -> float:
    """Return the gray level from which a pixel counts as saturated."""
    return facts.cameras[camera].full_scale_gray - 1


def _unmeasured_share(
    taken: Mapping[int, Exposed], base: BaseExposure, facts: RigFacts, wanted: int
) -> float:
    """Return the share of lit pixels with fewer unsaturated fields than wanted, of the worse camera."""
    shares = []
    for name in facts.cameras:
        limit, lit = saturation_gray(facts, name), base.lit[name]
        count = np.zeros(lit.shape, np.uint8)
        for exposed in taken.values():
            count += exposed[name].gray < limit
        shares.append(
            int(np.count_nonzero(lit & (count < wanted))) / max(1, int(np.count_nonzero(lit)))
        )
    return float(max(shares))


def _summarise(taken: Mapping[int, Exposed], base: BaseExposure, facts: RigFacts) -> PixelResponse:
    assert facts.projector is not None, "the stage refuses a rig without one"
    light = light_of_code([float(code) for code in taken], facts.projector.gamma)
    fits = {
        name: fit_response(
            [exposed[name].gray for exposed in taken.values()],
            light,
            saturation_gray=saturation_gray(facts, name),
        )
        for name in facts.cameras
    }
    return PixelResponse(
        frames=tuple(exposed[name] for exposed in taken.values() for name in facts.cameras),
        light=light,
        gain={name: fit.gain for name, fit in fits.items()},
        offset_gray={name: fit.offset_gray for name, fit in fits.items()},
        residual_gray={name: fit.residual_gray for name, fit in fits.items()},
        samples={name: fit.samples for name, fit in fits.items()},
        fields=tuple(
            FieldRow(code, float(value), _saturated_share(taken[code], base, facts))
            for code, value in zip(taken, light, strict=True)
        ),
        unknown_share=_share(base, {name: np.isnan(fit.gain) for name, fit in fits.items()}),
        median_residual_gray=_median_residual(fits, base),
        gamma=facts.projector.gamma,
        full_scale_gray=min(c.full_scale_gray for c in facts.cameras.values()),
    )


def _saturated_share(exposed: Exposed, base: BaseExposure, facts: RigFacts) -> float:
    return _share(base, {n: f.gray >= saturation_gray(facts, n) for n, f in exposed.items()})


def _share(base: BaseExposure, marked: Mapping[str, Bool[np.ndarray, "_h _w"]]) -> float:
    lit = sum(int(np.count_nonzero(m)) for m in base.lit.values())
    hit = sum(int(np.count_nonzero(marked[n] & lit_px)) for n, lit_px in base.lit.items())
    return hit / max(1, lit)


def _median_residual(fits: Mapping[str, ResponseFit], base: BaseExposure) -> float:
    """Return the median over the lit pixels that have more samples than the line needs."""
    values = np.concatenate(
        [fit.residual_gray[base.lit[name] & (fit.samples > 2)] for name, fit in fits.items()]
    )
    return float(np.median(values)) if values.size else 0.0
