"""Laws of phase noise: predictions against simulation, none of them a copied result."""

import numpy as np
import pytest

from backend.numerics.absolute_phase import AbsolutePhase, Limits, absolute_phase, decode_frames
from backend.numerics.fringe_orders import (
    FringeOrders,
    cascade,
    maximum_likelihood,
    stage_noise_gain,
)
from backend.numerics.phasors import Phasors, fuse_exposures, whole_steps, wrapped_phase_rad
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import (
    NoiseModel,
    cascade_failure_probability,
    fused_phase_sigma_rad,
    lattice_failure_bound,
    phase_sigma_rad,
    position_bound,
    position_sigma,
)
from tests.fringe_scenes import Scene, ramp

SIZE_PX = 1920
PERIODS = (59.0, 64.0, 70.0)
CODE = SineCode.equal_steps(PERIODS, 4)
NO_LIMITS = Limits(min_modulation_gray=0.0, max_residual_cycles=1.0, guard_band=0.0)


def noisy_phasors(x: np.ndarray, ratio: float, seed: int, code: SineCode = CODE) -> Phasors:
    """Phasors of four-step frames with white noise, B/sigma_I = ratio, without rounding to gray."""
    rng = np.random.default_rng(seed)
    modulation = 100.0
    sigma = modulation / ratio
    phase = 2 * np.pi * np.array(code.periods)[:, None, None] * x
    # Four even steps: both parts of the phasor have the variance sigma^2 / 2.
    noise = rng.standard_normal((2, *phase.shape)) * sigma / np.sqrt(2)
    step_gray = 0.01
    return Phasors(
        in_phase=whole_steps(modulation * np.cos(phase) + noise[0], step_gray),
        quadrature=whole_steps(modulation * np.sin(phase) + noise[1], step_gray),
        light_gray_per_ms=np.full(x.shape, 120, np.float32),
        sigma_gray=np.full(x.shape, sigma, np.float32),
        exposure_index=np.zeros(x.shape, np.uint8),
        reasons=np.zeros(x.shape, np.uint16),
        step_gray=step_gray,
        exposures_ms=(1.0,),
    )


def decoded(x: np.ndarray, ratio: float, orders: FringeOrders, seed: int) -> AbsolutePhase:
    return absolute_phase(
        noisy_phasors(x, ratio, seed), CODE, orders, size_px=SIZE_PX, limits=NO_LIMITS
    )


@pytest.mark.parametrize("n_steps", [3, 4, 7, 12])
def test_wrapped_phase_reaches_the_cramer_rao_bound(n_steps):
    code = SineCode.equal_steps((20.0,), n_steps)
    x = ramp(250, 2000)
    frames = Scene(x, 70.0, 110.0).frames(code, sigma_gray=3.0, seed=n_steps)
    noise = NoiseModel(read_gray=3.0, gray_per_e=0.0)
    phasors = fuse_exposures([frames], code, exposure_ms=[1.0], noise=noise, saturation_gray=255)
    error = np.angle(np.exp(1j * (wrapped_phase_rad(phasors)[0] - 2 * np.pi * 20 * x)))
    bound = phase_sigma_rad(float(noise.sigma_gray(np.zeros(1))[0]), 70.0, n_steps)
    assert error.std() / bound == pytest.approx(1.0, abs=0.006)


@pytest.mark.parametrize("ratio", [15, 25, 60])
def test_position_reaches_the_cramer_rao_bound_of_all_frequencies(ratio):
    x = ramp(300, 2000, 0.15, 0.85)
    result = decoded(x, ratio, maximum_likelihood(PERIODS), seed=ratio)
    error_px = result.projector_px - (x * SIZE_PX - 0.5)
    bound = position_bound(sigma_gray=1.0, modulation_gray=ratio, n_steps=4, periods=PERIODS)
    assert error_px.std() / (bound * SIZE_PX) == pytest.approx(1.0, abs=0.01)
    assert abs(error_px.mean()) < 4 * bound * SIZE_PX / np.sqrt(x.size)


def test_predicted_sigma_is_the_measured_one_with_photon_noise_and_uneven_modulation():
    x = ramp(400, 2000, 0.15, 0.85)
    modulation = np.broadcast_to(np.linspace(30, 90, x.shape[1]), x.shape)
    noise = NoiseModel(read_gray=0.8, gray_per_e=1 / 30, black_gray=4.0)
    frames = Scene(x, modulation, 1.3 * modulation).frames(
        CODE, sigma_gray=0.8, gray_per_e=1 / 30, black_gray=4.0, seed=11
    )
    result = decode_frames(
        frames, CODE, maximum_likelihood(PERIODS), size_px=SIZE_PX, saturation_gray=255, noise=noise
    )
    assert result.sigma_px is not None
    score = (result.projector_px - (x * SIZE_PX - 0.5)) / result.sigma_px
    for part in np.array_split(score, 4, axis=1):
        assert part.std() == pytest.approx(1.0, abs=0.015)


