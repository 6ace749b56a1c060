"""The point cloud, whatever method made it: one point per pixel of the reference camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from backend.domain.checks import Check, at_least, at_most
from backend.domain.hints import Mask, Picture, Points, Scalar, Table, Value
from backend.domain.params import Params
from backend.numerics.reasons import SENTENCES

REASON_LABELS = {int(reason): sentence for reason, sentence in SENTENCES.items()}
"""What each bit of a reasons map means, for the legend."""

NO_COLOUR = 180
"""Gray of points whose brightness isn't known."""


@dataclass(frozen=True)
class FilterRow:
    """What one filter removed."""

    filter: str
    removed: int


@dataclass(frozen=True)
class Cloud:
    """Points with their uncertainty, in the reference camera's frame."""

    points_mm: Annotated[
        Float32[np.ndarray, "n 3"],
        Points(
            "Point cloud",
            normals="normals",
            colour="colour",
            scalars=("sigma_mm", "exposure_index"),
        ),
    ]
    """x right, y down, z forward; in the order of the reference camera's pixels, row by row."""
    normals: Float32[np.ndarray, "n 3"]
    """Unit length, towards the camera; 0 where the neighbourhood is too small."""
    colour: UInt8[np.ndarray, "n 3"]
    sigma_mm: Annotated[Float32[np.ndarray, "n"], Scalar("Uncertainty", unit="mm")]
    """Predicted standard deviation along the pixel's ray."""
    pixel_x: Float32[np.ndarray, "n"]
    """Pixel of the reference camera; whole numbers where a point is one pixel."""
    pixel_y: Float32[np.ndarray, "n"]
    exposure_index: Annotated[UInt8[np.ndarray, "n"], Scalar("Exposure used")]
    """0 = shortest; 255 = not known."""
    depth_mm: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]], Picture("Depth", unit="mm", colormap="turbo")
    ]
    """z of the reference camera's pixels; NaN where there is no point."""
    reasons: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]], Mask("Missing because", REASON_LABELS, bits=True)
    ]
    removed: Annotated[tuple[FilterRow, ...], Table("Removed by filters")]
    point_count: Annotated[int, Value("Points")]
    median_sigma_mm: Annotated[float, Value("Uncertainty, median", unit="mm")]
    kept_share: Annotated[float, Value("Decoded pixels that became points")]
    consistency_px: float = float("nan")
    """Contradiction with the projector that was allowed, in [px]; NaN if it wasn't checked."""
    residual_max_cycles: float = float("inf")
    """Disagreement of the frequencies that was allowed, in [cycles]; infinite if it wasn't judged."""
    speck_px: int = 0
    """Smallest patch of connected pixels that was kept."""
    epipolar_sigma_px: Annotated[
        float, Value("Row against epipolar line, robust spread", unit="px")
    ] = float("nan")
    """How well the projector's rows as read agree with the calibration; NaN without a row code."""
    cameras: tuple[str, ...] = ()
    """The cameras that the points were made from, the reference first."""


def enough_points(result: Cloud, params: Params) -> Check:
    """Warn about a thin cloud, fail on an empty one."""
    return at_least(
        "points", result.point_count, warning=1000, failure=1,
        sentence=f"{result.point_count:,} points".replace(",", " "),
        remedy="look at why pixels are missing, then loosen that limit or change the exposures",
    )  # fmt: skip


def precise_enough(result: Cloud, params: Params) -> Check:
    """Warn when the predicted uncertainty is large."""
    sigma = result.median_sigma_mm if np.isfinite(result.median_sigma_mm) else 0.0
    return at_most(
        "uncertainty", sigma, warning=0.2, failure=1e9, unit="mm",
        sentence=f"half of the points are better than {sigma:.3f} mm",
    )  # fmt: skip


def colour_of(brightness: Float32[np.ndarray, "m"], count: int) -> UInt8[np.ndarray, "n 3"]:
    """Turn the points' brightness into gray colours; all alike if it isn't known (no value at all).

    A square root over a percentile range: black and bright parts stay visible side by side.
    """
    if brightness.size == 0:
        return np.full((count, 3), NO_COLOUR, np.uint8)
    top = float(np.percentile(brightness[:: max(1, count // 100_000)], 99))
    gray = np.sqrt(np.clip(brightness / np.float32(max(top, 1e-9)), 0.0, 1.0)) * np.float32(255.0)
    return np.repeat(gray.astype(np.uint8)[:, None], 3, axis=1)
