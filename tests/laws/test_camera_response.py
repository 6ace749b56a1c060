"""A response is found up to the unit of its light, whatever the camera's tone curve is."""

from itertools import pairwise

import numpy as np
import pytest

from backend.devices.sim.chains import FILM, INVERSE, LINEAR, Chain, Curve
from backend.numerics.camera_response import ResponseProblem, opencv_response, stratified_samples
from backend.numerics.linearisation import Interval, interval_of, optimised_response, quoted_error
from backend.numerics.screen_ramp import control_of_gray, monotone_ramp

RATIOS = np.geomspace(0.08, 4.0, 6)
TONES = {"linear": LINEAR, "inverse": INVERSE, "film": FILM}


def chain_of(tone: Curve) -> Chain:
    return Chain("test", LINEAR, tone, 0.0, 0.95)


def samples_of(chain: Chain, seed: int, *, unit: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    light = unit * np.exp(rng.uniform(np.log(0.02), 0.0, (60, 60)))
    frames = np.stack([chain.gray(light, float(r) / unit, rng) for r in RATIOS])
    return stratified_samples(frames, full_scale_gray=255)


def log_light(tone: Curve) -> np.ndarray:
    """The truth: ln of the charge of every gray level."""
    charge = np.linspace(0.0, 1.0, 100_001)
    with np.errstate(divide="ignore"):
        return np.log(np.interp(np.arange(256) / 255, tone(charge), charge))


@pytest.mark.parametrize("tone", TONES.values(), ids=TONES.keys())
@pytest.mark.parametrize("seed", [1, 2])
def test_the_response_is_the_tone_curve_up_to_scale(tone: Curve, seed: int) -> None:
    problem = ResponseProblem(
        samples_of(chain_of(tone), seed), np.log(RATIOS), levels=256, degree=8, lowest_gray=10
    )

    apart = (problem.solve() - log_light(tone))[25:246]

    assert apart.std() < 0.05


@pytest.mark.parametrize("degree", [3, 4, 5, 6, 7, 8])
def test_all_degrees_from_3_to_8_work_on_film(degree: int) -> None:
    problem = ResponseProblem(
        samples_of(chain_of(FILM), 3), np.log(RATIOS), levels=256, degree=degree, lowest_gray=10
    )

    apart = (problem.solve() - log_light(FILM))[30:240]

    assert apart.std() < 0.15


def test_the_unit_of_exposures_changes_nothing() -> None:
    samples = samples_of(chain_of(FILM), 4)

    ms, seconds = (
        ResponseProblem(samples, np.log(RATIOS * unit), levels=256).solve() for unit in (1.0, 1e-3)
    )

    np.testing.assert_allclose(ms, seconds, atol=1e-9)


def test_a_camera_of_12_bit_has_the_same_response() -> None:
    rng = np.random.default_rng(5)
    light = np.exp(rng.uniform(np.log(0.02), 0.0, (60, 60)))
    chain = chain_of(FILM)
    frames = np.stack([chain.gray(light, float(r), rng, bits=12) for r in RATIOS])
    samples = stratified_samples(frames, full_scale_gray=4095)
    fine = ResponseProblem(samples, np.log(RATIOS), levels=4096, degree=8, lowest_gray=160).solve()

    at_8_bit = np.interp(np.arange(256) / 255, np.arange(4096) / 4095, fine)

    assert (at_8_bit - log_light(FILM))[25:246].std() < 0.05


def test_keeping_clipped_samples_is_worse() -> None:
    samples = samples_of(chain_of(FILM), 6)
    truth = log_light(FILM)

    def error(lowest: int, highest: int) -> float:
        found = ResponseProblem(
            samples, np.log(RATIOS), levels=256, lowest_gray=lowest, highest_gray=highest
        ).solve()
        return float((found - truth)[25:246].std())

    assert error(0, 255) > 1.3 * error(1, 254)


def test_opencv_finds_the_same_curve() -> None:
    samples = samples_of(chain_of(FILM), 7)
    ours = ResponseProblem(samples, np.log(RATIOS), levels=256, lowest_gray=10).solve()

    theirs = opencv_response(samples, 20.0 * RATIOS)

    assert (ours - theirs)[20:240].std() < 0.08


# equations 10 to 12


def optimised(seed: int) -> tuple[ResponseProblem, np.ndarray, np.ndarray, Interval]:
    chain = Chain("gamma, film", lambda x: np.asarray(x**2.2), FILM, 0.02, 0.9)
    problem = ResponseProblem(
        samples_of(chain_of(FILM), seed), np.log(RATIOS), levels=256, degree=8, lowest_gray=10
    )
    y = np.linspace(-1, 1, 33)
    gray = chain.gray(chain.luminance(chain.code(y)), quantised=False)
    control = control_of_gray(monotone_ramp(chain.code(y) / 127.5 - 1, gray), 256)
    return problem, problem.solve(), control, interval_of(control, 30, 245)


@pytest.mark.parametrize("seed", [8, 9])
def test_one_pass_makes_the_response_straight_in_the_control_value(seed: int) -> None:
    problem, first, control, within = optimised(seed)

    once = optimised_response(problem, first, control, within)

    inside = slice(within.gray_low, within.gray_high + 1)
    plain = np.abs(quoted_error(first[inside], control[inside])).max()
    assert once.monotone
    assert once.quoted_error_percent < 1.5
    assert plain > 5 * once.quoted_error_percent


def test_the_offset_is_taken_once_a_second_pass_undoes_it() -> None:
    problem, first, control, within = optimised(8)
    once = optimised_response(problem, first, control, within)

    errors = [once.quoted_error_percent]
    values = once.values
    for _ in range(2):  # eps from what the last pass left
        values = optimised_response(problem, values, control, within).values
        inside = slice(within.gray_low, within.gray_high + 1)
        errors.append(float(np.abs(quoted_error(values[inside], control[inside])).max()))

    assert errors[1] > 5 * errors[0]


def test_an_offset_that_all_samples_share_changes_nothing() -> None:
    problem, first, _, _ = optimised(8)

    shifted = problem.solve(offset=np.full(256, 0.7))

    np.testing.assert_allclose(shifted, first, atol=1e-9)


def test_eliminating_the_light_is_the_same_as_solving_for_it() -> None:
    samples = samples_of(chain_of(FILM), 10)[::20]
    problem = ResponseProblem(samples, np.log(RATIOS), levels=256, degree=4)

    x = np.linspace(-1, 1, 256)
    basis = np.stack([x**k for k in range(1, 5)], axis=1)
    second = np.stack([k * (k - 1) * x ** max(k - 2, 0) for k in range(1, 5)], axis=1) / 127.5**2
    rows, right = [*np.hstack([second, np.zeros((256, len(samples)))])], [0.0] * 256
    for i, point in enumerate(samples):
        for j, gray in enumerate(point):
            if 0 < gray < 255:
                rows.append(np.concatenate([basis[gray], -np.eye(len(samples))[i]]))
                right.append(np.log(RATIOS[j]))
    solved = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    direct = basis @ solved[:4]

    np.testing.assert_allclose(problem.solve(), direct - direct[128], atol=1e-6)


def test_stratified_samples_cover_all_gray_levels() -> None:
    samples = samples_of(chain_of(LINEAR), 11)

    levels = np.unique(samples)

    assert max(b - a for a, b in pairwise(levels[levels > 10])) <= 4
