"""From Gray code frames to the projector column and row that each pixel sees."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, TypedDict

import numpy as np
from jaxtyping import Float32, Int32, UInt16

from backend.domain.checks import Check, at_least
from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame
from backend.domain.hints import Mask, Picture, Value
from backend.domain.params import Params, setting
from backend.domain.rig import ProjectorFacts, RigFacts
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.gray_code import GrayCode, decode_gray_code, decode_gray_code_by_reference
from backend.stages.cloud import REASON_LABELS
from backend.stages.code_frames import CodeFrames, CodeSet, code_sets

_WEAK_SHARE = 0.4
"""A bit with less than this share of the best bit's contrast isn't resolved by the optics."""


class EdgesParams(Params):
    """Which bits count."""

    min_contrast_gray: float = setting(4.0, title="Least contrast", unit="gray", ge=0, le=65535)
    """A bit is certain where pattern and inverse differ by more than this."""
    weak_bits: int | None = setting(None, title="Weak bits", ge=0, le=8, auto="weak_bits_used")
    """So many of the finest bits may be uncertain: they are read, but don't make a pixel invalid. Automatic:
    those with less than 40 % of the best bit's contrast, which the optics don't resolve."""
    ignored_bits: int = setting(0, title="Ignored bits", ge=0, le=12, advanced=True)
    """So many of the finest bits aren't read at all."""
    saturation_gray: float | None = setting(
        None, title="Saturated from", unit="gray", ge=1, le=65535, advanced=True
    )
    """Pattern and inverse both this bright: saturated. Automatic: full scale."""


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


def _enough(result: Codes, params: EdgesParams) -> Check:
    return at_least(
        "valid share", result.valid_share, warning=0.01, failure=1e-5,
        sentence=f"{result.valid_share:.1%} of all pixels have a code",
    )  # fmt: skip


@stage(title="Decoding", version=1, review=Review.ON_WARNING, checks=(_enough,))
def edges(frames: CodeFrames, facts: RigFacts, params: EdgesParams, progress: Progress) -> Codes:
    """Read the Gray code: which projector column and row each pixel sees."""
    if facts.projector is None:
        raise StageFailedError(
            "The size of the projected pattern isn't known: add the projector to the capture."
        )
    sets = code_sets(frames.frames)
    decoded: dict[str, dict[str, _Decoded]] = {"x": {}, "y": {}}
    for number, code in enumerate(sets):
        progress(number / len(sets), f"camera {code.camera}, {code.axis}")
        decoded[code.axis][code.camera] = _decode(code, facts.projector, params)
    return _summarise(decoded, {s.camera: s for s in reversed(sets)})


@dataclass(frozen=True)
class _Decoded:
    """One camera along one direction."""

    gray: GrayCode
    weak_bits: int
    codes: int


def _decode(code: CodeSet, projector: ProjectorFacts, params: EdgesParams) -> _Decoded:
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
        min_contrast_gray=params.min_contrast_gray,
        ignored_low_bits=params.ignored_bits,
        unjudged_low_bits=weak - params.ignored_bits,
        saturation_gray=params.saturation_gray or code.full_scale_gray,
    )
    return _Decoded(_read(code, read), weak, code.codes)


class _Reading(TypedDict):
    """How a code is read, whatever it is compared with."""

    codes: int
    size_px: int
    min_contrast_gray: float
    ignored_low_bits: int
    unjudged_low_bits: int
    saturation_gray: float


def _read(code: CodeSet, reading: _Reading) -> GrayCode:
    patterns = [f.gray for f in code.patterns]
    if code.inverses:
        return decode_gray_code(patterns, [f.gray for f in code.inverses], **reading)
    assert code.white is not None, "a set without inverses has its fields"
    assert code.black is not None, "a set without inverses has its fields"
    return decode_gray_code_by_reference(
        patterns, white=code.white.gray, black=code.black.gray, **reading
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


def _summarise(decoded: dict[str, dict[str, _Decoded]], first: Mapping[str, CodeSet]) -> Codes:
    reasons = {name: _reasons(name, decoded) for name in first}
    columns, rows = (
        {name: _where_valid(d.gray, reasons[name]) for name, d in decoded[axis].items()}
        for axis in ("x", "y")
    )
    both = [*decoded["x"].values(), *decoded["y"].values()]
    pixels = sum(r.size for r in reasons.values())
    return Codes(
        projector_px=columns,
        projector_row_px=rows,
        contrast_gray={name: _contrast(name, decoded) for name in first},
        brightness={name: _brightness(code) for name, code in first.items()},
        reasons=reasons,
        valid_share=sum(int(np.count_nonzero(r == 0)) for r in reasons.values()) / pixels,
        weak_bits_used=max(d.weak_bits for d in both),
        codes=max(d.codes for d in decoded["x"].values() or both),
    )


def _reasons(name: str, decoded: dict[str, dict[str, _Decoded]]) -> UInt16[np.ndarray, "h w"]:
    maps = [d[name].gray.reasons for d in decoded.values() if name in d]
    return np.asarray(np.bitwise_or.reduce(maps))


def _contrast(name: str, decoded: dict[str, dict[str, _Decoded]]) -> UInt16[np.ndarray, "h w"]:
    maps = [d[name].gray.contrast_gray for d in decoded.values() if name in d]
    return np.asarray(np.minimum.reduce(maps))


def _where_valid(
    decoded: GrayCode, reasons: UInt16[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Blank the pixels that the other direction can't read."""
    return np.where(reasons == 0, decoded.projector_px, np.float32(np.nan))


def _brightness(code: CodeSet) -> Float32[np.ndarray, "h w"]:
    if code.white is not None:
        return code.white.gray.astype(np.float32)
    pair = code.patterns[0].gray, code.inverses[0].gray
    return np.asarray((pair[0].astype(np.float32) + pair[1]) / np.float32(2))
