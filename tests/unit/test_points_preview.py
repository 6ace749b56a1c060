"""Clouds made small enough for the screen."""

import itertools
import json
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jaxtyping import Float, UInt8

from app.client import unpack_points
from backend.domain.errors import NotFoundError
from backend.domain.hints import Points, Scalar
from backend.services.points import pack_points
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.codec import encode


@dataclass(frozen=True)
class GridCloud:
    points_mm: Annotated[
        Float[np.ndarray, "n 3"], Points("Cloud", colour="rgb", scalars=("sigma_mm", "order"))
    ]
    rgb: UInt8[np.ndarray, "n 3"] | None
    sigma_mm: Annotated[Float[np.ndarray, "n"], Scalar("Noise", unit="mm")]
    order: Float[np.ndarray, "n"]
    pixel_x: Float[np.ndarray, "n"] | None = None
    pixel_y: Float[np.ndarray, "n"] | None = None


def cloud(width: int, height: int, *, pixels: bool = True, colour: bool = True) -> GridCloud:
    y, x = (v.ravel().astype(np.float32) for v in np.mgrid[:height, :width])
    points = np.stack([x, y, x * 0], axis=1)
    rgb = np.stack([x % 256, y % 256, x * 0], axis=1).astype(np.uint8) if colour else None
    return GridCloud(points, rgb, x / 10, y, x if pixels else None, y if pixels else None)


def packed(result: GridCloud, store: LocalArtifactStore, budget: int, **options: Any) -> Any:
    document = encode(result, store)
    return unpack_points(
        pack_points(GridCloud, document, "points_mm", store, budget=budget, **options)
    )


def test_the_station_reads_what_is_packed(store: LocalArtifactStore) -> None:
    body = pack_points(GridCloud, encode(cloud(4, 3), store), "points_mm", store, budget=1000)
    length = int.from_bytes(body[:4], "little")
    header = json.loads(body[4 : 4 + length])
    assert header["n"] == header["total"] == 12
    assert header["colour"] is True
    assert header["scalars"]["sigma_mm"]["unit"] == "mm"
    assert header["scalars"]["order"]["title"] == "order"
    read = unpack_points(body)
    assert read.points_mm.tolist() == cloud(4, 3).points_mm.tolist()
    assert read.colour is not None
    assert read.colour.tolist() == np.asarray(cloud(4, 3).rgb).tolist()


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    width=st.integers(1, 80),
    height=st.integers(1, 80),
    budget=st.integers(1, 3000),
    pixels=st.booleans(),
)
def test_the_budget_holds_and_isnt_wasted(
    store: LocalArtifactStore, width: int, height: int, budget: int, pixels: bool
) -> None:
    total = width * height
    read = packed(cloud(width, height, pixels=pixels), store, budget)
    assert read.total == total
    assert len(read.points_mm) == min(total, budget)


def test_thinning_keeps_every_kth_row_and_column(store: LocalArtifactStore) -> None:
    read = packed(cloud(60, 40), store, 15 * 10)
    columns, rows = np.unique(read.points_mm[:, 0]), np.unique(read.points_mm[:, 1])
    assert (np.diff(columns).tolist(), np.diff(rows).tolist()) == ([4.0] * 14, [4.0] * 9)
    assert read.colour is not None
    assert np.array_equal(read.colour[:, 0], read.points_mm[:, 0].astype(np.uint8)), (
        "colours follow their points"
    )


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    width=st.integers(1, 80),
    height=st.integers(1, 80),
    budgets=st.lists(st.integers(1, 7000), min_size=2, max_size=4, unique=True).map(sorted),
    pixels=st.booleans(),
)
def test_a_cloud_comes_level_by_level(
    store: LocalArtifactStore, width: int, height: int, budgets: list[int], pixels: bool
) -> None:
    """Coarse points and what is beyond them are, together, what the larger budget brings at once."""
    whole = cloud(width, height, pixels=pixels)
    read = packed(whole, store, budgets[0])
    for smaller, larger in itertools.pairwise(budgets):
        read = read.with_more(packed(whole, store, larger, beyond=smaller))
    at_once = packed(whole, store, budgets[-1])
    assert read.total == at_once.total
    assert sorted(map(tuple, read.points_mm)) == sorted(map(tuple, at_once.points_mm))
    assert np.array_equal(read.scalars[0].values, read.points_mm[:, 0] / np.float32(10))
    assert read.colour is not None
    assert np.array_equal(read.colour[:, 0], read.points_mm[:, 0].astype(np.uint8))


def test_points_that_arent_finite_are_left_out(store: LocalArtifactStore) -> None:
    result = cloud(4, 4)
    result.points_mm[3] = np.nan
    assert len(packed(result, store, 100).points_mm) == 15


def test_one_scalar_may_be_asked_for(store: LocalArtifactStore) -> None:
    read = packed(cloud(4, 4), store, 100, scalar="order")
    assert [s.name for s in read.scalars] == ["order"]
    with pytest.raises(
        NotFoundError, match="points_mm has no scalar 'height'; it has sigma_mm, order"
    ):
        packed(cloud(4, 4), store, 100, scalar="height")


def test_a_cloud_without_colour(store: LocalArtifactStore) -> None:
    assert packed(cloud(4, 4, colour=False), store, 100).colour is None


def test_an_empty_cloud(store: LocalArtifactStore) -> None:
    assert len(packed(cloud(0, 0), store, 100).points_mm) == 0


def test_a_field_that_is_no_cloud_is_named(store: LocalArtifactStore) -> None:
    with pytest.raises(NotFoundError, match="GridCloud has no points 'sigma_mm'"):
        pack_points(GridCloud, encode(cloud(2, 2), store), "sigma_mm", store, budget=10)
