"""Split the scene's gray levels into zones, each of which one exposure can serve."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, UInt8

from backend.domain.checks import Check
from backend.domain.hints import Curve, Histogram, Mask, Table, Value
from backend.domain.params import Params, setting
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.zones import ZoneFit, ZoneSettings, find_zones, zones_from_valleys
from backend.stages.pre_exposure import Preview


class ZonesParams(Params):
    """How the scene's gray levels are split."""

    valleys_gray: tuple[float, ...] | None = setting(
        None, title="Zone borders", unit="gray", auto="valleys_gray", min_length=2, max_length=12
    )
    """Both ends and each border between two zones, increasing. Automatic: fitted."""
    sigma_gray: float = setting(3.5, title="Histogram smoothing", unit="gray", ge=0, le=20)
    """Standard deviation of the Gaussian that smooths the histogram before the fit (8-bit scale)."""
    gap_gray: float = setting(8.0, title="Gap between groups", unit="gray", gt=0, le=64)
    """A larger step between gray levels that are kept starts a new zone (the paper's C)."""
    floor_share: float = setting(0.05, title="Floor above average", ge=0, le=0.5, advanced=True)
    """Levels are kept above average + this share of the maximum (equation 15)."""
    fit: Literal["gaussian", "polynomial"] = setting("gaussian", title="Curve", advanced=True)
    """Curve fitted to each group; its maximum is the zone's peak."""


@dataclass(frozen=True)
class ZoneRow:
    """One zone in the table."""

    zone: int
    peak_gray: float
    from_gray: float
    to_gray: float
    share: float


@dataclass(frozen=True)
class Zones:
    """The scene's zones, darkest first."""

    histogram: Annotated[
        Float[np.ndarray, "gray"],
        Histogram(
            "Gray levels",
            fit="curve",
            valleys="valleys_gray",
            peaks="peaks_gray",
            edits="valleys_gray",
        ),
    ]
    """Smoothed counts over 0..full scale."""
    curve: Annotated[Float[np.ndarray, "gray"], Curve("Fitted zones", x_title="gray")]
    peaks_gray: Float[np.ndarray, "zone"]
    valleys_gray: Float[np.ndarray, "valley"]
    """zones + 1 borders: first and last foreground gray at the ends."""
    table: Annotated[tuple[ZoneRow, ...], Table("Zones")]
    zone_count: Annotated[int, Value("Zones")]
    zone_names: tuple[str, ...]
    zone_map: Annotated[
        Mapping[str, UInt8[np.ndarray, "_h _w"]], Mask("Zone of each pixel", names="zone_names")
    ]
    """1 = darkest zone ..., 0 = background."""


def _zone_count(result: Zones, params: ZonesParams) -> Check:
    few = "one exposure serves the whole scene" if result.zone_count == 1 else ""
    level = Level.WARNING if result.zone_count > 5 else Level.OK
    sentence = f"{result.zone_count} zones fitted" + (f": {few}" if few else "")
    return Check("zones", level, sentence, float(result.zone_count), 5.0)


@stage(title="Zones", version=1, review=Review.ALWAYS, checks=(_zone_count,))
def zones(preview: Preview, params: ZonesParams) -> Zones:
    """Split the scene's gray levels into zones that one exposure each can serve."""
    scale = (preview.full_scale_gray + 1.0) / 256.0  # settings are in gray levels of 8 bit
    fitted = _fit(preview, params, scale)
    return Zones(
        histogram=fitted.histogram,
        curve=fitted.curve,
        peaks_gray=fitted.peaks_gray,
        valleys_gray=fitted.valleys_gray,
        table=tuple(_row(fitted, i) for i in range(len(fitted.peaks_gray))),
        zone_count=len(fitted.peaks_gray),
        zone_names=tuple(
            f"zone {i}: {low:.0f} to {high:.0f} gray"
            for i, (low, high) in enumerate(pairwise(fitted.valleys_gray), start=1)
        ),
        zone_map={
            name: zone_of_pixels(white, fitted.valleys_gray, preview.foreground[name])
            for name, white in preview.white.items()
        },
    )


def zone_of_pixels(
    white_gray: np.ndarray[tuple[int, ...], np.dtype[np.integer]],
    valleys_gray: Float[np.ndarray, "valley"],
    foreground: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
) -> UInt8[np.ndarray, "h w"]:
    """Label every foreground pixel with its zone, 1 = darkest; 0 = background.

    A zone is open below and closed above, V_(i-1) < I <= V_i, the lowest includes V_0: the strict
    inequalities of equation 16 would lose the pixels at a valley.
    """
    levels = np.arange(int(white_gray.max(initial=0)) + 1)
    inner = valleys_gray[1:-1]
    label = (np.searchsorted(inner, levels, side="left") + 1).astype(np.uint8)
    return np.where(foreground, label[white_gray], np.uint8(0)).astype(np.uint8)


def _fit(preview: Preview, params: ZonesParams, scale: float) -> ZoneFit:
    settings = ZoneSettings(
        sigma_gray=params.sigma_gray * scale,
        gap_gray=params.gap_gray * scale,
        floor_share=params.floor_share,
        fit=params.fit,
    )
    if params.valleys_gray is not None:
        borders = np.asarray(params.valleys_gray, dtype=np.float64)
        return zones_from_valleys(preview.histogram, borders, settings)
    return find_zones(preview.histogram, settings, black_gray=_black_gray(preview))


def _black_gray(preview: Preview) -> float:
    return min(preview.dark_gray.values(), default=0.0)


def _row(fitted: ZoneFit, i: int) -> ZoneRow:
    low, high = fitted.valleys_gray[i : i + 2]
    return ZoneRow(
        i + 1, float(fitted.peaks_gray[i]), float(low), float(high), float(fitted.shares[i])
    )
