"""The coarse position that a Gray code beside the fringes gives."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.patterns import Gray
from backend.domain.rig import RigFacts
from backend.numerics.gray_code import decode_gray_code, decode_gray_code_by_reference
from backend.numerics.uncertainty import NoiseModel
from backend.stages.fringe_sets import Exposed, FringeSet

CONTRAST_SIGMAS = 4.0
"""A bit counts if pattern and inverse differ by so many times their noise."""


@dataclass(frozen=True)
class GrayPosition:
    """Where each pixel's stripe stands."""

    position_px: Float32[np.ndarray, "h w"]
    """Middle of the stripe in projector pixels; NaN where the code can't be read."""
    codes: int
    """Stripes over the projector."""


def gray_position(
    fringes: FringeSet,
    facts: RigFacts,
    exposure_index: UInt8[np.ndarray, "h w"],
    noise: NoiseModel,
) -> GrayPosition | None:
    """Decode the Gray code at every exposure, and take each pixel's from the exposure that its phase is from.

    Returns None where no Gray code was projected.

    Raises
    ------
    InvalidCaptureError
        If bits or inverses are missing, or the projector's size isn't known.
    """
    if not any(e.grays for e in fringes.exposures):
        return None
    if facts.projector is None:
        raise InvalidCaptureError(
            "A Gray code needs the projector's size: add the projector to the capture."
        )
    size_px = facts.projector.width_px if fringes.axis == "x" else facts.projector.height_px
    position = np.full(exposure_index.shape, np.nan, np.float32)
    codes = 0
    for index, exposed in enumerate(fringes.exposures):
        if not exposed.grays:
            continue
        codes = _pattern(exposed.grays[0]).codes
        decoded = _decode(exposed, codes, size_px, noise)
        np.copyto(position, decoded, where=exposure_index == index)
    return GrayPosition(position, codes)


def _decode(
    exposed: Exposed, codes: int, size_px: int, noise: NoiseModel
) -> Float32[np.ndarray, "h w"]:
    patterns = [f for f in exposed.grays if not _pattern(f).inverse]
    inverses = [f for f in exposed.grays if _pattern(f).inverse]
    bits = _pattern(exposed.grays[0]).bits
    found = [_pattern(f).bit for f in patterns]
    if found != list(reversed(range(bits))):
        missing = sorted(set(range(bits)) - set(found))
        raise InvalidCaptureError(
            f"The Gray code at {exposed.exposure_ms} ms has bits {found} of {bits}: add the frames of bits {missing}."
        )
    least = float(max(1.0, CONTRAST_SIGMAS * np.sqrt(2.0 * noise.dark_variance_gray2)))
    pixels = [f.gray for f in patterns]
    if inverses:
        return decode_gray_code(
            pixels,
            [f.gray for f in inverses],
            codes=codes,
            size_px=size_px,
            min_contrast_gray=least,
        ).projector_px
    # Without inverses, the mean of the finest fringes' steps is the threshold between black and white.
    mean = np.mean([f.gray for f in exposed.sines], axis=0)
    threshold = np.round(mean).astype(pixels[0].dtype)
    return decode_gray_code_by_reference(
        pixels,
        white=threshold,
        black=threshold,
        codes=codes,
        size_px=size_px,
        min_contrast_gray=least,
    ).projector_px


def _pattern(frame: Frame) -> Gray:
    assert isinstance(frame.pattern, Gray), "Exposed.grays holds Gray code frames only"
    return frame.pattern