def test_using_the_highest_frequency_alone_is_noisier_by_the_known_factor():
    x = ramp(200, 2000, 0.15, 0.85)
    errors = [
        (decoded(x, 30, orders, seed=1).projector_px - (x * SIZE_PX - 0.5)).std()
        for orders in (cascade(PERIODS), maximum_likelihood(PERIODS))
    ]
    sigma = phase_sigma_rad(1.0, 30.0, 4)
    predicted = position_sigma([sigma] * 3, PERIODS, fuse=False) / position_sigma(
        [sigma] * 3, PERIODS
    )
    assert errors[0] / errors[1] == pytest.approx(predicted, rel=0.01)


@pytest.mark.parametrize(("ratio", "n_px"), [(6, 400_000), (8, 1_000_000), (10, 2_000_000)])
def test_order_failures_follow_theory(ratio, n_px):
    rng = np.random.default_rng(ratio)
    x = rng.uniform(0.15, 0.85, (n_px // 2000, 2000))
    phasors = noisy_phasors(x, ratio, seed=ratio + 100)
    sigma = phase_sigma_rad(1.0, ratio, 4)

    def failures(orders: FringeOrders) -> float:
        result = absolute_phase(phasors, CODE, orders, size_px=SIZE_PX, limits=NO_LIMITS)
        wrong = np.abs(result.projector_px - (x * SIZE_PX - 0.5)) > SIZE_PX / 200
        # Off the projector and so NaN: as wrong as on a wrong fringe.
        return float((wrong | np.isnan(result.projector_px)).mean())

    by_cascade, by_likelihood = failures(cascade(PERIODS)), failures(maximum_likelihood(PERIODS))
    predicted = cascade_failure_probability(sigma, stage_noise_gain(cascade(PERIODS)))
    # The formula holds for the decisive stage; the other stage and the tails beyond the normal
    # distribution of a phase add up to a fifth at the largest noise.
    assert 0.95 * predicted < by_cascade < 1.25 * predicted
    distance = maximum_likelihood(PERIODS).distance_cycles
    bound = lattice_failure_bound(sigma, distance)
    statistical = 3 * np.sqrt(0.4 * bound / n_px)
    assert by_likelihood < bound + statistical
    # 2.4 of the six neighbours count, a figure from an independent simulation.
    assert by_likelihood == pytest.approx(0.4 * bound, rel=0.12, abs=statistical)
    assert by_likelihood < by_cascade / 3


@pytest.mark.parametrize("gray_per_e", [0.0, 1 / 15])
def test_weighted_fusion_reaches_the_bound_and_never_loses_to_one_exposure(gray_per_e):
    x = ramp(300, 2000, 0.15, 0.85)
    scene = Scene(x, 25.0, 32.0)
    read = 1.2
    noise = NoiseModel(read_gray=read, gray_per_e=gray_per_e)
    exposure_ms = [1.0, 2.0, 4.0]
    exposures = [
        scene.frames(CODE, exposure_ms=t, sigma_gray=read, gray_per_e=gray_per_e, seed=int(t))
        for t in exposure_ms
    ]
    errors, predicted = {}, {}
    for strategy in ("weighted", "longest_unsaturated"):
        phasors = fuse_exposures(
            exposures,
            CODE,
            exposure_ms=exposure_ms,
            noise=noise,
            saturation_gray=255,
            strategy=strategy,
        )
        error = np.angle(np.exp(1j * (wrapped_phase_rad(phasors)[2] - 2 * np.pi * 70 * x)))
        errors[strategy] = error.std()
        modulation = np.hypot(phasors.in_phase_gray[2], phasors.quadrature_gray[2])
        predicted[strategy] = float(np.sqrt(((phasors.sigma_gray / modulation) ** 2 / 2).mean()))
    singles = [
        phase_sigma_rad(float(noise.sigma_gray(np.array([32.0 * t]))[0]), 25.0 * t, 4)
        for t in exposure_ms
    ]
    assert errors["weighted"] / fused_phase_sigma_rad(singles) == pytest.approx(1.0, abs=0.01)
    assert errors["weighted"] / predicted["weighted"] == pytest.approx(1.0, abs=0.01)
    assert errors["longest_unsaturated"] / min(singles) == pytest.approx(1.0, abs=0.01)
    assert errors["weighted"] < errors["longest_unsaturated"]


def test_residual_grows_with_noise_as_its_degrees_of_freedom_say():
    x = ramp(100, 2000, 0.15, 0.85)
    result = decoded(x, 30, maximum_likelihood(PERIODS), seed=5)
    sigma_cycles = phase_sigma_rad(1.0, 30.0, 4) / (2 * np.pi)
    # Three phases, one unknown: the squared residual has two degrees of freedom.
    mean_square = float((result.residual_cycles.astype(float) ** 2).mean())
    assert mean_square / (2 * sigma_cycles**2) == pytest.approx(1.0, abs=0.02)
