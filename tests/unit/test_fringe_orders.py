import numpy as np
import pytest

from backend.numerics.errors import FrequencyError
from backend.numerics.fringe_orders import (
    cascade,
    code_aided,
    hierarchical,
    maximum_likelihood,
    stage_noise_gain,
    unambiguous_range,
)

REAL = (1920 / 42, 1920 / 45, 48 * 40 / 48)


def test_the_papers_frequencies_have_the_distance_that_geometry_gives():
    orders = maximum_likelihood([59, 64, 70])
    assert orders.distance_cycles == pytest.approx(0.0845, abs=1e-4)
    assert orders.range_widths == 1.0
    # The shortest vector between lattice points, by brute force over integer order vectors.
    f = np.array([59.0, 64.0, 70.0])
    k = np.stack(np.meshgrid(*[np.arange(-15, 16)] * 3), axis=-1).reshape(-1, 3)
    across = k - np.outer(k @ f, f) / (f @ f)
    lengths = np.linalg.norm(across, axis=1)
    assert orders.distance_cycles == pytest.approx(lengths[lengths > 1e-9].min(), abs=1e-9)


def test_the_table_holds_the_two_nearest_points_of_every_cell_it_can_meet():
    orders = maximum_likelihood([7, 8, 9])
    tables = orders.tables
    assert tables.nearest.shape == tables.second.shape == (int(np.prod(tables.shape)),)
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    cells = corners @ tables.projection.T + tables.origin
    assert (cells > -1e-3).all()
    assert (cells < tables.shape + 1e-3).all()


@pytest.mark.parametrize(
    ("periods", "expected"),
    [
        ([59, 64, 70], 1.0),
        ([30, 36, 42], 1 / 6),
        ([16, 18], 0.5),
        ([0.5], 2.0),
        (REAL, 5040 / 1920),
        ([np.sqrt(2), 1.0], float("inf")),
    ],
)
def test_range_is_where_all_phases_come_back(periods, expected):
    assert unambiguous_range([float(p) for p in periods]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (
            lambda: maximum_likelihood([30, 36, 42]),
            r"30, 36, 42 periods repeat after 0.1667 .*Gray code",
        ),
        (lambda: maximum_likelihood([64]), "2 to 6 frequencies, got 1"),
        (lambda: maximum_likelihood([1, 2, 3, 4, 5, 6, 7]), "got 7"),
        (lambda: maximum_likelihood([1, 128]), "told apart by 0.00781 cycles"),
        (lambda: cascade([70, 64, 50]), r"70, 64, 50 periods leave 6 periods"),
        (lambda: cascade([70, 64, 59, 50]), "two or three frequencies, got 4"),
        (lambda: hierarchical([2, 16]), "leave 2 periods"),
        (lambda: code_aided([64], codes=63), "63 codes can't settle 64 periods"),
        (lambda: code_aided([], codes=63), "0 periods"),
    ],
)
def test_frequencies_that_cannot_be_unwrapped_are_refused_with_the_way_out(prepare, message):
    with pytest.raises(FrequencyError, match=message):
        prepare()


def test_a_code_longer_than_the_projector_needs_fewer_orders():
    full = maximum_likelihood([120, 112, 105])
    assert full.range_widths == 1.0
    part = maximum_likelihood(REAL)
    assert part.distance_cycles >= full.distance_cycles - 1e-9


def test_noise_gains_of_the_cascade_are_the_known_ones():
    assert stage_noise_gain(cascade([59, 64, 70])) == pytest.approx(15.81, abs=0.005)
    assert stage_noise_gain(cascade([70, 59, 64])) == pytest.approx(15.81, abs=0.005)
    assert stage_noise_gain(hierarchical([1, 8, 64])) == pytest.approx(np.hypot(8, 1))


def test_more_codes_leave_more_to_spare():
    plain, complementary = code_aided([64], codes=64), code_aided([64], codes=128)
    assert complementary.tables.half_code == plain.tables.half_code / 2


def test_tables_are_made_once():
    assert maximum_likelihood([59, 64, 70]) is maximum_likelihood((59.0, 64.0, 70.0))
