"""Why a pixel has no result: one bit per reason, one sentence per bit.

A map of reasons is uint16; 0 means valid. Stages combine maps with `|`.
"""

from collections.abc import Mapping
from enum import IntFlag
from types import MappingProxyType

import numpy as np
from jaxtyping import UInt16


class Reason(IntFlag):
    """One bit per reason for which a pixel has no result."""

    SATURATED = 1 << 0
    DARK = 1 << 1
    LOW_MODULATION = 1 << 2
    ORDER_RESIDUAL = 1 << 3
    GUARD_BAND = 1 << 4
    OUTSIDE_PROJECTOR = 1 << 5
    NO_MATCH = 1 << 6
    AMBIGUOUS_MATCH = 1 << 7
    LEFT_RIGHT_CHECK = 1 << 8
    EPIPOLAR = 1 << 9
    OUTLIER = 1 << 10
    CLIPPED = 1 << 11
    MISSING_DATA = 1 << 12
    CODE_MARGIN = 1 << 13
    HIDDEN_EDGE = 1 << 14


SENTENCES: Mapping[Reason, str] = MappingProxyType(
    {
        Reason.SATURATED: "Too bright: at least one frame is saturated at every exposure; add a shorter one.",
        Reason.DARK: "Too dark: hardly any projected light returns from here; add a longer exposure.",
        Reason.LOW_MODULATION: "Low contrast: light returns, but the pattern in it is too weak to measure.",
        Reason.ORDER_RESIDUAL: "Contradiction: the frequencies disagree about the fringe, as under inter-reflection or at an edge.",
        Reason.GUARD_BAND: "Edge of the code: so near to the projector's border both ends of the code look alike.",
        Reason.OUTSIDE_PROJECTOR: "Outside the projector: the decoded position isn't on its picture.",
        Reason.NO_MATCH: "No partner: the other camera doesn't see this point (hidden or out of view).",
        Reason.AMBIGUOUS_MATCH: "Ambiguous: several places in the other camera match equally well.",
        Reason.LEFT_RIGHT_CHECK: "Not mutual: matched back from the other camera it lands on another pixel.",
        Reason.EPIPOLAR: "Off the epipolar line: the match contradicts the calibration, as after a second reflection.",
        Reason.OUTLIER: "Outlier: the point stands apart from its neighbours.",
        Reason.CLIPPED: "Clipped: outside the measuring volume that was set.",
        Reason.MISSING_DATA: "No data: masked, or a frame that is needed wasn't captured.",
        Reason.CODE_MARGIN: "Uncertain code: pattern and reference are too alike to tell black from white.",
        Reason.HIDDEN_EDGE: "Hidden edge: pattern and inverse are both saturated where they cross, so the edge's place could only be guessed.",
    }
)
"""What the operator reads about each reason."""


def reason_sentences(reasons: int) -> tuple[str, ...]:
    """List the sentences of all reasons in one pixel's value, lowest bit first.

    Examples
    --------
    >>> reason_sentences(0)
    ()
    >>> len(reason_sentences(Reason.SATURATED | Reason.OUTLIER))
    2
    """
    return tuple(sentence for reason, sentence in SENTENCES.items() if reasons & reason)


def count_reasons(reasons: UInt16[np.ndarray, "*shape"]) -> dict[Reason, int]:
    """Count the pixels of each reason; a pixel with two reasons counts in both.

    Examples
    --------
    >>> count_reasons(np.array([0, 1, 3], dtype=np.uint16))[Reason.SATURATED]
    2
    """
    # 65536 bins in one pass instead of one pass over the map per reason.
    histogram = np.bincount(reasons.ravel(), minlength=1 << 16)
    values = np.arange(histogram.size)
    return {reason: int(histogram[(values & reason) != 0].sum()) for reason in Reason}
