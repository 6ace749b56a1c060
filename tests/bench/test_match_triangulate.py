"""Matching and triangulation of 2560x1920, beside an array copy and plain numpy of the same run.

`pytest tests/bench/test_match_triangulate.py -m bench -s` prints the table.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from backend.numerics.camera_model import compose, inverse
from backend.numerics.filters import (
    pixel_angle,
    remove,
    within_limits,
    without_outliers,
    without_specks,
)
from backend.numerics.matching import match
from backend.numerics.normals import normals
from backend.numerics.rectification import Rectification, rectify
from backend.numerics.triangulation import triangulate_pair, triangulate_projector
from backend.numerics.warm_up_geometry import warm_up_kernels
from tests.surfaces import LEFT, PROJECTOR, RIGHT, camera, plane, projector, view

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]

WIDTH, HEIGHT, SIGMA = 2560, 1920, 0.04


@pytest.fixture(scope="module")
def scene() -> dict[str, Any]:
    warm_up_kernels()
    device = camera(WIDTH, HEIGHT)
    left, right = view(plane, device, LEFT), view(plane, device, RIGHT)
    return {
        "camera": device,
        "pose": compose(RIGHT, inverse(LEFT)),
        "left": left.noisy(SIGMA, 1),
        "right": right.noisy(SIGMA, 2),
        "sigma": np.full((HEIGHT, WIDTH), SIGMA, np.float32),
    }


def best_ms(*functions: Callable[[], Any], rounds: int = 7) -> list[float]:
    """Time functions in turn, so that a busy moment hits all of them; the best of the rounds counts."""
    for function in functions:
        function()
    times = [[_elapsed(function) for function in functions] for _ in range(rounds)]
    return [1000 * value for value in np.min(times, axis=0)]


def _elapsed(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


class Copy:
    """Copy 256 MiB: what this machine's memory does at this moment."""

    def __init__(self) -> None:
        self.source, self.target = np.full(1 << 28, 3, np.uint8), np.full(1 << 28, 4, np.uint8)

    def __call__(self) -> None:
        np.copyto(self.target, self.source)


def numpy_match(
    left: np.ndarray, right: np.ndarray, pair: Rectification, rows: slice
) -> np.ndarray:
    """Resample both maps onto the common plane, then sort and interpolate each row, there and back."""
    planes = []
    for values, lattice in ((left, pair.pixel_of_reference), (right, pair.pixel_of_other)):
        x, y = lattice.map()[:, rows]
        column = np.clip(np.floor(x), 0, values.shape[1] - 2).astype(np.int64)
        line = np.clip(np.floor(y), 0, values.shape[0] - 2).astype(np.int64)
        a, b = x - column, y - line
        top = (1 - a) * values[line, column] + a * values[line, column + 1]
        bottom = (1 - a) * values[line + 1, column] + a * values[line + 1, column + 1]
        inside = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        planes.append(np.where(inside, (1 - b) * top + b * bottom, np.nan))
    found = np.full(planes[0].shape, np.nan, np.float32)
    for row, here, there in zip(found, *planes, strict=True):
        place = _interpolated(here, there)
        back = _interpolated(there, here)
        nearest = np.clip(np.nan_to_num(place), 0, back.size - 1).astype(np.int64)
        row[:] = np.where(np.abs(back[nearest] - np.arange(here.size)) < 2, place, np.nan)
    return found


def _interpolated(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return where in `known` each value is."""
    columns = np.flatnonzero(np.isfinite(known))
    if columns.size == 0:
        return np.full(values.size, np.nan)
    order = columns[np.argsort(known[columns])]
    return np.asarray(np.interp(values, known[order], order))


def numpy_triangulate(u: np.ndarray, K: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Intersect rays and projector planes without distortion."""
    y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
    ray = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    normal = P[0, :3] - u[..., None] * P[2, :3]
    depth = (u * P[2, 3] - P[0, 3]) / (ray * normal).sum(axis=-1)
    return np.asarray(ray * depth[..., None])


def report(name: str, value_ms: float, copy_ms: float, note: str = "") -> None:
    print(f"{name:34s} {value_ms:8.1f} ms = {value_ms / copy_ms:5.2f} copies of 256 MiB {note}")


def test_match_and_triangulate(scene: dict[str, Any]) -> None:
    pair = rectify(scene["camera"], scene["camera"], scene["pose"])
    left, right, sigma = scene["left"], scene["right"], scene["sigma"]
    light, pose = projector(), compose(PROJECTOR, inverse(LEFT))
    straight = projector(lens=())
    P = straight.K @ np.column_stack([pose.R, pose.t_mm])
    matches = match(left, right, pair, sigma_reference_px=sigma, sigma_other_px=sigma)
    first = pair.reference.height_px // 2
    part = slice(first, first + HEIGHT // 8)
    copy, matched, plain_match, stereo, flat, bent, plain = best_ms(
        Copy(),
        lambda: match(left, right, pair, sigma_reference_px=sigma, sigma_other_px=sigma),
        lambda: numpy_match(left, right, pair, part),
        lambda: triangulate_pair(matches, pair),
        lambda: triangulate_projector(
            left, scene["camera"], straight, pose, sigma_projector_px=sigma
        ),
        lambda: triangulate_projector(left, scene["camera"], light, pose, sigma_projector_px=sigma),
        lambda: numpy_triangulate(left, scene["camera"].K, P),
    )
    print()
    report("copy", copy, copy)
    report("match", matched, copy, f"{8 * plain_match / matched:.1f} times faster than numpy rows")
    report("triangulate cameras", stereo, copy)
    report("triangulate projector", flat, copy, f"{plain / flat:.1f} times faster than numpy")
    report("triangulate distorting projector", bent, copy)
    # Limits against numpy: a busy processor slows both, but hardly the copy.
    assert matched < 8 * plain_match
    assert flat < plain / 3
    assert bent < plain
    assert stereo < plain / 3


def test_coordinates_to_cloud(scene: dict[str, Any]) -> None:
    """Maps of two cameras -> filtered cloud with normals and sigma, geometry prepared included."""
    device, sigma = scene["camera"], scene["sigma"]
    angle = pixel_angle(device.K)

    pair = rectify(device, device, scene["pose"])

    def chain() -> int:
        pair = rectify(device, device, scene["pose"])
        matches = match(
            scene["left"], scene["right"], pair, sigma_reference_px=sigma, sigma_other_px=sigma
        )
        cloud = triangulate_pair(matches, pair)
        points = cloud.depth_mm
        for kept in (
            within_limits(points, cloud.sigma_mm, highest=1.0),
            without_outliers(points, sigma_mm=cloud.sigma_mm, pixel_angle_rad=angle),
            without_specks(points, least_pixels=50, pixel_angle_rad=angle),
        ):
            remove(points, kept)
        return int(np.isfinite(normals(cloud.points_mm, device)[..., 0]).sum())

    part = slice(pair.reference.height_px // 2, pair.reference.height_px // 2 + HEIGHT // 8)
    copy, whole, plain_match = best_ms(
        Copy(), chain, lambda: numpy_match(scene["left"], scene["right"], pair, part)
    )
    print()
    report("maps -> cloud, normals, sigma", whole, copy)
    assert chain() > 3_500_000
    assert whole < 2 * 8 * plain_match
