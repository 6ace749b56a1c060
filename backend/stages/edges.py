"""From captured code to the projector column and row that each pixel sees, to a fraction of a pixel with stripes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypedDict

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt16

from backend.domain.checks import Check, at_least, at_most
from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame
from backend.domain.hints import Mask, Picture, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import Axis
from backend.domain.rig import ProjectorFacts, RigFacts
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.gray_code import (
    GrayCode,
    decode_gray_code,
    decode_gray_code_by_reference,
    decode_gray_code_by_threshold,
)
from backend.numerics.line_shift import LineShiftLimits
from backend.stages.cloud import REASON_LABELS
from backend.stages.code_frames import CodeFrames, CodeSet, code_sets
from backend.stages.intensity_mask import IntensityMask
from backend.stages.shifted_edges import ShiftedEdges, shifted_edges, with_coarse_reasons

_WEAK_SHARE = 0.4
"""A bit with less than this share of the best bit's contrast isn't resolved by the optics."""
_BRIGHTEST = 0.95
"""Quantile of the brightness above which pixels count as the brightest."""

Decoding = Literal["delta", "dual", "fixed"]


class EdgesParams(Params):
    """How black is told from white, and which bits count."""

    decoding: Decoding = setting("delta", title="Black or white by")
    """delta: pattern against inverse, unknown where they differ too little; dual: pattern against inverse,
    however little they differ; fixed: one threshold for the whole picture. The last two are there to compare."""
    min_contrast_gray: float = setting(4.0, title="Least contrast", unit="gray", ge=0, le=65535)
    """A bit is certain where pattern and inverse differ by more than this."""
    threshold_gray: float | None = setting(
        None, title="Fixed threshold", unit="gray", ge=1, le=65535, advanced=True
    )
    """For the fixed threshold alone. Automatic: half of full scale."""
    weak_bits: int | None = setting(None, title="Weak bits", ge=0, le=8, auto="weak_bits_used")
    """So many of the finest bits may be uncertain: they are read, but don't make a pixel invalid. Automatic:
    those with less than 40 % of the best bit's contrast, which the optics don't resolve."""
    ignored_bits: int = setting(0, title="Ignored bits", ge=0, le=12, advanced=True)
    """So many of the finest bits aren't read at all."""
    saturation_gray: float | None = setting(
        None, title="Saturated from", unit="gray", ge=1, le=65535, advanced=True
    )
    """Pattern and inverse both this bright: saturated. Automatic: full scale."""
    own_light: float = setting(0.5, title="Light of the own edge", ge=0, le=1, advanced=True)
    """Share of a pixel's light that has to come from within 3 px of the edge found, not from a second reflection
    or another surface. Only with shifted stripes."""
    separate: bool = setting(True, title="Separate second reflections", advanced=True)
    """Where a pixel sees two places of the stripes at once, as in the corners of shiny parts, keep the brighter
    one. Only with shifted stripes."""


@dataclass(frozen=True)
class Codes:
    """The projector pixel that each camera pixel sees."""

    projector_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Projector column", unit="px", colormap="turbo"),
    ]
    """Middle of the stripe, pixel centres at integers; NaN where a column or row can't be read."""
    projector_row_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Projector row", unit="px", colormap="turbo"),
    ]
    """Empty if rows weren't coded."""
    contrast_gray: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]],
        Picture("Contrast of the weakest bit", unit="gray", colormap="viridis"),
    ]
    """Of the bits that have to be certain."""
    brightness: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]], Picture("Brightness", unit="gray")
    ]
    """The white field, or half of pattern plus inverse of the coarsest bit."""
    reasons: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]], Mask("Missing because", REASON_LABELS, bits=True)
    ]
    valid_share: Annotated[float, Value("Pixels with a code")]
    weak_bits_used: Annotated[int, Value("Weak bits")]
    codes: Annotated[int, Value("Columns coded")]
    sigma_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Uncertainty of the column", unit="px", colormap="inferno", low=0.0),
    ] = field(default_factory=dict)
    """Predicted standard deviation; empty without shifted stripes: then columns are whole stripes."""
    sigma_row_px: Mapping[str, Float32[np.ndarray, "_h _w"]] = field(default_factory=dict)
    """The same of rows, where they had stripes, too."""
    widening_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("White wider than black stripe", unit="px", colormap="turbo", low=-2.0, high=6.0),
    ] = field(default_factory=dict)
    """In projector pixels, each picture by itself at half of its brightness: large where white is saturated
    or spills over; empty without shifted stripes."""
    column_edge_px: Mapping[str, Float32[np.ndarray, "_h _borders"]] = field(default_factory=dict)
    """Camera x of the border u = k - 1/2 between projector columns k - 1 and k, in each camera row; NaN where
    it isn't seen."""
    row_edge_px: Mapping[str, Float32[np.ndarray, "_w _borders"]] = field(default_factory=dict)
    """Camera y of the border between projector rows, in each camera column."""
    median_sigma_px: Annotated[float, Value("Uncertainty of the column, median", unit="px")] = (
        float("nan")
    )
    bright_widening_px: Annotated[
        float, Value("White wider than black stripe, brightest 5 %", unit="px")
    ] = float("nan")
    """Median over the brightest pixels of all cameras: 0 where the mask holds the light within the camera's range."""


