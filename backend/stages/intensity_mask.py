"""The intensity mask: what the projector dims where the scene is bright. Made by some methods, read by captures."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Integer, UInt8

from backend.domain.hints import Mask, Picture, Table, Value
from backend.numerics.unqualified import LABELS


@dataclass(frozen=True)
class MaskRound:
    """What one mask left unqualified: shares of the lit pixels, in all and by how bright a pixel responds."""

    mask: str
    over_exposed_share: float
    under_exposed_share: float
    dark_share: float
    """Unqualified among pixels that can take full light."""
    middle_share: float
    """Among those that need dimming, to a tenth at most."""
    bright_share: float
    """Among those that need more dimming than that."""
    frames: int
    """Pictures per camera that it took."""

    @property
    def unqualified_share(self) -> float:
        """Over- or under-exposed."""
        return self.over_exposed_share + self.under_exposed_share


@dataclass(frozen=True)
class IntensityMask:
    """Factor for every projector pixel that patterns are multiplied with."""

    factor: Annotated[
        Float[np.ndarray, "h w"], Picture("Intensity mask", low=0.0, high=1.0, edits="paint")
    ]
    """float32 in [0, 1], of the light; 1 leaves the pattern as it is."""
    round: Annotated[int, Value("Refinements")] = 0
    unqualified_share: Annotated[float, Value("Unqualified under this mask")] = float("nan")
    """Over- or under-exposed lit pixels; NaN: not measured yet."""
    rounds: Annotated[tuple[MaskRound, ...], Table("Unqualified share of each mask")] = ()
    white: Annotated[
        Mapping[str, Integer[np.ndarray, "_h _w"]],
        Picture("White field under the mask", unit="gray"),
    ] = field(default_factory=dict)
    """Empty before the mask was tried."""
    unqualified: Annotated[
        Mapping[str, UInt8[np.ndarray, "_h _w"]], Mask("Unqualified", dict(LABELS))
    ] = field(default_factory=dict)
    proper: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Light that a pixel can take", low=0.0, high=1.0, colormap="viridis"),
    ] = field(default_factory=dict)
    """Share of full light; 1 where even full light doesn't bring the target."""
    projector_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Projector column", unit="px", colormap="turbo"),
    ] = field(default_factory=dict)
    """Where a camera pixel looks in the projector, to a pixel; NaN where that isn't known."""
    projector_row_px: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Projector row", unit="px", colormap="turbo"),
    ] = field(default_factory=dict)
    known_share: Annotated[float, Value("Lit pixels whose place is known")] = float("nan")
    dilation_px: Annotated[float, Value("Dark regions widened by", unit="px")] = float("nan")
    mean_factor: Annotated[float, Value("Mean factor")] = float("nan")
