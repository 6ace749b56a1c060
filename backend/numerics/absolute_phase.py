"""From phasors, or straight from the frames of one exposure, to the projector coordinate of each pixel."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Shaped, UInt16

from backend.numerics import decoding_kernels as kernels
from backend.numerics.errors import FrameError, FrequencyError
from backend.numerics.fringe_orders import FringeOrders, hierarchical
from backend.numerics.kernels import frame_stack, kernel_input, new_work
from backend.numerics.order_rows import CODE
from backend.numerics.phasors import Phasors, averaging_steps_of, exposure_table
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import NoiseModel


@dataclass(frozen=True)
class Limits:
    """Which pixels are accepted."""

    min_modulation_gray: float = 5.0
    """Smallest amplitude B, over all frequencies, in [gray] of the dominating exposure."""
    max_residual_cycles: float | None = None
    """Largest contradiction between the frequencies; None: 0.7 of what mixes up two orders."""
    guard_band: float = 0.002
    """Share of the code's width at each end that is left out: noise may carry it to the other end."""


class AbsolutePhase(NamedTuple):
    """Where the projector's light at each pixel comes from, and how trustworthy that is."""

    projector_px: Float32[np.ndarray, "h w"]
    """Projector column (or row) u, pixel centres at integers; NaN where `reasons` isn't 0."""
    modulation_gray: Float32[np.ndarray, "h w"]
    """Smallest amplitude B over the frequencies in [gray]."""
    residual_cycles: Float32[np.ndarray, "h w"]
    """Distance of the phases from the nearest fringe order, all frequencies together in [cycles]."""
    reasons: UInt16[np.ndarray, "h w"]
    """Why a pixel is invalid: bits of `Reason`, 0 where it is valid."""
    sigma_px: Float32[np.ndarray, "h w"] | None
    """Predicted standard deviation of `projector_px`, NaN where that is NaN."""
    margin_cycles: Float32[np.ndarray, "h w"] | None
    """By how much the second-nearest fringe order is further away; NaN where a chain was used."""
    wrapped_rad: Float32[np.ndarray, "h w"] | None = None
    """Phase of the highest frequency in [rad], in (-pi, pi]; NaN where there is no phasor."""


def empty_maps(
    shape: tuple[int, int],
    *,
    with_sigma: bool = False,
    with_margin: bool = False,
    with_wrapped: bool = False,
) -> AbsolutePhase:
    """Allocate maps that several decodings may reuse: touching new memory costs as much as decoding."""
    return AbsolutePhase(
        projector_px=np.empty(shape, np.float32),
        modulation_gray=np.empty(shape, np.float32),
        residual_cycles=np.empty(shape, np.float32),
        reasons=np.empty(shape, np.uint16),
        sigma_px=np.empty(shape, np.float32) if with_sigma else None,
        margin_cycles=np.empty(shape, np.float32) if with_margin else None,
        wrapped_rad=np.empty(shape, np.float32) if with_wrapped else None,
    )


def decode_frames(
    frames: Sequence[Shaped[np.ndarray, "h w"]],
    code: SineCode,
    orders: FringeOrders,
    *,
    size_px: int,
    saturation_gray: float,
    limits: Limits | None = None,
    noise: NoiseModel | None = None,
    coarse_px: Float32[np.ndarray, "h w"] | None = None,
    with_margin: bool = False,
    out: AbsolutePhase | None = None,
) -> AbsolutePhase:
    """Decode the frames of one exposure in one pass, without any map in between.

    Parameters
    ----------
    frames
        The frames in the code's order, uint8 or uint16, each its own array.
    code
        Frequencies and steps of the frames.
    orders
        How fringe orders are found, made for the code's frequencies.
    size_px
        Projector's width (or height, for fringes along y) in [px].
    saturation_gray
        Pixels with a sample of at least this gray level are saturated; infinite: none are.
    limits
        Which pixels are accepted.
    noise
        Noise of the camera: if given, `sigma_px` is predicted.
    coarse_px
        Projector coordinate from a Gray code, NaN where it has none; for `code_aided` orders only.
    with_margin
        Also give `margin_cycles`.
    out
        Maps to write to, from `empty_maps`; wins over `noise` and `with_margin`.

    Raises
    ------
    FrameError
        If frames, code and maps don't fit together.
    FrequencyError
        If `orders` is for other frequencies.

    Notes
    -----
    Same results as `absolute_phase` of a single exposure's phasors, to rounding. Cost on two cores:
    about two to three times copying the frames; memory: the results and 100 KB per thread.
    """
    if len(frames) != code.n_frames:
        raise FrameError(
            f"{len(frames)} frames were given but the code needs {code.n_frames}: "
            "give every step of every frequency once"
        )
    stack = frame_stack(frames)
    black_gray = 0.0 if noise is None else noise.black_gray
    maps = out or empty_maps(stack.shape, with_sigma=noise is not None, with_margin=with_margin)
    _check_maps(maps, stack.shape, noise is not None)
    settings = _settings(code, orders, limits or Limits(), size_px, black_gray)
    kernels.decode_frames(
        new_work(),
        stack.addresses,
        stack.wide,
        stack.shape[0] * stack.shape[1],
        averaging_steps_of(code),
        _coarse(orders, coarse_px, stack.shape),
        float(saturation_gray),
        kernels.Noise(
            variance_gray2=noise.dark_variance_gray2 if noise else 0.0,
            per_gray=noise.gray_per_e if noise else 0.0,
            black_gray=black_gray,
        ),
        orders.tables,
        settings.scales,
        settings.limits,
        _kernel_maps(maps),
    )
    return maps