def _enough(result: Codes, params: EdgesParams) -> Check:
    return at_least(
        "valid share", result.valid_share, warning=0.01, failure=1e-5,
        sentence=f"{result.valid_share:.1%} of all pixels have a code",
    )  # fmt: skip


def _stripes_alike(result: Codes, params: EdgesParams) -> Check:
    widening = np.nan_to_num(result.bright_widening_px)
    return at_most(
        "stripe widths", float(widening), warning=0.5, failure=1e9, unit="px",
        sentence=f"white stripes are {widening:.2f} px wider than black ones in the brightest places",
    )  # fmt: skip


@stage(title="Decoding", version=2, review=Review.ON_WARNING, checks=(_enough, _stripes_alike))
def edges(
    frames: CodeFrames,
    mask: IntensityMask | None,
    facts: RigFacts,
    params: EdgesParams,
    progress: Progress,
) -> Codes:
    """Read the code: which projector column and row each pixel sees, and where their borders lie."""
    if facts.projector is None:
        raise StageFailedError(
            "The size of the projected pattern isn't known: add the projector to the capture."
        )
    sets = code_sets(frames.frames)
    shifted = {s.camera for s in sets if s.stripes is not None}
    decoded: _AllDecoded = {"x": {}, "y": {}}
    for number, code in enumerate(sets):
        progress(0.5 * number / len(sets), f"Gray code, camera {code.camera}, {code.axis}")
        decoded[code.axis][code.camera] = _decode(
            code, facts.projector, params, spare=code.camera in shifted
        )
    for number, code in enumerate(sets):
        if code.stripes is not None:
            progress(0.5 + 0.5 * number / len(sets), f"stripes, camera {code.camera}, {code.axis}")
            found = decoded[code.axis][code.camera]
            found.shifted = _shift(code, found, decoded, mask, facts, params)
    return _summarise(decoded, {s.camera: s for s in reversed(sets)})


@dataclass
class _Decoded:
    """One camera along one direction."""

    gray: GrayCode
    weak_bits: int
    codes: int
    width_px: float
    """Of a stripe of the code."""
    shifted: ShiftedEdges | None = None

    @property
    def projector_px(self) -> Float32[np.ndarray, "h w"]:
        """The coordinate, as fine as it is known."""
        return self.shifted.located.projector_px if self.shifted else self.gray.projector_px

    @property
    def contrast_gray(self) -> UInt16[np.ndarray, "h w"]:
        """Of the weakest bit that counts, or of the stripes if that is less."""
        if self.shifted is None:
            return self.gray.contrast_gray
        weakest = np.minimum(self.gray.contrast_gray, self.shifted.located.contrast_gray)
        return np.asarray(weakest)

    @property
    def reasons(self) -> UInt16[np.ndarray, "h w"]:
        """Why pixels have no coordinate."""
        if self.shifted is None:
            return self.gray.reasons
        return with_coarse_reasons(self.shifted.located, self.gray.reasons)


_AllDecoded = dict[Axis, dict[str, _Decoded]]


