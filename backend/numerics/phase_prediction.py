"""How large the phase error of fringes will be, from what is known of screen and camera before they are shown."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from backend.numerics.screen_ramp import gray_of_control

PHASES = 512
"""Phases over one period at which errors are predicted."""

DRAWS = 48
"""Noisy fringes per phase: the mean of |error| is then known to about 0.5 %."""

_SEED = 20231121
"""Predictions have to be the same every time: results are known by their content."""

_ROUNDING_VARIANCE = 1.0 / 12.0


class ScreenResponse(NamedTuple):
    """Mean and noise of the gray level at every control value measured."""

    control: Float[np.ndarray, "point"]
    """Increasing, in [-1, 1]."""
    gray: Float[np.ndarray, "point"]
    noise_gray: Float[np.ndarray, "point"]
    """Standard deviation of one sample, rounding included."""
    full_scale_gray: float


class Fringes(NamedTuple):
    """How fringes are shown and read."""

    values: Float[np.ndarray, "level"]
    """What every gray level is replaced by; NaN where it can't be trusted."""
    control_low: float
    control_high: float
    codes: Float[np.ndarray, "control"] | None = None
    """Display codes of equidistant control values from -1 to 1; None: code = 127.5 (Y + 1)."""


class PhaseError(NamedTuple):
    """Mean |phase error| over all phases, in [rad]; NaN if no phase comes out."""

    all_rad: float
    """Shape and noise together."""
    shape_rad: float
    """Without noise and rounding."""
    noise_rad: float
    """What noise and rounding alone give: the mean distance from each phase's mean."""


def shown_codes(
    phase_rad: Float[np.ndarray, "*shape"], fringes: Fringes
) -> Float64[np.ndarray, "*shape"]:
    """Return the display code of each phase, rounded as the display does."""
    cosine = np.cos(phase_rad)
    control = fringes.control_high * (1 + cosine) / 2 + fringes.control_low * (1 - cosine) / 2
    codes = 127.5 * (control + 1.0)
    if fringes.codes is not None:
        codes = np.interp(control, np.linspace(-1.0, 1.0, len(fringes.codes)), fringes.codes)
    return np.asarray(np.rint(codes), np.float64)


def stepped_phase(
    values: Float[np.ndarray, "... step"],
) -> Float64[np.ndarray, "..."]:
    """Return the phase of N values at equal steps 2 pi n / N, in (-pi, pi]; NaN where a value is."""
    steps = values.shape[-1]
    turn = np.exp(-2j * np.pi * np.arange(steps) / steps)
    return np.asarray(np.angle(values @ turn), np.float64)


def predict_phase_error(response: ScreenResponse, fringes: Fringes, *, steps: int) -> PhaseError:
    """Predict the error of an N-step phase over all phases.

    Parameters
    ----------
    response
        The ramp with its noise.
    fringes
        How they are shown and read.
    steps
        Phase steps per period, at least 3.

    Notes
    -----
    Fringes are made through the ramp, with normal noise of the measured size at each gray level, rounded, read
    through the table: 512 phases, 48 times each, with the same random numbers every time.
    """
    phase_rad = 2 * np.pi * (np.arange(PHASES) + 0.5) / PHASES
    shifts = 2 * np.pi * np.arange(steps) / steps
    codes = shown_codes(phase_rad[:, None] + shifts, fringes)
    gray = gray_of_control(response.control, response.gray, codes / 127.5 - 1.0)
    levels = np.arange(len(fringes.values), dtype=np.float64)
    clean = stepped_phase(np.interp(gray, levels, fringes.values))
    noisy = stepped_phase(fringes.values[_noisy(gray, response)])
    shape = _wrapped(clean - phase_rad)
    errors = _wrapped(noisy - phase_rad)
    if not np.isfinite(errors).any():
        return PhaseError(np.nan, np.nan, np.nan)
    spread = _wrapped(errors - np.nanmean(errors, axis=0))
    return PhaseError(
        float(np.nanmean(np.abs(errors))),
        float(np.nanmean(np.abs(shape))),
        float(np.nanmean(np.abs(spread))),
    )


def _noisy(
    gray: Float[np.ndarray, "phase step"], response: ScreenResponse
) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    variance = np.maximum(response.noise_gray**2 - _ROUNDING_VARIANCE, 0.0)
    rising = np.maximum.accumulate(response.gray)
    sigma = np.interp(gray, rising, np.sqrt(variance))
    draws = np.random.default_rng(_SEED).standard_normal((DRAWS, *gray.shape))
    sampled = np.clip(np.rint(gray + sigma * draws), 0, response.full_scale_gray)
    return np.asarray(sampled, np.intp)


def _wrapped(angle_rad: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    return np.asarray((angle_rad + np.pi) % (2 * np.pi) - np.pi, np.float64)
