"""One code per pixel from two looks: the first where it can be trusted, the second where that one can."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Shaped

from backend.domain.stage import stage
from backend.domain.states import Review
from backend.stages.edges import Codes
from backend.stages.second_look import SecondLook

_Maps = Mapping[str, Shaped[np.ndarray, "_h _w"]]


@stage(title="Joined code", version=1, review=Review.ON_FAILURE)
def joined_codes(codes: Codes, second: SecondLook | None) -> Codes:
    """Take the code of the second look where only that one agrees with the calibration."""
    if second is None or second.codes is None:
        return codes
    again, use = second.codes, second.trusted
    reasons = _joined(codes.reasons, again.reasons, use)
    pixels = sum(r.size for r in reasons.values())
    return replace(
        codes,
        projector_px=_joined(codes.projector_px, again.projector_px, use),
        projector_row_px=_joined(codes.projector_row_px, again.projector_row_px, use),
        contrast_gray=_joined(codes.contrast_gray, again.contrast_gray, use),
        reasons=reasons,
        valid_share=sum(int(np.count_nonzero(r == 0)) for r in reasons.values()) / pixels,
        sigma_px=_joined(codes.sigma_px, again.sigma_px, use),
        sigma_row_px=_joined(codes.sigma_row_px, again.sigma_row_px, use),
        widening_px=_joined(codes.widening_px, again.widening_px, use),
        column_edge_px={
            name: _joined_edges(edge, again.column_edge_px[name], use.get(name))
            for name, edge in codes.column_edge_px.items()
        },
        row_edge_px={
            name: _joined_edges(edge, again.row_edge_px[name], _turned(use.get(name)))
            for name, edge in codes.row_edge_px.items()
        },
    )


def _joined(
    first: _Maps, second: _Maps, use: Mapping[str, Bool[np.ndarray, "_h _w"]]
) -> dict[str, Shaped[np.ndarray, "_h _w"]]:
    return {
        name: np.where(use[name], second[name], m) if name in use and name in second else m
        for name, m in first.items()
    }


def _turned(use: Bool[np.ndarray, "h w"] | None) -> Bool[np.ndarray, "_w _h"] | None:
    return None if use is None else use.T


def _joined_edges(
    first_px: Float32[np.ndarray, "lines borders"],
    second_px: Float32[np.ndarray, "lines borders"],
    use: Bool[np.ndarray, "lines places"] | None,
) -> Float32[np.ndarray, "lines borders"]:
    """Take a border from the look that its pixel is taken from; a border is a position along a line of pixels."""
    if use is None:
        return first_px
    from_second = _at(use, second_px)
    from_first = ~_at(use, first_px) & ~np.isnan(first_px)
    keep = np.where(from_first, first_px, np.float32(np.nan))
    return np.asarray(np.where(from_second & ~from_first, second_px, keep), np.float32)


def _at(
    use: Bool[np.ndarray, "lines places"], position_px: Float32[np.ndarray, "lines borders"]
) -> Bool[np.ndarray, "lines borders"]:
    """Look up the pixel of each position; False where there is none."""
    known = ~np.isnan(position_px)
    pixel = np.clip(
        np.nan_to_num(position_px + np.float32(0.5)).astype(np.intp), 0, use.shape[1] - 1
    )
    return np.asarray(known & np.take_along_axis(use, pixel, axis=1))
