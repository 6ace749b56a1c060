"""Frames of known phase shifts, at one or several exposures, to one phasor per pixel and frequency."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int16, Shaped, UInt8, UInt16

from backend.numerics import fusion_kernels as kernels
from backend.numerics.errors import FrameError
from backend.numerics.fusion_kernels import NO_EXPOSURE
from backend.numerics.kernels import FrameStack, frame_stack, kernel_input, new_work
from backend.numerics.sine_code import SineCode, step_fit
from backend.numerics.sinusoid_rows import Steps
from backend.numerics.uncertainty import NoiseModel

__all__ = [
    "NO_EXPOSURE",
    "Fusion",
    "Phasors",
    "fuse_exposures",
    "modulation_gray",
    "sinusoid_misfit",
    "wrapped_phase_rad",
]

Fusion = Literal["masks", "longest_unsaturated", "weighted"]
"""How the exposures of a pixel become one phasor."""

_MODES = {
    "masks": kernels.BY_INDEX,
    "longest_unsaturated": kernels.BY_LENGTH,
    "weighted": kernels.BY_VARIANCE,
}


class Phasors(NamedTuple):
    """What all frames say of every pixel, in gray levels of the pixel's dominating exposure.

    Phasors are whole numbers of steps of 1/32767 of the range: a hundredth of what rounding to whole gray levels
    adds to them, in half the memory of floating-point numbers.
    """

    in_phase: Int16[np.ndarray, "k h w"]
    """B cos(phi) of each frequency in steps of `step_gray`; 0 where no exposure serves the pixel."""
    quadrature: Int16[np.ndarray, "k h w"]
    """B sin(phi) of each frequency in steps of `step_gray`."""
    light_gray_per_ms: Float32[np.ndarray, "h w"]
    """Mean of all frequencies' frames above black, over the exposure; 0 where no exposure serves the pixel."""
    sigma_gray: Float32[np.ndarray, "h w"]
    """Noise of one gray level that would give this phasor's noise in [gray]; NaN where no exposure
    serves the pixel. The phase has sqrt(noise gain) sigma/B, with gain 2/N for N even steps."""
    exposure_index: UInt8[np.ndarray, "h w"]
    """Exposure of the largest weight; 255 where none serves the pixel."""
    reasons: UInt16[np.ndarray, "h w"]
    """Why a pixel has no phasor, or no trustworthy one: bits of `Reason`."""
    step_gray: float
    exposures_ms: tuple[float, ...]

    @property
    def in_phase_gray(self) -> Float32[np.ndarray, "k h w"]:
        """B cos(phi) of each frequency in [gray], made anew at each call."""
        return gray_levels(self.in_phase, self.step_gray)

    @property
    def quadrature_gray(self) -> Float32[np.ndarray, "k h w"]:
        """B sin(phi) of each frequency in [gray], made anew at each call."""
        return gray_levels(self.quadrature, self.step_gray)


def gray_levels(steps: Int16[np.ndarray, "*any"], step_gray: float) -> Float32[np.ndarray, "*any"]:
    """Turn whole steps into gray levels."""
    gray: Float32[np.ndarray, "*any"] = steps * np.float32(step_gray)
    return gray


def whole_steps(gray: Float[np.ndarray, "*any"], step_gray: float) -> Int16[np.ndarray, "*any"]:
    """Round gray levels to whole steps."""
    steps: Int16[np.ndarray, "*any"] = np.clip(np.rint(gray / step_gray), -32767, 32767).astype(
        np.int16
    )
    return steps


@lru_cache(maxsize=64)
def steps_of(code: SineCode) -> Steps:
    """Put a code's weights where the kernels read them; nobody may write to them."""
    fits = [step_fit(shifts_rad) for shifts_rad in code.shifts_rad]
    counts = [len(shifts_rad) for shifts_rad in code.shifts_rad]
    weights = np.concatenate([fit.weights for fit in fits], axis=1)
    return Steps(
        first_frame=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        weights=np.ascontiguousarray(weights.astype(np.float32)),
    )


@lru_cache(maxsize=64)
def averaging_steps_of(code: SineCode) -> Steps:
    """Return `steps_of` with the means' weights scaled so that all frequencies' means add up to their average."""
    steps = steps_of(code)
    scale = np.array([[1.0], [1.0], [1 / len(code.periods)]], dtype=np.float32)
    return steps._replace(weights=steps.weights * scale)


def exposure_table(exposures_ms: Sequence[float]) -> Float32[np.ndarray, "256"]:
    """Return the exposure of each possible index in [ms]; 1 where there is none."""
    return np.array([*exposures_ms, *[1.0] * (256 - len(exposures_ms))], np.float32)


