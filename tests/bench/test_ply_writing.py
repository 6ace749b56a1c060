"""How long a large cloud takes to become a file."""

import tempfile

import pytest

from backend.services.ply import write_ply
from tests.unit.test_ply import make_cloud

pytestmark = pytest.mark.bench


def test_three_million_points_are_written_in_less_than_200_ms(benchmark):
    cloud = make_cloud(3_000_000)

    def write() -> None:
        with tempfile.TemporaryFile() as file:
            write_ply(file, cloud)

    benchmark.pedantic(write, rounds=5, warmup_rounds=1)
    assert benchmark.stats.stats.min < 0.2