def absolute_phase(
    phasors: Phasors,
    code: SineCode,
    orders: FringeOrders,
    *,
    size_px: int,
    limits: Limits | None = None,
    coarse_px: Float32[np.ndarray, "h w"] | None = None,
    with_margin: bool = False,
    with_wrapped: bool = False,
    out: AbsolutePhase | None = None,
) -> AbsolutePhase:
    r"""Find the projector coordinate of each pixel from its phasors.

    Parameters
    ----------
    phasors
        Phasors of one or several exposures; pixels with a reason stay invalid.
    code
        The code of the phasors.
    orders
        How fringe orders are found, made for the code's frequencies.
    size_px
        Projector's width (or height, for fringes along y) in [px].
    limits
        Which pixels are accepted.
    coarse_px
        Projector coordinate from a Gray code, NaN where it has none; for `code_aided` orders only.
    with_margin, with_wrapped
        Also give `margin_cycles` or `wrapped_rad`.
    out
        Maps to write to, from `empty_maps` with sigma; wins over `with_margin` and `with_wrapped`.

    Returns
    -------
    AbsolutePhase
        Maps in float32, with `sigma_px`.

    Raises
    ------
    FrameError
        If maps have different sizes.
    FrequencyError
        If `orders` is for other frequencies.

    Notes
    -----
    The position is :math:`x = \sum f_i^2 x_i / \sum f_i^2`, :math:`u = x W - 1/2`, with the noise
    :math:`\sigma_x = \frac{\sigma_I}{2 \pi} \sqrt{\sum f_i^2 g_i / B_i^2} / \sum f_i^2` where
    :math:`g_i` is the steps' noise gain (2/N). Arctangents are right to 4e-7 rad, which is 1e-6
    of a projector pixel at 60 periods over 1280 columns; float32 leaves 6e-5 px.
    """
    shape = phasors.reasons.shape
    if phasors.in_phase.shape != (len(code.periods), *shape):
        raise FrameError(
            f"phasors of shape {phasors.in_phase.shape} don't fit {len(code.periods)} "
            f"frequencies of {shape}: give the code that the phasors were fused with"
        )
    maps = out or empty_maps(
        shape, with_sigma=True, with_margin=with_margin, with_wrapped=with_wrapped
    )
    _check_maps(maps, shape, True)
    settings = _settings(code, orders, limits or Limits(), size_px, 0.0)
    n_frequencies = len(code.periods)
    kernels.locate_phasors(
        new_work(),
        kernels.Planes(
            kernel_input(phasors.in_phase).reshape(n_frequencies, -1),
            kernel_input(phasors.quadrature).reshape(n_frequencies, -1),
            kernel_input(phasors.light_gray_per_ms).reshape(-1),
            kernel_input(phasors.sigma_gray).reshape(-1),
            kernel_input(phasors.exposure_index).reshape(-1),
            kernel_input(phasors.reasons).reshape(-1),
            exposure_ms=exposure_table(phasors.exposures_ms),
            step_gray=float(phasors.step_gray),
        ),
        _coarse(orders, coarse_px, shape),
        orders.tables,
        settings.scales,
        settings.limits,
        _kernel_maps(maps),
    )
    return maps


