"""What a live picture says: counts that add up, and a sharpness that neither exposure nor noise moves."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float

from backend.numerics.live_numbers import live_numbers, mark_extremes, sharpness

H, W = 120, 160


def scene() -> Float[np.ndarray, "h w"]:
    """Blobs and edges, in [gray], well inside the range."""
    rng = np.random.default_rng(5)
    blurred: Float[np.ndarray, "h w"] = cv2.GaussianBlur(rng.uniform(20, 110, (H, W)), (0, 0), 1.0)
    return blurred


def camera(
    light: Float[np.ndarray, "h w"], exposure: float, *, noise: float = 0.0, seed: int = 0
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    gray = light * exposure + noise * np.sqrt(exposure) * rng.standard_normal(light.shape)
    gray8: np.ndarray = np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    return gray8


@given(st.sampled_from([8, 10, 12, 16]), st.integers(0, 2**32 - 1))
def test_counts_add_up(bits: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kind = np.uint8 if bits == 8 else np.uint16
    gray = rng.integers(0, 2**bits, (13, 17)).astype(kind)
    found = live_numbers(gray, bits)

    assert found.histogram.sum() == gray.size
    assert found.mean_gray == pytest.approx(gray.mean())
    assert found.saturated_share == pytest.approx((gray >= 2**bits - 2).mean())
    assert found.black_share == pytest.approx((gray == 0).mean())


def test_a_blurred_picture_is_less_sharp() -> None:
    light = scene()
    found = [
        sharpness(camera(cv2.GaussianBlur(light, (0, 0), sigma), 1.0))
        for sigma in (0.1, 0.7, 1.5, 3.0)
    ]

    assert found == sorted(found, reverse=True)
    assert found[0] > 3 * found[-1]


@pytest.mark.parametrize("exposure", [0.5, 2.0])
def test_the_exposure_does_not_matter(exposure: float) -> None:
    light = scene()

    assert sharpness(camera(light, exposure)) == pytest.approx(
        sharpness(camera(light, 1.0)), rel=0.03
    )


def test_the_black_level_does_not_matter() -> None:
    light = scene()

    assert sharpness(camera(light + 20, 1.0), black_level_gray=20.0) == pytest.approx(
        sharpness(camera(light, 1.0)), rel=0.03
    )


def test_noise_is_not_taken_for_sharpness() -> None:
    """Its mean is 0 even where the picture is nothing but noise, so a darker picture isn't a sharper one."""
    flat = np.full((400, 400), 60.0)
    noisy = [sharpness(camera(flat, 1.0, noise=8.0, seed=k)) for k in range(8)]
    naive = 2 * 2 * 8.0**2 / 60.0**2  # what the mean of squares would say

    assert abs(float(np.mean(noisy))) < 0.02 * naive


def test_what_has_no_sharpness_has_none() -> None:
    assert sharpness(np.zeros((20, 20), np.uint8)) == 0.0
    assert sharpness(np.full((20, 20), 77, np.uint8)) == 0.0
    assert sharpness(np.full((2, 20), 77, np.uint8)) == 0.0


@pytest.mark.parametrize(("level", "colour"), [(255, (226, 48, 48)), (0, (28, 70, 180))])
def test_one_extreme_pixel_is_marked_in_a_smaller_picture(
    level: int, colour: tuple[int, int, int]
) -> None:
    gray = np.full((600, 800), 100, np.uint8)
    gray[301, 402] = level
    marked = mark_extremes(gray, 8, max_px=200)

    assert marked.shape == (150, 200, 3)
    rows, columns = np.nonzero((marked == colour).all(axis=-1))
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(75, 100)]
    assert (marked[0, 0] == 100).all()