def fuse_exposures(
    exposures: Sequence[Sequence[Shaped[np.ndarray, "h w"]]],
    code: SineCode,
    *,
    exposure_ms: Sequence[float],
    noise: NoiseModel | Sequence[NoiseModel],
    saturation_gray: float,
    strategy: Fusion = "weighted",
    exposure_index: UInt8[np.ndarray, "h w"] | None = None,
    out: Phasors | None = None,
) -> Phasors:
    r"""Fuse the frames of one or several exposures into one phasor per pixel and frequency.

    Parameters
    ----------
    exposures
        The frames of each exposure in the code's order (frequency by frequency, step by step),
        uint8 or uint16, each its own array: nothing is stacked or copied.
    code
        Frequencies and steps of the frames.
    exposure_ms
        Exposure of each set in [ms], > 0, multiplied by the linear gain if gains differ.
    noise
        Noise of the camera, or one per exposure where gains differ. The black level is the first's.
    saturation_gray
        Samples of at least this gray level count as saturated: full scale - 1; infinite: none do.
    strategy
        "weighted": every exposure whose frames are all unsaturated, by inverse variance;
        "longest_unsaturated": the longest exposure whose frames are all unsaturated;
        "masks": the exposure that `exposure_index` names, saturated or not.
    exposure_index
        For "masks": index of each pixel's exposure, 255 for background.
    out
        Maps to write to, an earlier result: touching new memory costs as much as fusing.

    Returns
    -------
    Phasors
        In gray levels of the dominating exposure, so that a limit on modulation means contrast in a picture
        that was really taken. Phasors longer than `saturation_gray` (frames that clip, by masks) end there.

    Raises
    ------
    FrameError
        If numbers, sizes or types of frames, exposures and index don't fit together.

    Notes
    -----
    All frequencies of a pixel are judged together: one saturated sample excludes an exposure. With
    :math:`C_j` the phasor of exposure j, :math:`t_j` its time and :math:`\sigma_j` its noise at the
    mean gray level of all its frames,

    .. math:: C = t_d \frac{\sum_j (t_j / \sigma_j^2) C_j}{\sum_j t_j^2 / \sigma_j^2}, \qquad
              \sigma = t_d \Big/ \sqrt{\textstyle\sum_j t_j^2 / \sigma_j^2}

    where d is the exposure of the largest :math:`t_j^2 / \sigma_j^2`. The phase's noise is
    :math:`\sqrt{2/N} \sigma / |C|`, the Cramer-Rao bound of all unsaturated frames together.
    Cost: every frame is read once; memory: the results and 60 KB per thread.

    Masks are equations 16 and 17 of [1]_; a pixel brighter than its mask foresees is reported as
    saturated, which the paper leaves open.

    References
    ----------
    .. [1] The HDRSIA method: multi-exposure fringe projection with exposures from the histogram's
       zones, see the method's page.
    """
    stack = _collect(exposures, code, len(exposure_ms))
    shape = stack.shape
    exposure = np.asarray(exposure_ms, dtype=np.float32)
    if not np.all(np.isfinite(exposure) & (exposure > 0)):
        raise FrameError(f"exposures of {list(exposure_ms)} ms can't be fused: give times > 0")
    noises = [noise] * len(exposure) if isinstance(noise, NoiseModel) else list(noise)
    if len(noises) != len(exposure):
        raise FrameError(
            f"{len(noises)} noise models for {len(exposure)} exposures: give one, or one for each"
        )
    wanted = _wanted_exposures(strategy, exposure_index, shape, len(exposure))
    n_frequencies = len(code.periods)
    if out is not None and out.in_phase.shape != (n_frequencies, *shape):
        raise FrameError(
            f"maps of shape {out.in_phase.shape} can't take {n_frequencies} frequencies of "
            f"{shape}: give maps of this size"
        )
    range_gray = saturation_gray if np.isfinite(saturation_gray) else 65535 if stack.wide else 255
    step_gray, times_ms = float(range_gray) / 32767, tuple(float(t) for t in exposure_ms)
    if out is not None:
        phasors = out._replace(step_gray=step_gray, exposures_ms=times_ms)
    else:
        phasors = _empty(n_frequencies, shape, step_gray, times_ms)
    kernels.fuse_exposures(
        new_work(),
        stack.addresses,
        stack.wide,
        shape[0] * shape[1],
        averaging_steps_of(code),
        kernels.Exposures(
            order=np.argsort(-exposure, kind="stable").astype(np.int64),
            exposure_ms=exposure,
            variance_gray2=np.array([n.dark_variance_gray2 for n in noises], np.float32),
            per_gray=np.array([n.gray_per_e for n in noises], np.float32),
            black_gray=float(noises[0].black_gray),
            steps_per_gray=1.0 / phasors.step_gray,
        ),
        wanted,
        _MODES[strategy],
        float(saturation_gray),
        kernels.Fused(
            cosine=phasors.in_phase.reshape(n_frequencies, -1),
            sine=phasors.quadrature.reshape(n_frequencies, -1),
            light=phasors.light_gray_per_ms.reshape(-1),
            sigma_gray=phasors.sigma_gray.reshape(-1),
            exposure_index=phasors.exposure_index.reshape(-1),
            reasons=phasors.reasons.reshape(-1),
        ),
    )
    return phasors


