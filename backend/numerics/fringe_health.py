"""What fringes say of themselves: whether a ramp belongs to them, and which frame among them is defective."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64, Real

from backend.numerics.errors import FrameError
from backend.numerics.linearisation import quoted_error

COSINES = 33
"""Cosines over [-1, 1] at which the gray level is learned."""

ALIKE_SHARE = 0.05
"""Pixels whose brightness and modulation are within this of the typical ones share one response."""

FEWEST_PIXELS = 200
"""Fewer pixels don't tell a response."""

MOST_PIXELS = 60_000
"""More pixels than this don't make a better verdict: every n-th is looked at."""

SUSPECT_FACTOR = 1.8
"""A set whose closure is so many times the median of all sets is looked at frame by frame ..."""

SUSPECT_FLOOR = 0.015
"""... if it is above this, too: 0.01 is what good linear frames have."""

BELONGS_PERCENT = 2.5
"""A ramp that belongs to the fringes makes them straight to some 1 %."""


class LearnedResponse(NamedTuple):
    """Gray level over the cosine of the fringe's phase, as the fringes themselves show it."""

    cosine: Float64[np.ndarray, "point"]
    """Increasing, within [-1, 1]."""
    gray: Float64[np.ndarray, "point"]
    """Median of the samples around each cosine."""


class RampVerdict(NamedTuple):
    """How straight fringes become when they are read through a table, beside their raw gray levels."""

    table_error_percent: float
    """Largest quoted error of the table's values over the cosine; NaN if the table doesn't cover the fringes."""
    raw_error_percent: float
    """The same of the gray levels themselves."""
    learned: LearnedResponse

    @property
    def belongs(self) -> bool:
        """True if the table makes the fringes straight to 2.5 %."""
        return bool(self.table_error_percent <= BELONGS_PERCENT)  # NaN: no


class DefectiveFrame(NamedTuple):
    """The frame of a set that fits the others least."""

    step: int
    departure: float
    """Rms distance of that frame from what the others predict, over the modulation."""
    residual_without: Float64[np.ndarray, "step"]
    """Rms residual of the set without each of its frames, over the modulation: smallest without the defective one."""

    @property
    def clear(self) -> bool:
        """True if the set fits without it, at most 60 % of the residual that leaving out any other one leaves."""
        rest = np.delete(self.residual_without, self.step)
        return bool(self.residual_without[self.step] < 0.6 * rest.min())


def learn_response(
    frames_gray: Real[np.ndarray, "step pixel"],
    phase_rad: Float[np.ndarray, "pixel"],
    *,
    shifts_rad: Float[np.ndarray, "step"] | None = None,
) -> LearnedResponse:
    r"""Learn G over cos(phase) from fringes whose phase is known otherwise.

    Parameters
    ----------
    frames_gray
        Raw gray levels of one set: one row per phase step, one column per valid pixel.
    phase_rad
        Phase of the set's pattern at each pixel, G = A + B cos(phase + shift), from the *other* periods' position:
        the set's own phase has the error that is to be found. NaN: not used.
    shifts_rad
        Shift of each step; None: equal steps 2 pi n / N. Frames that count the other way round give them negative.

    Raises
    ------
    FrameError
        If there are fewer than 200 pixels with a phase, or phases that don't cover the fringe.

    Notes
    -----
    Pixels differ in brightness (reflectance, vignetting) and modulation (blur); one curve holds for those within 5 %
    of the typical ones, which are the ones used (twice as many per cent until 200 are found).
    """
    steps = len(frames_gray)
    shifts = 2 * np.pi * np.arange(steps) / steps if shifts_rad is None else shifts_rad
    frames, phase = _thinned(frames_gray, phase_rad)
    known = np.isfinite(phase)
    if known.sum() < FEWEST_PIXELS:
        raise FrameError(
            f"{int(known.sum())} pixels with a phase don't tell how gray levels answer: {FEWEST_PIXELS} are needed"
        )
    frames, phase = frames[:, known], phase[known]
    cosine = np.cos(phase + shifts[:, None])
    alike = _alike(frames, cosine)
    return _binned(cosine[:, alike].ravel(), frames[:, alike].ravel())


