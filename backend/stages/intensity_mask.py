"""The intensity mask: what the projector dims where the scene is bright. Made by some methods, read by captures."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from backend.domain.hints import Picture


@dataclass(frozen=True)
class IntensityMask:
    """Factor for every projector pixel that patterns are multiplied with."""

    factor: Annotated[Float[np.ndarray, "h w"], Picture("Intensity mask", low=0.0, high=1.0)]
    """float32 in [0, 1]; 1 leaves the pattern as it is."""
