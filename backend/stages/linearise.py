"""Choose the quantity that fringes are read in: the one that answers to the control value along a line."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from backend.domain.hints import Curve, Table, Value

Representation = Literal["raw_full", "raw", "log_plain", "log", "inverse", "predistorted"]
"""raw_full: gray levels, fringes over all control values. The others use the interval's control values and read
raw: gray levels; log_plain: ln E of equation 9; log: ln E of equations 10-13; inverse: the control value
looked up in the ramp; predistorted: gray levels of fringes that were bent the other way round."""


@dataclass(frozen=True)
class PredictedError:
    """What one representation is predicted to give."""

    representation: str
    error_mrad: float
    """Mean |phase error| over all phases: shape and noise together."""
    systematic_mrad: float
    """The same without noise: what the shape of the response leaves."""
    noise_mrad: float
    quoted_error_percent: float
    """Largest departure from the straight line over the range that the fringes use."""
    control_low: float
    control_high: float


@dataclass(frozen=True)
class Linear:
    """How gray levels of the fringes are read, and between which control values fringes are shown."""

    representation: Annotated[str, Value("Fringes are read as")]
    reason: Annotated[str, Value("Why")]
    steps: Annotated[int, Value("Phase steps")]
    values: Annotated[
        Float[np.ndarray, "level"], Curve("Linear value of each gray level", x_title="gray")
    ]
    """Fringes replace every gray level by this; NaN where a gray level can't be trusted."""
    gray_low: float
    gray_high: float
    """Gray levels between which the fringes lie."""
    control_low: Annotated[float, Value("Darkest control value")]
    control_high: Annotated[float, Value("Brightest control value")]
    """Fringes are shown as Y = control_high (1 + cos)/2 + control_low (1 - cos)/2, control values in [-1, 1]."""
    exposure_ms: Annotated[float | None, Value("Exposure of the fringes", unit="ms")]
    """Exposure for which `values` hold; None: an imported ramp that doesn't tell."""
    codes: Annotated[
        Float[np.ndarray, "control"] | None, Curve("Display code, pre-distorted", unit="code")
    ] = None
    """Display code in [0, 255] for equidistant control values from -1 to 1; None: code = 127.5 (Y + 1)."""
    predicted_mrad: Annotated[float, Value("Predicted phase error", unit="mrad")] = float("nan")
    predicted: Annotated[tuple[PredictedError, ...], Table("Predicted phase error")] = ()