def _decode(
    code: CodeSet, projector: ProjectorFacts, params: EdgesParams, *, spare: bool
) -> _Decoded:
    """Read all bits for the position, and judge the certain ones alone."""
    bits = len(code.patterns)
    if params.ignored_bits >= bits:
        raise StageFailedError(
            f"The code has {bits} bits, of which {params.ignored_bits} can't be ignored: ignore fewer."
        )
    weak = params.weak_bits
    if weak is None:
        weak = weak_bits(code, params.min_contrast_gray)
    weak = min(max(weak, params.ignored_bits), bits - 1)
    size_px = projector.width_px if code.axis == "x" else projector.height_px
    read = _Reading(
        codes=code.codes,
        size_px=size_px,
        min_contrast_gray=params.min_contrast_gray if params.decoding == "delta" else -1.0,
        ignored_low_bits=params.ignored_bits,
        unjudged_low_bits=weak - params.ignored_bits,
    )
    gray = _read(code, read, params, spare=spare and weak < bits - 1)
    return _Decoded(gray, weak, code.codes, 2**weak * size_px / code.codes)


class _Reading(TypedDict):
    """How a code is read, whatever it is compared with."""

    codes: int
    size_px: int
    min_contrast_gray: float
    ignored_low_bits: int
    unjudged_low_bits: int


def _read(code: CodeSet, reading: _Reading, params: EdgesParams, *, spare: bool) -> GrayCode:
    patterns = [f.gray for f in code.patterns]
    saturation_gray = params.saturation_gray or code.full_scale_gray
    if params.decoding == "fixed":
        return decode_gray_code_by_threshold(
            patterns, threshold_gray=_threshold_gray(code, params), **reading
        )
    if code.inverses:
        return decode_gray_code(
            patterns,
            [f.gray for f in code.inverses],
            spared_bits=int(spare),
            saturation_gray=saturation_gray,
            **reading,
        )
    assert code.white is not None, "a set without inverses has its fields"
    assert code.black is not None, "a set without inverses has its fields"
    return decode_gray_code_by_reference(
        patterns,
        white=code.white.gray,
        black=code.black.gray,
        saturation_gray=saturation_gray,
        **reading,
    )


def _threshold_gray(code: CodeSet, params: EdgesParams) -> float:
    return params.threshold_gray or code.full_scale_gray / 2


def _shift(
    code: CodeSet,
    coarse: _Decoded,
    decoded: _AllDecoded,
    mask: IntensityMask | None,
    facts: RigFacts,
    params: EdgesParams,
) -> ShiftedEdges:
    """Refine a Gray code by shifted stripes."""
    assert facts.projector is not None, "the stage refuses facts without a projector"
    across = decoded["y" if code.axis == "x" else "x"].get(code.camera)
    fixed = params.decoding == "fixed"
    return shifted_edges(
        code,
        coarse.gray.projector_px,
        coarse_width_px=coarse.width_px,
        projector=facts.projector,
        camera=facts.cameras[code.camera],
        limits=LineShiftLimits(
            min_contrast_gray=params.min_contrast_gray if params.decoding == "delta" else 0.0,
            saturation_gray=np.inf if fixed else params.saturation_gray or code.full_scale_gray,
            own_light=params.own_light if params.decoding == "delta" else 0.0,
            threshold_gray=_threshold_gray(code, params) if fixed else None,
        ),
        mask=mask,
        across_px=None if across is None else across.gray.projector_px,
        separate=params.separate and params.decoding == "delta",
    )


def weak_bits(code: CodeSet, lit_from_gray: float) -> int:
    """Count the finest bits that the optics don't resolve, judged by the pixels that the coarsest one reads."""
    contrasts = [_thinned_contrast(code, n) for n in range(len(code.patterns))]
    lit = contrasts[0] > lit_from_gray
    if not lit.any():
        return 0
    medians = [float(np.median(contrast[lit])) for contrast in contrasts]
    is_weak = [median < _WEAK_SHARE * max(medians) for median in reversed(medians)]
    return is_weak.index(False)


