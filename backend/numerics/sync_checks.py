r"""Whether frames show what they were taken for: residuals of sets that belong together, blind to noise.

A frame that is late, torn or of another pattern differs from the right one by a *picture*: neighbouring pixels deviate
alike. Noise doesn't. So every deviation here is measured as a covariance of neighbours, whose expectation is free of the
noise, whatever the camera's; and it is compared with the light that the set moves, of which it is a share.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Integer

MOST_ROW_PAIRS = 96
"""So many pairs of rows are looked at: more make the verdict no surer."""
BANDS = 8
"""Parts of the picture that are judged by themselves, from top to bottom: a torn frame is wrong in some of them."""
_LEAST_PIXELS = 200
_LEAST_VALID = 0.2
"""Share of the picture below which the rest isn't judged: what little isn't saturated sees what spills over."""
_LEAST_SHARE = 0.02
"""A band with less than this share of the light isn't judged."""
_LEAST_MODULATION = 1.5 / 255
"""Of full scale: darker fringes drown in rounding."""
_ROUNDING = 1 / 12
"""Variance of a rounded gray level in [gray^2]; where hardly any noise hides its steps, neighbours have it in common."""
_UNSURE = 0.04
"""What chance and rounding may make of the square of a share: a display that is one pattern late makes 0.06."""
_SURE = 2e-3
"""What chance may add to the square of a share."""
_HARMONICS = (2, 3)
"""What a bent response adds to a sinusoid; it isn't the display that is late then."""
_MOST_BENT = 0.8
"""Of the fundamental: a gamma of 3 makes 0.5. What one lit frame among dark ones makes is 1 or more, and no response does
that. Of four steps it makes 0.5, and clipped light more: there it doesn't tell."""
_DRIFT_SIGMA = 0.003
"""Standard deviation up to which a drift counts as known."""
_REPEATED = 0.25
"""Two frames that differ by less than this share of what they should show the same."""
_EVEN = 0.7
"""A deviation that is correlated with the light by so much is brighter (or darker) everywhere: no other pattern is."""
_GRAYS_LIKELY = (48.0, 232.0)
"""Between these codes every display is brighter for a higher code; some cut off what is beyond."""
_LEAST_STEP = 0.05
"""Share of a linear display's step that is left of it between those codes where its gamma is 3."""
_LEAST_MOVED = 0.06
"""Light, as a share of full scale, below which whole gray levels are too coarse to tell a movement."""
_SURE_SHIFT_PX = 0.1
"""Standard error up to which a movement counts as known."""

Gray = Integer[np.ndarray, "h w"]
Sample = Float32[np.ndarray, "pair 2 w"]
Valid = Bool[np.ndarray, "pair 2 w"]


@dataclass(frozen=True)
class Finding:
    """What a set of frames says of itself, for one camera."""

    share: float
    """Largest deviation of a frame, of the whole picture or a band, as a share of the light that the set moves."""
    frame: int | None = None
    """The frame that deviates most; None where the set doesn't tell which."""
    repeats: bool = False
    """Whether that frame shows what was shown before."""
    even: bool = False
    """Whether it is brighter or darker everywhere: as when a lamp is switched, not as when a pattern is late."""


