"""Put two sets of codes together, pixel by pixel."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Shaped

from backend.stages.edges import Codes

_Maps = Mapping[str, Shaped[np.ndarray, "_h _w"]]


def join(first: Codes, second: Codes, use: Mapping[str, Bool[np.ndarray, "_h _w"]]) -> Codes:
    """Take a pixel's code, and the borders that it sees, from the second set where `use` says so.

    Cameras that the second set lacks keep the first; so do those that `use` doesn't name.
    """
    reasons = _joined(first.reasons, second.reasons, use)
    pixels = sum(r.size for r in reasons.values())
    return replace(
        first,
        projector_px=_joined(first.projector_px, second.projector_px, use),
        projector_row_px=_joined(first.projector_row_px, second.projector_row_px, use),
        contrast_gray=_joined(first.contrast_gray, second.contrast_gray, use),
        reasons=reasons,
        valid_share=sum(int(np.count_nonzero(r == 0)) for r in reasons.values()) / pixels,
        sigma_px=_joined(first.sigma_px, second.sigma_px, use),
        sigma_row_px=_joined(first.sigma_row_px, second.sigma_row_px, use),
        widening_px=_joined(first.widening_px, second.widening_px, use),
        column_edge_px={
            name: _joined_edges(edge, second.column_edge_px.get(name), use.get(name))
            for name, edge in first.column_edge_px.items()
        },
        row_edge_px={
            name: _joined_edges(edge, second.row_edge_px.get(name), _turned(use.get(name)))
            for name, edge in first.row_edge_px.items()
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
    second_px: Float32[np.ndarray, "lines borders"] | None,
    use: Bool[np.ndarray, "lines places"] | None,
) -> Float32[np.ndarray, "lines borders"]:
    """Take a border from the look that its pixel is taken from; a border is a position along a line of pixels."""
    if use is None or second_px is None:
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