def _thinned_contrast(code: CodeSet, number: int) -> Int32[np.ndarray, "h w"]:
    """Return |pattern - inverse| of one bit at every fourth pixel of every fourth row."""
    pattern = _thinned(code.patterns[number])
    if code.inverses:
        return np.asarray(np.abs(pattern - _thinned(code.inverses[number])))
    assert code.white is not None, "a set without inverses has its fields"
    assert code.black is not None, "a set without inverses has its fields"
    return np.asarray(np.abs(2 * pattern - _thinned(code.white) - _thinned(code.black)))


def _thinned(frame: Frame) -> Int32[np.ndarray, "h w"]:
    return frame.gray[::4, ::4].astype(np.int32)


def _summarise(decoded: _AllDecoded, first: Mapping[str, CodeSet]) -> Codes:
    reasons = {name: _reasons(name, decoded) for name in first}
    columns, rows = (
        {name: _where_valid(d, reasons[name]) for name, d in decoded[axis].items()}
        for axis in ("x", "y")
    )
    both = [*decoded["x"].values(), *decoded["y"].values()]
    pixels = sum(r.size for r in reasons.values())
    brightness = {name: _brightness(code) for name, code in first.items()}
    shifted, shifted_rows = (
        {name: d.shifted for name, d in decoded[axis].items() if d.shifted is not None}
        for axis in ("x", "y")
    )
    sigma_px, sigma_row_px = (
        {name: _blank(s.located.sigma_px, reasons[name]) for name, s in group.items()}
        for group in (shifted, shifted_rows)
    )
    widening = {name: s.located.widening_px for name, s in shifted.items()}
    return Codes(
        projector_px=columns,
        projector_row_px=rows,
        contrast_gray={name: _contrast(name, decoded) for name in first},
        brightness=brightness,
        reasons=reasons,
        valid_share=sum(int(np.count_nonzero(r == 0)) for r in reasons.values()) / pixels,
        weak_bits_used=max(d.weak_bits for d in both),
        codes=max(d.codes for d in decoded["x"].values() or both),
        sigma_px=sigma_px,
        sigma_row_px=sigma_row_px,
        widening_px=widening,
        column_edge_px={name: s.edges.position_px for name, s in shifted.items()},
        row_edge_px={name: s.edges.position_px for name, s in shifted_rows.items()},
        median_sigma_px=_median([s[np.isfinite(s)] for s in sigma_px.values()]),
        bright_widening_px=_median([_brightest(w, brightness[n]) for n, w in widening.items()]),
    )


def _brightest(
    widening_px: Float32[np.ndarray, "h w"], brightness: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "n"]:
    known = np.isfinite(widening_px)
    if not known.any():
        return np.empty(0, np.float32)
    bright: Bool[np.ndarray, "h w"] = known & (
        brightness >= np.quantile(brightness[known], _BRIGHTEST)
    )
    return np.asarray(widening_px[bright])


def _median(parts: list[Float32[np.ndarray, "_n"]]) -> float:
    values = np.concatenate(parts) if parts else np.empty(0, np.float32)
    return float(np.median(values)) if values.size else float("nan")


def _reasons(name: str, decoded: _AllDecoded) -> UInt16[np.ndarray, "h w"]:
    maps = [d[name].reasons for d in decoded.values() if name in d]
    return np.asarray(np.bitwise_or.reduce(maps))


def _contrast(name: str, decoded: _AllDecoded) -> UInt16[np.ndarray, "h w"]:
    maps = [d[name].contrast_gray for d in decoded.values() if name in d]
    return np.asarray(np.minimum.reduce(maps))


def _where_valid(
    decoded: _Decoded, reasons: UInt16[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Blank the pixels that the other direction can't read."""
    return _blank(decoded.projector_px, reasons)


def _blank(
    values: Float32[np.ndarray, "h w"], reasons: UInt16[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    return np.where(reasons == 0, values, np.float32(np.nan))


def _brightness(code: CodeSet) -> Float32[np.ndarray, "h w"]:
    if code.white is not None:
        return code.white.gray.astype(np.float32)
    pair = code.patterns[0].gray, code.inverses[0].gray
    return np.asarray((pair[0].astype(np.float32) + pair[1]) / np.float32(2))