class FrameSample:
    """The rows of a picture that are looked at."""

    def __init__(self, gray: Gray, *, full_scale_gray: float) -> None:
        height_px = gray.shape[0]
        count = min(height_px // 2, MOST_ROW_PAIRS)
        first = (np.arange(count) * (height_px // 2) // max(count, 1)) * 2
        rows = np.stack([first, first + 1], axis=1)
        self.gray: Sample = gray[rows].astype(np.float32)
        self.full_scale_gray = full_scale_gray
        self.valid: Valid = ~_spoilt(gray, full_scale_gray)[rows]


def step_set(
    frames: Sequence[FrameSample],
    shifts_rad: Float[np.ndarray, "n"],
    before: Sequence[FrameSample | None] = (),
) -> Finding | None:
    r"""Judge four or more phase steps by what a sinusoid leaves of each frame; None where too little light moves.

    Parameters
    ----------
    frames
        One per step, in the order in which they were taken.
    shifts_rad
        Phase shift of each, in [rad].
    before
        What was exposed right before each frame, to tell a repeated picture; a marker may lie between two steps.

    Notes
    -----
    The residual of the least-squares fit of :math:`A + B \cos(\varphi + \delta_k)` is a picture too if a display or a
    camera bends the sinusoid. Then it is a function of the phase, the same one all over the picture:
    :math:`\sum_h c_h B \cos h(\varphi + \delta_k)`. That part is fitted and taken off before what is left counts.
    """
    projector, solve = _design(shifts_rad)
    if len(frames) < 4 or projector is None:
        return None
    valid = _all_valid(frames)
    stack = np.stack([f.gray for f in frames])
    _, in_phase, minus_quadrature = np.tensordot(solve, stack, axes=1)
    residual = np.tensordot(projector, stack, axes=1)
    residual -= _bent(residual, in_phase, minus_quadrature, shifts_rad, projector, valid)
    moved = _Light.of(valid, in_phase, minus_quadrature)
    return _judged(residual, moved, frames, before, tell_frame=len(frames) > 4)


def common_part(
    frames: Sequence[FrameSample], shifts_rad: Float[np.ndarray, "n"]
) -> "CommonPart | None":
    """Return what all step sets and pairs of one exposure have in common: the light without the pattern."""
    projector, solve = _design(shifts_rad)
    if projector is None:
        return None
    stack = np.stack([f.gray for f in frames])
    background, in_phase, minus_quadrature = np.tensordot(solve, stack, axes=1)
    valid = _all_valid(frames)
    return CommonPart(background, valid, _Light.of(valid, in_phase, minus_quadrature), frames)


def pair_part(frames: Sequence[FrameSample]) -> "CommonPart":
    """Return the mean of a pattern and its inverse, which is the same for all patterns of one exposure."""
    pattern, inverse = frames
    valid = pattern.valid & inverse.valid
    mean = (pattern.gray + inverse.gray) / 2
    half = (pattern.gray - inverse.gray) / 2
    return CommonPart(mean, valid, _Light.of(valid, half), frames)


@dataclass(frozen=True)
class CommonPart:
    """The part of a set that its pattern doesn't move."""

    gray: Sample
    valid: Valid
    light: "_Light"
    frames: Sequence[FrameSample] = field(repr=False, default=())

    def against(
        self, other: "CommonPart", before: Sequence[FrameSample | None] = ()
    ) -> Finding | None:
        """Judge this set by another one of the same exposure; None where too little light moves."""
        valid = self.valid & other.valid
        light = max(self.light, other.light, key=lambda part: part.energy)
        deviation = (self.gray - other.gray)[None]
        return _judged(deviation, light.on(valid), self.frames, before, tell_frame=False)


def same(frames: Sequence[FrameSample]) -> Finding | None:
    """Judge frames of one and the same pattern, the later ones by the first; None where it is too dark."""
    valid = _all_valid(frames)
    first = frames[0].gray
    light = _Light.of(valid, first)
    deviations = np.stack([f.gray - first for f in frames[1:]])
    found = _judged(deviations, light, (), (), tell_frame=True, roundings=2)
    # Of uniform fields any other one is brighter or darker everywhere.
    return found and Finding(found.share, None if found.frame is None else found.frame + 1)


# ---------------------------------------------------------------- uniform fields


@dataclass(frozen=True)
class Fields:
    """The white and the black field at one exposure: what the projector's light is, and what is there without it."""

    white: FrameSample
    black: FrameSample
    exposure: float
    """Exposure times gain, in any unit."""

    @cached_property
    def lit(self) -> Valid:
        """Pixels that tell white from black clearly; none where the camera doesn't see the projector.

        By what their neighbours tell: a pixel that was chosen for its own noise would be darker the next time. And
        noise that looks like light to one of two neighbours doesn't to the other.
        """
        light = self.white.gray - self.black.gray
        least = 4 * _LEAST_MODULATION * self.white.full_scale_gray
        beside = light[:, ::-1]
        lit = np.asarray(beside > max(0.25 * float(np.quantile(light, 0.99)), least))
        if np.count_nonzero(lit) < _LEAST_PIXELS or float(light[lit].mean()) < least:
            return np.zeros_like(lit)
        return lit

    @property
    def seen(self) -> bool:
        """Whether the camera sees the projector at all."""
        return bool(self.lit.any())

    def darkest(self, exposure: float) -> Sample:
        """Return what a black field may read at most at another exposure, whatever the camera's black level is."""
        return self._longer(self.black.gray, exposure)

    def at_most(self, exposure: float) -> FrameSample:
        """Return what any frame may read at most at another exposure if white was white."""
        brightest = copy(self.white)
        brightest.gray = self._longer(np.maximum(self.white.gray, self.black.gray), exposure)
        return brightest

    def _longer(self, gray: Sample, exposure: float) -> Sample:
        """Return the most that may become of a gray level at another exposure: what is 0 may be 0.9, cut off."""
        ratio = np.float32(max(1.0, exposure / self.exposure))
        return np.asarray(gray * ratio + (ratio - 1))

    def at_least(self, exposure: float) -> FrameSample:
        """Return what any frame reads at least at another exposure if black was black."""
        darkest = copy(self.black)
        lower = np.minimum(self.white.gray, self.black.gray)
        darkest.gray = lower * np.float32(min(1.0, exposure / self.exposure))
        return darkest

    def brightness(self, exposure: float) -> Sample:
        """Return about how far white is above black at another exposure."""
        above = (self.white.gray - self.black.gray) * np.float32(exposure / self.exposure)
        room = self.white.full_scale_gray - self.darkest(exposure)
        return np.asarray(np.minimum(above, np.maximum(room, 0)))


def marker_light(
    marker: FrameSample, others: Sequence[FrameSample], fields: Fields, exposure: float
) -> float | None:
    """Return which share of the light of its neighbours a frame has that should be black; None: nothing is bright.

    Parameters
    ----------
    marker
        The frame that should be black.
    others
        Frames of the same exposure that were taken around it.
    fields
        White and black as they certainly are.
    exposure
        Exposure times gain of marker and others.

    Notes
    -----
    The black level of the camera needn't be known: black is allowed whatever it may read at this exposure.
    """
    lit, darkest = fields.lit, fields.darkest(exposure)
    if not fields.seen:
        return None
    above = [float((f.gray - darkest)[lit].mean()) for f in (marker, *others)]
    brightest = max(above)
    white = float(fields.brightness(exposure)[lit].mean())
    if brightest < max(0.01 * white, _LEAST_MODULATION * marker.full_scale_gray):
        return None
    return max(0.0, above[0] / brightest)


def black_light(frame: FrameSample, fields: Fields, exposure: float) -> float | None:
    """Return which share of white a frame has that should be black; None where the camera doesn't see the projector."""
    lit = fields.lit
    white = float(fields.brightness(exposure)[lit].mean()) if lit.any() else 0.0
    if white < 4 * _LEAST_MODULATION * frame.full_scale_gray:
        return None
    return max(0.0, float((frame.gray - fields.darkest(exposure))[lit].mean()) / white)


def white_light(marker: FrameSample, fields: Fields, exposure: float) -> float | None:
    """Return which share of white a frame has that should be white; None where the camera doesn't see the projector."""
    lit = fields.lit
    if not fields.seen:
        return None
    white = float(fields.brightness(exposure)[lit].mean())
    dark = fields.black.gray * np.float32(min(1.0, exposure / fields.exposure))
    if white < _LEAST_MODULATION * marker.full_scale_gray:
        return None
    return float((marker.gray - dark)[lit].mean()) / white


def level(frame: FrameSample, fields: Fields) -> float | None:
    """Return how bright a frame is where the projector's light falls, in [gray]; None where it isn't seen."""
    return float(frame.gray[fields.lit].mean()) if fields.seen else None


def drift(before: FrameSample, after: FrameSample, fields: Fields) -> float | None:
    """Return how much brighter a field has become, as a share of the projector's light; None where noise hides it."""
    use = fields.lit & before.valid & after.valid
    if int(np.count_nonzero(use)) < _LEAST_PIXELS:
        return None
    light = float((fields.white.gray - fields.black.gray)[use].mean())
    change = (after.gray - before.gray)[use]
    if float(change.std()) / np.sqrt(change.size) > _DRIFT_SIGMA * light:
        return None
    return float(change.mean()) / light


def is_unchanged(
    frame: FrameSample,
    before: FrameSample,
    codes: tuple[float, float],
    fields: Fields,
    exposure: float,
) -> bool:
    """Tell whether a gray field is as bright as the one before it, whose code is another.

    Parameters
    ----------
    frame, before
        Two fields, taken one after the other at the same exposure.
    codes
        Their codes, which differ: gray levels of the display in 0..255.
    fields
        White and black as they certainly are.
    exposure
        Exposure times gain of both.

    Notes
    -----
    Every display with a gamma of 3 or less is brighter by at least a twentieth of what a linear one would be, between
    codes 48 and 232. Beyond, some show the same; there the answer is no, as where noise or saturation hide the step.
    """
    low, high = _GRAYS_LIKELY
    if not all(low <= code <= high for code in codes):
        return False
    use = fields.lit & frame.valid & before.valid & fields.white.valid
    if int(np.count_nonzero(use)) < _LEAST_PIXELS:
        return False
    light = float((fields.white.gray - fields.black.gray)[use].mean()) * exposure / fields.exposure
    least = _LEAST_STEP * abs(codes[0] - codes[1]) / 255 * light
    difference = (frame.gray - before.gray)[use]
    noise = float(difference.std()) / np.sqrt(difference.size)
    return least > 4 * noise + 0.1 and abs(float(difference.mean())) < least / 2


class Movement(NamedTuple):
    """How a picture of the same light has changed from one moment to another."""

    x_px: float
    y_px: float
    share: float
    """What neither movement nor brightness explains, as a share of the light."""


def movement(first: Fields, white: FrameSample, black: FrameSample | None) -> Movement | None:
    r"""Tell by how much a picture has moved since white and black were exposed first.

    Parameters
    ----------
    first
        White and black then.
    white, black
        The same now; without black, what else lights the scene has to be what it was.

    Returns
    -------
    movement
        None where the scene is too even, or too noisy, to tell.

    Notes
    -----
    To first order :math:`I' = (1 + g) I + c - s_x \partial_x I - s_y \partial_y I`, by least squares over lit pixels: exact
    for a fraction of a pixel, and too small for more, which then is in what isn't explained. The noise of the slopes is
    taken off the normal equations.
    """
    valid = first.lit & first.white.valid & white.valid
    before, after = first.white.gray, white.gray
    if black is not None:
        before, after = before - first.black.gray, after - black.gray
    use = valid[..., 1:-1]
    count = int(np.count_nonzero(use))
    if count < _LEAST_PIXELS:
        return None
    across = (before[..., 2:] - before[..., :-2])[use] / 2
    down = np.repeat(np.diff(before, axis=1), 2, axis=1)[..., 1:-1][use]
    seen = before[..., 1:-1][use]
    design = np.stack([-across, -down, seen, np.ones_like(seen)], axis=1).astype(np.float64)
    change = (after - before)[..., 1:-1][use].astype(np.float64)
    normal = design.T @ design
    if np.linalg.matrix_rank(normal) < 4:
        return None
    left = np.zeros(use.shape, np.float32)
    left[use] = change - design @ np.linalg.solve(normal, design.T @ change)
    variance = float((left**2).sum(dtype=np.float64)) / count
    # Noise makes slopes steeper than they are, by half of its variance across and by twice of it down. What neighbours
    # have in common isn't noise.
    noise = max(variance - float((left[..., 1:] * left[..., :-1]).sum(dtype=np.float64)) / count, 0)
    normal[:2, :2] -= count * noise / 2 * np.diag([0.5, 2.0])
    if np.linalg.eigvalsh(normal)[0] <= 0:
        return None
    solution = np.linalg.solve(normal, design.T @ change)
    error_px = np.sqrt(variance * np.diag(np.linalg.inv(normal))[:2].max())
    if error_px > _SURE_SHIFT_PX:
        return None
    light = float((first.white.gray - first.black.gray)[..., 1:-1][use].mean())
    if light < _LEAST_MOVED * white.full_scale_gray:
        return None
    unexplained = max(float((left[..., 1:] * left[..., :-1]).sum(dtype=np.float64)), 0.0) / count
    return Movement(float(solution[0]), float(solution[1]), float(np.sqrt(unexplained)) / light)


# ---------------------------------------------------------------- covariances of neighbours


@dataclass(frozen=True)
class _Light:
    """The light that a pattern moves."""

    parts: tuple[Sample, ...] = field(repr=False)
    valid: Valid = field(repr=False)
    energies: Float[np.ndarray, "band"] = field(repr=False)
    """Mean square without noise in [gray^2], of the whole picture and of its bands; 0 where a band isn't judged."""

    @classmethod
    def of(cls, valid: Valid, *parts: Sample) -> "_Light":
        sums = _by_band(sum(_row_sums(part[None], valid)[0] for part in parts))
        counts = _counts(valid)
        energies = sums.max(axis=1) / np.maximum(counts, 1)
        small = (sums.max(axis=1) < _LEAST_SHARE * sums[0].max()) | (counts < _LEAST_PIXELS)
        return cls(tuple(parts), valid, np.where(small, 0.0, np.maximum(energies, 0.0)))

    @property
    def energy(self) -> float:
        """Of the whole picture."""
        return float(self.energies[0])

    def on(self, valid: Valid) -> "_Light":
        return _Light.of(valid & self.valid, *self.parts)


def _judged(
    deviations: Float32[np.ndarray, "n pair 2 w"],
    light: _Light,
    frames: Sequence[FrameSample],
    before: Sequence[FrameSample | None],
    *,
    tell_frame: bool,
    roundings: int = 1,
) -> Finding | None:
    """Compare deviations with the light; each holds so many roundings, all of them of weight 1."""
    counts = _counts(light.valid)
    full = frames[0].full_scale_gray if frames else 255.0
    least = (_LEAST_MODULATION * full) ** 2 / 2
    if light.energy < least:
        return None
    if counts[0] < _LEAST_VALID * light.valid.size:
        return None
    found = np.stack([_by_band(sums).max(axis=1) for sums in _row_sums(deviations, light.valid)])
    found /= np.maximum(counts, 1)
    squares = float((deviations**2 * light.valid).sum(dtype=np.float64)) / len(deviations)
    noise = max(squares / counts[0] - float(found[:, 0].mean()), 0.0)
    if noise / np.sqrt(counts[0]) > _SURE * light.energy:
        return None
    # What is left of a scene that is over-exposed is dim: there chance and rounding look like a picture.
    unsure = 4 * noise / np.sqrt(np.maximum(counts, 1)) + roundings * _ROUNDING
    if unsure[0] > _UNSURE * light.energy:
        return None
    found -= unsure
    known = np.where(light.energies >= least, light.energies, np.inf)
    shares = np.sqrt(np.maximum(found, 0.0) / known)
    worst, band = (int(i) for i in np.unravel_index(np.argmax(shares), shares.shape))
    share = float(shares[worst, band])
    even = _is_even(deviations[worst], frames, light, band)
    if tell_frame:
        repeats = _repeats(worst, frames, before, light, band)
        return Finding(share, worst, repeats, even and not repeats)
    late = [k for k in range(len(frames)) if _repeats(k, frames, before, light, band)]
    if late:
        return Finding(share, late[0], repeats=True)
    return Finding(share, _odd(frames, light, band), even=even)


def _row_sums(
    pictures: Float32[np.ndarray, "n pair 2 w"], valid: Valid
) -> Float[np.ndarray, "n pair 2"]:
    """Sum the products of neighbours in each pair of rows: across, and down."""
    inside = pictures * valid
    across = np.einsum("npqw,npqw->np", inside[..., :-1], inside[..., 1:])
    # There are half as many pairs of rows as rows.
    down = 2.0 * np.einsum("npw,npw->np", inside[:, :, 0], inside[:, :, 1])
    return np.stack([across, down], axis=-1).astype(np.float64)


def _by_band(sums: Float[np.ndarray, "pair k"]) -> Float[np.ndarray, "band k"]:
    """Sum over the whole picture, then over each of its bands."""
    return np.stack([sums.sum(axis=0), *(part.sum(axis=0) for part in _bands(sums))])


def _counts(valid: Valid) -> Float[np.ndarray, "band"]:
    per_pair = valid.sum(axis=(1, 2))[:, None].astype(np.float64)
    return _by_band(per_pair)[:, 0]


def _bands(picture: Any) -> list[Any]:
    return np.array_split(picture, BANDS)


def _part(picture: Any, band: int) -> Any:
    """Return a band of a picture; 0 is all of it."""
    return picture if band == 0 else _bands(picture)[band - 1]


def _all_valid(frames: Sequence[FrameSample]) -> Valid:
    return np.asarray(np.logical_and.reduce([f.valid for f in frames]))


def _spoilt(gray: Gray, full_scale_gray: float) -> Bool[np.ndarray, "h w"]:
    """Return what is saturated, and its neighbours: charge spills over, most of all along columns, and lenses blur."""
    saturated = (gray >= full_scale_gray - 1).astype(np.uint8)
    return np.asarray(cv2.dilate(saturated, np.ones((21, 5), np.uint8)) > 0)


def _design(shifts_rad: Float[np.ndarray, "n"]) -> tuple[Any, Any]:
    """Return what a sinusoid leaves of n frames, and what finds it; (None, ...) if the shifts don't determine it."""
    design = np.stack([np.ones_like(shifts_rad), np.cos(shifts_rad), np.sin(shifts_rad)], axis=1)
    if np.linalg.matrix_rank(design) < 3:
        return None, None
    solve = np.linalg.pinv(design)
    return (np.eye(len(shifts_rad)) - design @ solve).astype(np.float32), solve.astype(np.float32)


def _bent(
    residual: Float32[np.ndarray, "n pair 2 w"],
    in_phase: Sample,
    minus_quadrature: Sample,
    shifts_rad: Float[np.ndarray, "n"],
    projector: Float32[np.ndarray, "n n"],
    valid: Valid,
) -> Float32[np.ndarray, "n pair 2 w"]:
    """Return the part of the residual that is a function of the phase, the same all over the picture."""
    modulation = np.hypot(in_phase, minus_quadrature)
    phase = np.arctan2(-minus_quadrature, in_phase)
    scale = max(float(modulation[valid].max()) if valid.any() else 1.0, 1e-6)
    shapes = []
    for harmonic in _HARMONICS:
        turned = harmonic * (phase[None] + shifts_rad.astype(np.float32)[:, None, None, None])
        wave = np.tensordot(projector, modulation * np.cos(turned), axes=1)
        if np.abs(wave[:, valid]).max(initial=0.0) > 1e-3 * scale:
            shapes += [wave, wave * (modulation / scale)]
    if not shapes:
        return np.zeros_like(residual)
    inside = np.stack([shape[:, valid].ravel() for shape in shapes], axis=1)
    normal = inside.T @ inside
    regular = normal + 1e-6 * np.trace(normal) * np.eye(len(shapes), dtype=normal.dtype)
    weights = np.linalg.solve(regular, inside.T @ residual[:, valid].ravel())
    typical = float((modulation[valid] ** 2).mean()) / (scale * float(modulation[valid].mean()))
    bent = float(np.abs(weights[::2] + typical * weights[1::2]).sum())
    if len(shifts_rad) > 4 and bent > _MOST_BENT:
        return np.zeros_like(residual)
    return np.asarray(np.tensordot(weights.astype(np.float32), np.stack(shapes), axes=1))


def _repeats(
    index: int,
    frames: Sequence[FrameSample],
    before: Sequence[FrameSample | None],
    light: _Light,
    band: int,
) -> bool:
    """Tell whether a frame shows the same as the one before it, where the deviation is largest."""
    previous = before[index] if index < len(before) else None
    if previous is None or not frames or previous.gray.shape != frames[index].gray.shape:
        return False
    difference = _part(frames[index].gray - previous.gray, band)
    valid = _part(light.valid, band)
    found = _row_sums(difference[None], valid)[0].sum(axis=0).max() / max(valid.sum(), 1)
    return bool(found < _REPEATED**2 * light.energies[band])


def _is_even(deviation: Sample, frames: Sequence[FrameSample], light: _Light, band: int) -> bool:
    """Tell whether a deviation has one sign: whether it is correlated with how bright the scene is."""
    if not frames:
        return False
    scene = np.mean([f.gray for f in frames], axis=0, dtype=np.float32)
    valid = _part(light.valid, band)
    a, b = (_part(p, band) * valid for p in (deviation, scene))
    own, bright, both = (
        float((one[..., :-1] * other[..., 1:]).sum(dtype=np.float64))
        for one, other in ((a, a), (b, b), (a, b))
    )
    return own > 0 and bright > 0 and abs(both) > _EVEN * float(np.sqrt(own * bright))


def _odd(frames: Sequence[FrameSample], light: _Light, band: int) -> int | None:
    """Return the frame that is far brighter or darker than the others, if one is."""
    valid = _part(light.valid, band)
    if len(frames) < 3 or not valid.any():
        return None
    means = np.array([float(_part(f.gray, band)[valid].mean()) for f in frames])
    off = np.abs(means - np.median(means))
    return int(np.argmax(off)) if off.max() > 0.5 * np.sqrt(light.energy) else None