def _empty(
    n_frequencies: int, shape: tuple[int, int], step_gray: float, exposures_ms: tuple[float, ...]
) -> Phasors:
    return Phasors(
        in_phase=np.empty((n_frequencies, *shape), np.int16),
        quadrature=np.empty((n_frequencies, *shape), np.int16),
        light_gray_per_ms=np.empty(shape, np.float32),
        sigma_gray=np.empty(shape, np.float32),
        exposure_index=np.empty(shape, np.uint8),
        reasons=np.empty(shape, np.uint16),
        step_gray=step_gray,
        exposures_ms=exposures_ms,
    )


def _collect(
    exposures: Sequence[Sequence[Shaped[np.ndarray, "h w"]]], code: SineCode, n_exposures: int
) -> FrameStack:
    if not exposures or len(exposures) != n_exposures:
        raise FrameError(
            f"{len(exposures)} sets of frames and {n_exposures} exposure times were given: "
            "give at least one set and one time for each"
        )
    for index, frames in enumerate(exposures):
        if len(frames) != code.n_frames:
            raise FrameError(
                f"exposure {index} has {len(frames)} frames but the code needs {code.n_frames}: "
                "give every step of every frequency once"
            )
    return frame_stack([frame for frames in exposures for frame in frames])


def _wanted_exposures(
    strategy: Fusion,
    exposure_index: UInt8[np.ndarray, "h w"] | None,
    shape: tuple[int, int],
    n_exposures: int,
) -> UInt8[np.ndarray, "n_px"]:
    if strategy not in _MODES:
        raise FrameError(f"fusion {strategy!r} isn't known: choose one of {', '.join(_MODES)}")
    if strategy != "masks":
        return np.zeros(0, np.uint8)
    if exposure_index is None or exposure_index.shape != shape:
        given = None if exposure_index is None else exposure_index.shape
        raise FrameError(
            f"fusion by masks got an index of shape {given} for frames of {shape}: "
            "give the exposure's index of every pixel"
        )
    unknown = (exposure_index >= n_exposures) & (exposure_index != NO_EXPOSURE)
    if unknown.any():
        raise FrameError(
            f"the mask names exposure {int(exposure_index[unknown][0])} but there are {n_exposures}: "
            "give indices of exposures, or 255 for background"
        )
    return kernel_input(exposure_index).reshape(-1)


def modulation_gray(phasors: Phasors) -> Float32[np.ndarray, "k h w"]:
    """Amplitude B of each frequency's fringes in [gray] of the dominating exposure."""
    modulation: Float32[np.ndarray, "k h w"] = np.hypot(
        phasors.in_phase_gray, phasors.quadrature_gray
    )
    return modulation


def wrapped_phase_rad(phasors: Phasors) -> Float32[np.ndarray, "k h w"]:
    """Phase of each frequency in [rad], in (-pi, pi]; noise only where the modulation is 0."""
    phase: Float32[np.ndarray, "k h w"] = np.arctan2(phasors.quadrature_gray, phasors.in_phase_gray)
    return phase


def sinusoid_misfit(
    frames: Sequence[Shaped[np.ndarray, "h w"]], code: SineCode
) -> Float32[np.ndarray, "h w"]:
    r"""Measure how far the frames of one exposure are from sinusoids, in [gray].

    Parameters
    ----------
    frames
        The frames in the code's order, uint8 or uint16.
    code
        Frequencies and steps; at least one frequency has more than three steps.

    Returns
    -------
    float32
        Root of the squared misfits over the degrees of freedom (frames - 3 per frequency): the
        gray levels' noise where the fringes are sinusoids, more where harmonics (gamma, clipping),
        motion or a flickering lamp disturb them.

    Raises
    ------
    FrameError
        If the number of frames doesn't fit, or there is no degree of freedom.

    Notes
    -----
    Four steps see the harmonics 2, 6, 10 ... only; harmonic 3 looks like the fundamental to them.
    """
    stack = _collect([frames], code, 1)
    freedom = code.n_frames - 3 * len(code.periods)
    if freedom == 0:
        raise FrameError(
            f"{code.n_frames} frames for {len(code.periods)} frequencies fit any sinusoid exactly: "
            "take more than three steps"
        )
    shifts = np.concatenate([np.asarray(shifts_rad) for shifts_rad in code.shifts_rad])
    misfit_gray = np.empty(stack.shape, np.float32)
    kernels.sinusoid_misfit(
        new_work(),
        stack.addresses,
        stack.wide,
        misfit_gray.size,
        steps_of(code),
        np.stack([np.cos(shifts), np.sin(shifts)]).astype(np.float32),
        np.float32(1 / freedom),
        misfit_gray.reshape(-1),
    )
    return misfit_gray


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    code = SineCode.equal_steps((1,), 4)
    frames = [np.zeros((1, 1), np.uint8)] * 4
    noise = NoiseModel(read_gray=1.0, gray_per_e=0.0)
    fuse_exposures([frames], code, exposure_ms=[1.0], noise=noise, saturation_gray=255.0)
    sinusoid_misfit(frames, code)
