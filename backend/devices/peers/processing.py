"""What a camera does to its pictures before they leave it, as far as somebody switched it on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8, UInt16

Picture = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]

TEST_PATTERNS = {"Off": 0, "GreyHorizontalRamp": 1}


@dataclass(frozen=True)
class Processing:
    """SFNC's features of that kind."""

    test_pattern: int = 0
    """One of `TEST_PATTERNS`."""
    reverse_x: bool = False
    gamma: float = 1.0

    def of(self, picture: Picture, bits: int) -> Picture:
        """Process a picture."""
        if self.test_pattern:
            ramp = np.linspace(0, 2**bits - 1, picture.shape[1]).astype(picture.dtype)
            picture = np.tile(ramp, (picture.shape[0], 1))
        if self.gamma != 1.0:
            white = 2**bits - 1
            curve = np.round(white * (np.arange(white + 1) / white) ** self.gamma)
            picture = curve.astype(picture.dtype)[picture]
        return picture[:, ::-1] if self.reverse_x else picture
