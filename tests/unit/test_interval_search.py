"""The search over intervals: its minimum is one, and what can't be used is refused."""

import numpy as np
import pytest

from backend.devices.sim.chains import CHAINS, Chain
from backend.numerics.camera_response import ResponseProblem, stratified_samples
from backend.numerics.errors import ResponseError
from backend.numerics.interval_search import search_interval
from backend.numerics.screen_ramp import MonotoneRamp, monotone_ramp

RATIOS = np.geomspace(0.08, 4.0, 6)


def scene(chain: Chain, seed: int) -> tuple[ResponseProblem, MonotoneRamp]:
    rng = np.random.default_rng(seed)
    light = np.exp(rng.uniform(np.log(0.02), 0.0, (40, 40)))
    frames = np.stack([chain.gray(light, float(r), rng) for r in RATIOS])
    samples = stratified_samples(frames, full_scale_gray=255, count=200)
    problem = ResponseProblem(
        samples, np.log(RATIOS), levels=256, degree=8, lowest_gray=10, highest_gray=251
    )
    y = np.linspace(-1, 1, 33)
    light = np.repeat(chain.luminance(chain.code(y))[:, None], 400, axis=1)
    return problem, monotone_ramp(y, chain.gray(light, 1.0, rng).mean(axis=1))


@pytest.fixture(scope="module")
def film() -> tuple[ResponseProblem, MonotoneRamp]:
    return scene(CHAINS["D"], 1)


def test_the_best_interval_is_the_minimum_of_the_map(
    film: tuple[ResponseProblem, MonotoneRamp],
) -> None:
    found = search_interval(*film)

    assert found.cost <= np.nanmin(found.cost_map)
    row, column = np.unravel_index(int(np.nanargmin(found.cost_map)), found.cost_map.shape)
    assert abs(found.best.gray_low - found.axis_gray[column]) < 5
    assert abs(found.best.gray_high - found.axis_gray[row]) < 5


def test_each_cost_is_that_of_its_interval(film: tuple[ResponseProblem, MonotoneRamp]) -> None:
    found = search_interval(*film)
    row, column = 40, 8  # gray 200 and 40

    there = search_interval(*film, at=(40, 200))

    assert found.axis_gray[[column, row]].tolist() == [40, 200]
    assert there.cost == pytest.approx(found.cost_map[row, column])
    assert there.best[:2] == (40, 200)
    assert there.cost == pytest.approx(there.quoted_error_percent + 20 * 100 / 160)


def test_intervals_outside_the_ramp_or_with_few_points_are_refused(
    film: tuple[ResponseProblem, MonotoneRamp],
) -> None:
    _, ramp = film
    costs = search_interval(*film).cost_map

    assert np.isnan(costs[:, 0]).all()  # the ramp begins above gray 0
    assert np.isnan(costs[-1]).all()  # and ends below 255
    assert np.isnan(costs[np.arange(50), np.arange(50)]).all()
    assert ramp.gray_low > 0


@pytest.mark.parametrize("weight", [10.0, 20.0, 50.0])
def test_a_heavier_range_makes_the_interval_wider(
    film: tuple[ResponseProblem, MonotoneRamp], weight: float
) -> None:
    """10 to 50 give intervals like the paper's 27 to 247."""
    best = search_interval(*film, resolution_weight=weight).best

    assert best.gray_low < 45
    assert best.gray_high > 230


def test_a_given_interval_has_to_be_within_the_ramp(
    film: tuple[ResponseProblem, MonotoneRamp],
) -> None:
    with pytest.raises(ResponseError, match="isn't within the ramp"):
        search_interval(*film, at=(2, 200))
