"""Noise, from gray levels to phases and positions, and the bounds that no decoder can beat."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import erfc, pi, sqrt

import numpy as np
from jaxtyping import Float

from backend.numerics.errors import NumericsError

QUANTISATION_GRAY2 = 1 / 12
"""Variance of rounding to whole gray levels."""


@dataclass(frozen=True)
class NoiseModel:
    r"""Standard deviation of a gray level, after EMVA 1288.

    Notes
    -----
    :math:`\sigma_I^2 = \sigma_{read}^2 + (I - I_{black}) G + 1/12` in gray^2, with G gray levels per
    electron: read noise, photon noise, rounding.
    """

    read_gray: float
    """Standard deviation of a dark pixel in [gray], without rounding."""
    gray_per_e: float
    """Gray levels per electron, full scale over full well at gain 0 dB; 0: no photon noise."""
    black_gray: float = 0.0
    """Gray level of no light."""

    def __post_init__(self) -> None:
        """Refuse what isn't a noise.

        Raises
        ------
        NumericsError
            If a value is negative or not finite.
        """
        for name, value in (("read_gray", self.read_gray), ("gray_per_e", self.gray_per_e)):
            if not (np.isfinite(value) and value >= 0):
                raise NumericsError(f"{name} of the noise is {value}: give a finite number >= 0")

    @classmethod
    def of_camera(
        cls,
        *,
        read_noise_e: float,
        full_well_e: float,
        full_scale_gray: float,
        black_gray: float = 0.0,
        gain_db: float = 0.0,
    ) -> "NoiseModel":
        """Translate a camera's data sheet; gain multiplies both the read and the photon noise.

        Examples
        --------
        >>> NoiseModel.of_camera(read_noise_e=12, full_well_e=15300, full_scale_gray=255)
        NoiseModel(read_gray=0.2, gray_per_e=0.016666666666666666, black_gray=0.0)
        """
        if not full_well_e > 0:
            raise NumericsError(f"a full well of {full_well_e} electrons holds no light: give > 0")
        gray_per_e = full_scale_gray / full_well_e * 10 ** (gain_db / 20)
        return cls(read_noise_e * gray_per_e, gray_per_e, black_gray)

    @property
    def dark_variance_gray2(self) -> float:
        """Variance of a dark pixel, rounding included, in [gray^2]."""
        return self.read_gray**2 + QUANTISATION_GRAY2

    def sigma_gray(self, gray: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Predict the standard deviation of gray levels, in [gray]."""
        light = np.maximum(gray - self.black_gray, 0.0)
        sigma: Float[np.ndarray, "*shape"] = np.sqrt(
            self.dark_variance_gray2 + self.gray_per_e * light
        )
        return sigma


def phase_sigma_rad(sigma_gray: float, modulation_gray: float, n_steps: int) -> float:
    r"""Predict the noise of a phase from N evenly spaced steps, in [rad].

    Notes
    -----
    :math:`\sigma_\varphi = \sqrt{2/N} \, \sigma_I / B`, which is the Cramer-Rao bound [1]_. With
    photon noise :math:`\sigma_I` is that of the mean gray level for N >= 4.

    References
    ----------
    .. [1] C. Rathjen, "Statistical properties of phase-shift algorithms", Journal of the Optical
       Society of America A 12(9), 1997 (1995), doi:10.1364/JOSAA.12.001997.

    Examples
    --------
    >>> phase_sigma_rad(2.0, 100.0, 8)
    0.01
    """
    return sqrt(2 / n_steps) * sigma_gray / modulation_gray


def position_sigma(
    phase_sigmas_rad: Sequence[float], periods: Sequence[float], *, fuse: bool = True
) -> float:
    r"""Predict the noise of a position in [0, 1) whose fringe orders are right.

    Parameters
    ----------
    phase_sigmas_rad
        Noise of each frequency's phase in [rad].
    periods
        Periods over the width.
    fuse
        The position comes from all frequencies, weighted by periods^2; otherwise from the highest.

    Notes
    -----
    :math:`\sigma_x = \sqrt{\sum f_i^2 \sigma_i^2} / (2 \pi \sum f_i^2)`.

    Examples
    --------
    >>> round(position_sigma([0.1, 0.1, 0.1], [70, 64, 59]) / position_sigma([0.1], [70]), 3)
    0.627
    """
    frequencies = np.asarray(periods, dtype=np.float64)
    sigmas = np.asarray(phase_sigmas_rad, dtype=np.float64)
    if not fuse:
        highest = int(np.argmax(frequencies))
        return float(sigmas[highest] / (2 * pi * frequencies[highest]))
    square = float((frequencies**2).sum())
    return float(np.sqrt((frequencies**2 * sigmas**2).sum()) / (2 * pi * square))


def position_bound(
    *, sigma_gray: float, modulation_gray: float, n_steps: int, periods: Sequence[float]
) -> float:
    r"""Give the Cramer-Rao bound of a position in [0, 1) from N steps at each frequency.

    Notes
    -----
    :math:`\sigma_x \ge \sigma_I \sqrt{2/N} / (2 \pi B \sqrt{\sum f_i^2})`.

    Examples
    --------
    >>> bound = position_bound(sigma_gray=1.0, modulation_gray=50.0, n_steps=4, periods=[59, 64, 70])
    >>> round(1280 * bound, 4)
    0.0258
    """
    square = sum(value**2 for value in periods)
    return phase_sigma_rad(sigma_gray, modulation_gray, n_steps) / (2 * pi * sqrt(square))


def fused_phase_sigma_rad(phase_sigmas_rad: Sequence[float]) -> float:
    r"""Predict the noise of a phase fused from several exposures by inverse variance, in [rad].

    Notes
    -----
    :math:`1/\sigma^2 = \sum_j 1/\sigma_j^2`.

    Examples
    --------
    >>> round(fused_phase_sigma_rad([0.03, 0.04]), 6)
    0.024
    """
    return 1 / sqrt(sum(1 / value**2 for value in phase_sigmas_rad))


def cascade_failure_probability(phase_sigma_rad: float, stage_noise_gain: float) -> float:
    r"""Predict how often a chain of frequencies takes a wrong fringe order.

    Parameters
    ----------
    phase_sigma_rad
        Noise of each phase in [rad].
    stage_noise_gain
        Noise of the worst stage's decision over that of a phase, see `fringe_orders.stage_noise_gain`.

    Notes
    -----
    :math:`P = \mathrm{erfc}(\pi / (\sqrt 2 \, g \, \sigma_\varphi))`, exact for one stage.
    """
    return erfc(pi / (sqrt(2) * stage_noise_gain * phase_sigma_rad))


def lattice_failure_bound(
    phase_sigma_rad: float, distance_cycles: float, n_neighbours: int = 6
) -> float:
    r"""Bound how often maximum likelihood takes a wrong fringe order.

    Notes
    -----
    Union bound :math:`P \le n \, Q(\pi d / \sigma_\varphi)` over the n nearest lattice points at
    distance d in cycles; for (59, 64, 70) simulation finds 2.4 instead of 6.
    """
    return n_neighbours * 0.5 * erfc(pi * distance_cycles / phase_sigma_rad / sqrt(2))