class _Settings(NamedTuple):
    scales: Float32[np.ndarray, "2 k"]
    limits: kernels.Limits


def _settings(
    code: SineCode, orders: FringeOrders, limits: Limits, size_px: int, black_gray: float
) -> _Settings:
    if tuple(code.periods) != tuple(orders.periods):
        raise FrequencyError(
            f"fringe orders were prepared for {orders.periods} periods but the code has {code.periods}: "
            "prepare them for the code's frequencies"
        )
    if limits.max_residual_cycles is None:
        max_residual_cycles = orders.default_residual_cycles
    else:
        max_residual_cycles = limits.max_residual_cycles
    frequencies = np.array(code.periods)
    variances = np.array(code.noise_gains) * _shares(frequencies, fuse=orders.tables.fuse) ** 2
    scales = np.stack(
        [
            frequencies / (frequencies @ frequencies),
            variances * size_px**2 / (2 * np.pi * frequencies) ** 2,
        ]
    )
    return _Settings(
        scales=scales.astype(np.float32),
        limits=kernels.Limits(
            min_modulation_gray=float(limits.min_modulation_gray),
            max_residual_cycles=float(max_residual_cycles),
            guard_band=float(limits.guard_band),
            size_px=float(size_px),
            black_gray=float(black_gray),
            finest=int(np.argmax(frequencies)),
        ),
    )


def _shares(frequencies: Float64[np.ndarray, "k"], *, fuse: bool) -> Float64[np.ndarray, "k"]:
    """Weight of each frequency's position in the result."""
    highest = np.arange(frequencies.size) == np.argmax(frequencies)
    shares: Float64[np.ndarray, k] = frequencies**2 if fuse else highest.astype(np.float64)
    shares /= shares.sum()
    return shares


def _coarse(
    orders: FringeOrders, coarse_px: Float32[np.ndarray, "h w"] | None, shape: tuple[int, ...]
) -> Float32[np.ndarray, "n_px"]:
    if orders.tables.mode != CODE:
        return np.zeros(0, np.float32)
    if coarse_px is None or coarse_px.shape != shape:
        given = None if coarse_px is None else coarse_px.shape
        raise FrameError(
            f"fringe orders by a code got a coarse coordinate of shape {given} for pictures of {shape}: "
            "decode the Gray code of the same camera first"
        )
    return kernel_input(coarse_px).reshape(-1)


def _check_maps(maps: AbsolutePhase, shape: tuple[int, ...], noise_known: bool) -> None:
    if maps.projector_px.shape != shape:
        raise FrameError(
            f"maps of shape {maps.projector_px.shape} can't take pictures of {shape}: allocate them for this size"
        )
    if maps.sigma_px is not None and not noise_known:
        raise FrameError(
            "sigma can't be predicted without a noise model: give one, or maps without sigma"
        )


def _kernel_maps(maps: AbsolutePhase) -> kernels.Maps:
    nothing = np.zeros(0, np.float32)
    return kernels.Maps(
        projector_px=maps.projector_px.reshape(-1),
        modulation_gray=maps.modulation_gray.reshape(-1),
        residual_cycles=maps.residual_cycles.reshape(-1),
        margin_cycles=nothing if maps.margin_cycles is None else maps.margin_cycles.reshape(-1),
        sigma_px=nothing if maps.sigma_px is None else maps.sigma_px.reshape(-1),
        wrapped_rad=nothing if maps.wrapped_rad is None else maps.wrapped_rad.reshape(-1),
        reasons=maps.reasons.reshape(-1),
    )


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    code = SineCode.equal_steps((1,), 4)
    orders = hierarchical(code.periods)
    frames = [np.zeros((1, 1), np.uint8)] * 4
    decode_frames(frames, code, orders, size_px=1, saturation_gray=255.0)
    steps, picture = np.zeros((1, 1, 1), np.int16), np.zeros((1, 1), np.float32)
    phasors = Phasors(
        steps,
        steps,
        picture,
        picture,
        picture.astype(np.uint8),
        picture.astype(np.uint16),
        step_gray=1.0,
        exposures_ms=(1.0,),
    )
    absolute_phase(phasors, code, orders, size_px=1)
