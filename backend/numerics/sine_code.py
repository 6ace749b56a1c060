"""The fringes of one direction: their frequencies and steps, in the order of the frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from backend.numerics.errors import FrequencyError

_SINGULAR = 1e-6
"""Steps whose design matrix is worse conditioned than its inverse don't determine a phase."""


@dataclass(frozen=True)
class SineCode:
    """Which sinusoids were projected, gray = A + B cos(2 pi periods x + shift), x in [0, 1).

    Frames come frequency by frequency in this order, and within a frequency step by step.
    """

    periods: tuple[float, ...]
    """Periods over the projected width, one value per frequency, > 0; need not be whole numbers."""
    shifts_rad: tuple[tuple[float, ...], ...]
    """Shift of each step in [rad], one tuple per frequency; a pattern's offset is part of it."""

    def __post_init__(self) -> None:
        """Refuse steps that don't determine a phase.

        Raises
        ------
        FrequencyError
            If there is no frequency, one isn't positive, or fewer than three shifts of one differ.
        """
        if not self.periods or len(self.periods) != len(self.shifts_rad):
            raise FrequencyError(
                f"{len(self.periods)} frequencies and {len(self.shifts_rad)} sets of steps were given: "
                "give at least one frequency and one set of steps for each"
            )
        for periods, shifts_rad in zip(self.periods, self.shifts_rad, strict=True):
            if not (np.isfinite(periods) and periods > 0):
                raise FrequencyError(
                    f"a frequency of {periods} periods can't be decoded: give a number > 0"
                )
            step_fit(shifts_rad, name=f"{periods:g} periods")

    @classmethod
    def equal_steps(
        cls, periods: Sequence[float], n_steps: int, *, direction: int = 1
    ) -> "SineCode":
        """Make a code of steps evenly spread over one period.

        Parameters
        ----------
        periods
            Periods over the projected width of each frequency.
        n_steps
            Steps per frequency, >= 3.
        direction
            +1 for shifts 0, +2 pi/n, ...; -1 where the fringes move the other way.

        Examples
        --------
        >>> code = SineCode.equal_steps((59, 64, 70), 4)
        >>> code.n_frames, round(code.shifts_rad[0][1], 4)
        (12, 1.5708)
        """
        shifts_rad = tuple(direction * 2 * np.pi * step / n_steps for step in range(n_steps))
        return cls(tuple(float(value) for value in periods), (shifts_rad,) * len(periods))

    @property
    def n_frames(self) -> int:
        """Number of frames that one exposure needs."""
        return sum(len(shifts_rad) for shifts_rad in self.shifts_rad)

    @property
    def noise_gains(self) -> tuple[float, ...]:
        """Variance of the phase over (sigma_I / B)^2, one value per frequency: 2/N for even steps."""
        return _noise_gains(self.shifts_rad)


@lru_cache(maxsize=64)
def _noise_gains(shifts_rad: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
    return tuple(step_fit(of_one).noise_gain for of_one in shifts_rad)


class StepFit(NamedTuple):
    """Least-squares fit of a sinusoid to N known shifts, as three weights per frame."""

    weights: Float64[np.ndarray, "3 n"]
    """Rows: B cos(phi), B sin(phi) and the mean A as weighted sums of the frames."""
    noise_gain: float
    """Variance of the phase over (sigma_I / B)^2, averaged over all phases."""


def step_fit(
    shifts_rad: Sequence[float] | Float64[np.ndarray, "n"], *, name: str = "a frequency"
) -> StepFit:
    r"""Weigh frames of known shifts so that they give a sinusoid's phasor and mean.

    Parameters
    ----------
    shifts_rad
        Shift of each frame in [rad], in any order, not necessarily evenly spaced.
    name
        What the error message calls this set of steps.

    Returns
    -------
    StepFit
        Weights as float64.

    Raises
    ------
    FrequencyError
        If fewer than three shifts differ modulo 2 pi.

    Notes
    -----
    With :math:`c = B \cos\varphi`, :math:`s = B \sin\varphi` the model
    :math:`I_k = A + B \cos(\varphi + \delta_k) = A + c \cos\delta_k - s \sin\delta_k` is linear.
    White noise of :math:`\sigma` on the frames gives the covariance
    :math:`\sigma^2 (M^T M)^{-1}`; its mean over the directions of the phasor is half the trace of
    the block of c and s, exactly :math:`2/N` for evenly spaced shifts.

    Examples
    --------
    >>> fit = step_fit([0.0, np.pi / 2, np.pi, 3 * np.pi / 2])
    >>> np.round(fit.weights[0], 3) + 0.0
    array([ 0.5,  0. , -0.5,  0. ])
    >>> round(fit.noise_gain, 6)
    0.5
    """
    shifts = np.asarray(shifts_rad, dtype=np.float64)
    design = np.stack([np.cos(shifts), -np.sin(shifts), np.ones_like(shifts)], axis=1)
    usable = shifts.size >= 3 and bool(np.all(np.isfinite(shifts)))
    spread = np.linalg.svd(design, compute_uv=False) if usable else np.zeros(3)
    if spread[-1] < _SINGULAR * max(spread[0], 1.0):
        degrees = ", ".join(f"{np.rad2deg(value):g}" for value in shifts)
        raise FrequencyError(
            f"the steps of {name} are at ({degrees}) degrees: "
            "give at least three that differ modulo 360 degrees"
        )
    weights = np.linalg.pinv(design)
    return StepFit(weights=weights, noise_gain=float((weights[:2] ** 2).sum() / 2))
