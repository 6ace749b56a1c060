"""From a control value to a gray level: what screens and cameras do to a sinusoid on its way."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Integer, UInt8, UInt16

from backend.devices.errors import RigConfigError

FULL_WELL_E = 12_000.0
"""Electrons at full scale."""
READ_NOISE_E = 6.0
"""Standard deviation of a dark pixel, in electrons."""

Curve = Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]]
"""A monotone map of [0, 1] onto itself."""


def power_curve(exponent: float) -> Curve:
    """Return x**exponent: 2.2 for most displays, 1/2.2 for a camera that undoes it, 1 for neither."""
    return partial(_power, exponent)


def s_curve(steepness: float, exponent: float) -> Curve:
    """Return (x^s / (x^s + (1-x)^s))^exponent: how a bare LCD panel answers its voltage."""
    return partial(_sigmoid_then_power, steepness, exponent)


def film_curve(steepness: float, exponent: float) -> Curve:
    """Return v^s / (v^s + (1-v)^s) with v = x^exponent: a camera that imitates film."""
    return partial(_power_then_sigmoid, steepness, exponent)


def measured_curve(
    code_share: Float[np.ndarray, "n"], luminance_share: Float[np.ndarray, "n"]
) -> Curve:
    """Return the curve through measured points, straight between them.

    Parameters
    ----------
    code_share
        Display codes over 255, strictly increasing.
    luminance_share
        Luminance without the black level over that of white, never decreasing, within [0, 1].

    Raises
    ------
    RigConfigError
        If there are fewer than two points, or the table isn't monotone or leaves [0, 1].
    """
    x = np.asarray(code_share, np.float64)
    y = np.asarray(luminance_share, np.float64)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 2:
        raise RigConfigError(
            f"A display's table has {x.size} codes and {y.size} luminances; give two or more of both."
        )
    inside = np.isfinite([x, y]).all() and min(x[0], y.min()) >= 0 and max(x[-1], y.max()) <= 1
    if not (inside and (np.diff(x) > 0).all() and (np.diff(y) >= 0).all()):
        raise RigConfigError(
            "A display's table isn't monotone within 0 to 1; sort it by code and divide by white."
        )
    return partial(_between_points, x, y)


def _power(exponent: float, x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.asarray(x**exponent)


def _sigmoid(steepness: float, x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    up = x**steepness
    return np.asarray(up / (up + (1.0 - x) ** steepness))


def _sigmoid_then_power(
    steepness: float, exponent: float, x: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    return np.asarray(_sigmoid(steepness, x) ** exponent)


def _power_then_sigmoid(
    steepness: float, exponent: float, x: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    return _sigmoid(steepness, np.asarray(x**exponent))


def _between_points(
    known: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], x: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    return np.asarray(np.interp(x, known, values))


@dataclass(frozen=True)
class Chain:
    r"""A screen and a camera as one response, from control value to gray level.

    Notes
    -----
    Control :math:`Y \in [-1, 1]` becomes the code :math:`c = \mathrm{round}(127.5 (Y + 1))`, the code the
    luminance :math:`L = b + (1 - b)\, d(c / 255)` of a screen whose white is 1, luminance the charge
    :math:`N = 12000\, e\, L`, with shot noise and 6 electrons of read noise, and the charge, clipped at
    12000, the gray level :math:`\mathrm{round}(255\, t(N / 12000))`.
    """

    name: str
    display: Curve
    """Luminance over code, without the black level."""
    tone: Curve
    """Gray level over charge."""
    black: float
    """Luminance of code 0, as a share of white."""
    exposure: float
    """Charge of white over full scale; above 1 white is clipped."""

    def code(self, control: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
        """Return the display code of control values in [-1, 1]; values beyond end at 0 and 255."""
        share = np.clip(np.asarray(control, np.float64) + 1.0, 0.0, 2.0)
        return np.asarray(np.rint(127.5 * share), np.uint8)

    def luminance(self, code: Integer[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the luminance of codes 0..255, white being 1, in float64."""
        levels = np.arange(256) / 255.0
        table = self.black + (1.0 - self.black) * self.display(levels)
        return np.asarray(table[code])

    def gray(
        self,
        luminance: Float[np.ndarray, "..."],
        exposure_ratio: float = 1.0,
        rng: np.random.Generator | None = None,
        *,
        bits: int = 8,
        quantised: bool = True,
    ) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."] | Float[np.ndarray, "..."]:
        """Expose luminances once, each a pixel of its own.

        Parameters
        ----------
        luminance
            Of the screen as each pixel sees it, its white being 1.
        exposure_ratio
            Exposure over the chain's own.
        rng
            Where noise comes from; None: there is none.
        bits
            8 gives uint8; more, up to 16, gives uint16.
        quantised
            False returns float64 gray levels, not rounded: what an ideal converter would say.
        """
        charge_e = FULL_WELL_E * self.exposure * exposure_ratio * np.asarray(luminance, np.float64)
        if rng is not None:
            charge_e = rng.poisson(charge_e) + READ_NOISE_E * rng.standard_normal(charge_e.shape)
        full_scale = 2**bits - 1
        gray = full_scale * self.tone(np.clip(charge_e / FULL_WELL_E, 0.0, 1.0))
        if not quantised:
            return np.asarray(gray)
        return np.asarray(np.rint(gray), np.uint8 if bits == 8 else np.uint16)


LINEAR = power_curve(1.0)
GAMMA = power_curve(2.2)
INVERSE = power_curve(1.0 / 2.2)
FILM = film_curve(1.6, 1.0 / 2.2)
LCD = s_curve(1.35, 2.2)
MEASURED = measured_curve(
    np.linspace(0.0, 1.0, 18),
    np.array(
        [
            *(0.0, 0.0021, 0.0085, 0.0201, 0.0384, 0.0643, 0.0985, 0.1406, 0.1911),
            *(0.2507, 0.3176, 0.3942, 0.4782, 0.5741, 0.6786, 0.7912, 0.9025, 1.0),
        ]
    ),
)
"""Codes 0, 15 ... 255 of an office panel that leaves the power law near white, made up."""

DISPLAYS: Mapping[str, Curve] = MappingProxyType(
    {"linear": LINEAR, "gamma": GAMMA, "lcd": LCD, "measured": MEASURED}
)
"""Screens by name."""
TONES: Mapping[str, Curve] = MappingProxyType({"linear": LINEAR, "inverse": INVERSE, "film": FILM})
"""Cameras by name."""

CHAINS: Mapping[str, Chain] = MappingProxyType(
    {
        "A": Chain("A linear display, linear camera", LINEAR, LINEAR, 0.02, 0.95),
        "B": Chain("B display gamma 2.2, linear camera", GAMMA, LINEAR, 0.02, 0.95),
        "C": Chain("C display gamma 2.2, camera 1/2.2", GAMMA, INVERSE, 0.02, 0.95),
        "D": Chain("D display gamma 2.2, S-curve camera", GAMMA, FILM, 0.02, 0.90),
        "E": Chain("E S-curve LCD, camera 1/2.2", LCD, INVERSE, 0.02, 0.95),
        "F": Chain("F as D, clips above Y = 0.8", GAMMA, FILM, 0.012, 1.24),
        "G": Chain("G as B, clips above Y = 0.8", GAMMA, LINEAR, 0.02, 1.26),
    }
)
"""Chains by letter: A has nothing to correct, B to G are what deflectometry meets."""