def judge_ramp(learned: LearnedResponse, values: Float[np.ndarray, "level"]) -> RampVerdict:
    """Read learned fringes through a table and say how straight they become.

    Parameters
    ----------
    learned
        From `learn_response`.
    values
        What the ramp makes of every gray level (`Linear.values`, or an inverted ramp), NaN where it says nothing.
    """
    levels = np.arange(len(values), dtype=np.float64)
    read = np.interp(learned.gray, levels, values)
    inside = np.isfinite(read)
    table = float("nan")
    if inside.mean() > 0.9:
        table = float(np.abs(quoted_error(read[inside], learned.cosine[inside])).max())
    raw = float(np.abs(quoted_error(learned.gray, learned.cosine)).max())
    return RampVerdict(table, raw, learned)


def closures(values: Real[np.ndarray, "set step pixel"]) -> Float64[np.ndarray, "set"]:
    r"""Return how much each set of equal phase steps departs from sinusoids, over its modulation.

    Parameters
    ----------
    values
        *Linearised* fringes of valid pixels: a gamma of 2.2 alone gives 0.1 to 0.2. NaN samples are passed over.

    Returns
    -------
    closures
        Rms over pixels and steps of what the best sinusoid of each pixel leaves, over the rms modulation; NaN for
        three steps, which always fit.

    Notes
    -----
    For four steps it is the rms of :math:`(I_0 - I_1 + I_2 - I_3)/4` over the modulation.

    Examples
    --------
    >>> set_of_four = np.array([[[3.0], [2.0], [1.0], [2.4]]])
    >>> closures(set_of_four).round(3).tolist()
    [0.098]
    """
    steps = values.shape[1]
    if steps < 4:
        return np.full(len(values), np.nan)
    angle = 2 * np.pi * np.arange(steps) / steps
    design = np.stack([np.ones(steps), np.cos(angle), np.sin(angle)], axis=1)
    found = np.empty(len(values))
    stride = 1 + values.shape[2] // MOST_PIXELS
    for i, one in enumerate(values):
        samples = np.asarray(one[:, ::stride], np.float64)
        samples = samples[:, np.isfinite(samples).all(axis=0)]
        fitted = np.linalg.pinv(design) @ samples
        residual = samples - design @ fitted
        modulation = float(np.mean(fitted[1] ** 2 + fitted[2] ** 2))
        found[i] = np.sqrt(np.mean(residual**2) / max(modulation, 1e-30))
    return found


def suspect_sets(closure: Float[np.ndarray, "set"]) -> Int64[np.ndarray, "suspect"]:
    """Return the indices of sets whose closure is far above that of their neighbours.

    Far above: more than 1.8 times the median of all sets, and more than 0.015. Blur lowers the modulation of fine
    fringes and so raises their closure, too: `name_defective_frame` tells the two apart.
    """
    if not np.isfinite(closure).any():
        return np.empty(0, np.int64)
    limit = max(SUSPECT_FLOOR, SUSPECT_FACTOR * float(np.nanmedian(closure)))
    return np.flatnonzero(closure > limit).astype(np.int64)


def name_defective_frame(
    values: Real[np.ndarray, "step pixel"],
    phase_rad: Float[np.ndarray, "pixel"],
    *,
    shifts_rad: Float[np.ndarray, "step"] | None = None,
) -> DefectiveFrame:
    """Find the frame of a set that doesn't fit the other ones, by the phase that other periods predict.

    Parameters
    ----------
    values
        Linearised fringes of one set, at least four steps, one column per valid pixel.
    phase_rad
        Phase of this set at each pixel from the position that the *other* periods tell; NaN: not used.
    shifts_rad
        Shift of each step; None: equal steps 2 pi n / N.

    Raises
    ------
    FrameError
        If there are fewer than four steps, or 200 pixels with a phase.

    Notes
    -----
    With the phase known, offset and modulation of a pixel are two unknowns of N samples. They are fitted without
    each frame in turn; the residual is smallest without the defective one.
    """
    steps = len(values)
    if steps < 4:
        raise FrameError(
            f"a set of {steps} frames can't name a defective one: at least four are needed"
        )
    shifts = 2 * np.pi * np.arange(steps) / steps if shifts_rad is None else shifts_rad
    samples, phase = _thinned(values, phase_rad)
    known = np.isfinite(phase) & np.isfinite(samples).all(axis=0)
    if known.sum() < FEWEST_PIXELS:
        raise FrameError(
            f"{int(known.sum())} pixels with a predicted phase don't name a defective frame: {FEWEST_PIXELS} are needed"
        )
    samples, cosine = samples[:, known], np.cos(phase[known] + shifts[:, None])
    residual, departure = np.empty(steps), np.empty(steps)
    for step in range(steps):
        residual[step], departure[step] = _without(step, samples, cosine)
    defective = int(np.argmin(residual))
    return DefectiveFrame(defective, float(departure[defective]), residual)


def _without(
    step: int, samples: Float64[np.ndarray, "step pixel"], cosine: Float64[np.ndarray, "step pixel"]
) -> tuple[float, float]:
    """Fit a + b cos to all frames but one; return the residual of the others and the distance of that one."""
    others = np.delete(np.arange(len(samples)), step)
    value, wave = samples[others], cosine[others]
    centred = wave - wave.mean(axis=0)
    amplitude = (centred * value).sum(axis=0) / np.maximum((centred**2).sum(axis=0), 1e-9)
    offset = value.mean(axis=0) - amplitude * wave.mean(axis=0)
    # Pixels at which the others all have the same cosine can't tell the amplitude.
    telling = (centred**2).sum(axis=0) > 0.25
    size = float(np.sqrt(np.mean(amplitude[telling] ** 2)))
    left = (value - offset - amplitude * wave)[:, telling]
    own = (samples[step] - offset - amplitude * cosine[step])[telling]
    return float(np.sqrt(np.mean(left**2)) / size), float(np.sqrt(np.mean(own**2)) / size)


def _thinned(
    frames: Real[np.ndarray, "step pixel"], phase_rad: Float[np.ndarray, "pixel"]
) -> tuple[Float64[np.ndarray, "step some"], Float64[np.ndarray, "some"]]:
    stride = 1 + phase_rad.size // MOST_PIXELS
    return frames[:, ::stride].astype(np.float64), phase_rad[::stride].astype(np.float64)


def _alike(
    frames: Float64[np.ndarray, "step pixel"], cosine: Float64[np.ndarray, "step pixel"]
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Choose pixels of typical brightness and modulation."""
    brightness = frames.mean(axis=0)
    centred = cosine - cosine.mean(axis=0)
    modulation = (centred * frames).sum(axis=0) / np.maximum((centred**2).sum(axis=0), 1e-9)
    share = ALIKE_SHARE
    while share < 1.0:
        alike = np.abs(brightness / np.median(brightness) - 1) < share
        alike &= np.abs(modulation / np.median(modulation) - 1) < share
        if alike.sum() >= FEWEST_PIXELS:
            return np.asarray(alike)
        share *= 2
    return np.ones(brightness.shape, np.bool_)


def _binned(
    cosine: Float64[np.ndarray, "sample"], gray: Float64[np.ndarray, "sample"]
) -> LearnedResponse:
    edges = np.linspace(-1.0, 1.0, COSINES + 1)
    order = np.argsort(cosine, kind="stable")
    borders = np.searchsorted(cosine[order], edges)
    borders[-1] = cosine.size
    bins = [order[a:b] for a, b in pairwise(borders) if b - a >= 8]
    if len(bins) < COSINES // 2:
        raise FrameError(
            f"the fringes' phases cover {len(bins)} of {COSINES} parts of the fringe: more pixels or other periods are "
            f"needed to learn how gray levels answer"
        )
    return LearnedResponse(
        np.array([float(cosine[b].mean()) for b in bins]),
        np.array([float(gray[b].mean()) for b in bins]),
    )
