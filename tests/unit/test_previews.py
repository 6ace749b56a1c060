"""Pictures for the screen: sizes, colours, limits, what is missing."""

from typing import Any

import cv2
import numpy as np
import pytest

from app import palette
from backend.contract.colours import BACKGROUND_RGB
from backend.domain.errors import InvalidSettingError, NotFoundError
from backend.services.live_pictures import live_jpeg
from backend.services.previews import draw, value_at


def seen(picture: bytes) -> np.ndarray[Any, Any]:
    """Decode as a browser does: RGB, or RGBA where something is transparent."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    if pixels.shape[2] == 4:
        return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def test_gray_runs_from_low_to_high() -> None:
    ramp = np.linspace(-1, 2, 7, dtype=np.float32)[None, :]
    assert seen(draw(ramp, low=0.0, high=1.0))[0, :, 0].tolist() == [0, 0, 0, 127, 255, 255, 255]


@pytest.mark.parametrize(
    ("dtype", "top", "white"),
    [(np.uint8, 100, 255), (np.uint16, 1000, 1023), (np.uint16, 4095, 4095)],
)
def test_frames_are_scaled_to_the_full_scale_not_to_their_content(
    dtype: Any, top: int, white: int
) -> None:
    frame = np.array([[0, top]], dtype)
    assert seen(draw(frame))[0, :, 0].tolist() == [0, int(top * 255 / white)]


def test_maps_are_scaled_to_their_percentiles() -> None:
    values = np.linspace(0, 100, 10_001, dtype=np.float32).reshape(73, 137)
    values[0, 0] = 1e9
    gray = seen(draw(values))[..., 0]
    assert gray.min() == 0
    assert np.median(gray) == pytest.approx(127, abs=2)


def test_what_is_missing_is_transparent_or_dark() -> None:
    values = np.array([[0.0, np.nan], [np.inf, 1.0]], np.float32)
    assert seen(draw(values))[..., 3].tolist() == [[255, 0], [0, 255]]
    big = np.full((64, 64), np.nan, np.float32)
    assert np.abs(seen(draw(big, format="jpeg")).astype(int) - BACKGROUND_RGB).max() <= 3


@pytest.mark.parametrize("name", ["gray", "turbo", "viridis", "twilight", "inferno"])
def test_colours_are_those_of_the_legend(name: str) -> None:
    ramp = np.arange(256, dtype=np.float32)[None, :]
    drawn = seen(draw(ramp, low=0.0, high=255.0, colormap=name))[0]
    assert np.array_equal(drawn, palette.colours(name))


def test_an_unknown_colour_map_is_named() -> None:
    with pytest.raises(InvalidSettingError, match="no colour map 'jet'; there are gray, turbo"):
        draw(np.zeros((2, 2)), colormap="jet")


def test_labels_have_the_colours_of_the_legend() -> None:
    labels = np.arange(11, dtype=np.int32)[None, :]
    drawn = seen(draw(labels, kind="mask"))[0]
    assert drawn[0, 3] == 0, "0 is nothing"
    for label in range(1, 11):
        assert tuple(drawn[label, :3]) == palette.rgb(palette.label_colour(label))


def test_a_boolean_mask_is_one_label() -> None:
    drawn = seen(draw(np.array([[False, True]]), kind="mask"))[0]
    assert (drawn[0, 3], tuple(drawn[1, :3])) == (0, palette.rgb(palette.label_colour(1)))


def test_large_maps_are_made_smaller_without_mixing_holes_in() -> None:
    values = np.zeros((100, 400), np.float32)
    values[:, ::2] = np.nan
    drawn = seen(draw(values, max_px=40, low=0.0, high=1.0))
    assert drawn.shape[:2] == (10, 40)
    frame = np.zeros((100, 400), np.uint8)
    frame[:, ::2] = 200
    assert np.abs(seen(draw(frame, max_px=40))[..., 0].astype(int) - 100).max() <= 1, (
        "gray levels are averaged"
    )
    assert seen(draw(values[:3, :3], max_px=40)).shape[:2] == (3, 3), "never made larger"


def test_colour_pictures_pass_through() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    assert np.array_equal(seen(draw(rgb)), rgb)


@pytest.mark.parametrize("shape", [(), (2, 2, 2), (2, 2, 2, 2)])
def test_what_is_no_picture_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidSettingError, match="can't be drawn: it has to be height x width"):
        draw(np.zeros(shape))


def test_a_map_without_any_value_is_drawn_all_the_same() -> None:
    assert seen(draw(np.full((2, 2), np.nan)))[..., 3].max() == 0
    assert seen(draw(np.full((2, 2), 3.0))).shape == (2, 2, 3)


def test_live_pictures_have_full_scale_as_white() -> None:
    picture = seen(live_jpeg(np.full((32, 32), 2048, np.uint16), 12))
    assert np.abs(picture.astype(int) - 127).max() <= 2


def test_a_pixel_says_its_value() -> None:
    values = np.array([[1.5, np.nan], [2.5, np.inf]], np.float32)
    assert [value_at(values, x, y) for y in (0, 1) for x in (0, 1)] == [1.5, None, 2.5, None]
    assert value_at(np.array([[3]], np.uint8), 0, 0) == 3
    assert value_at(np.array([[[1, 2, 3]]], np.uint8), 0, 0) == [1, 2, 3]
    for x, y in ((2, 0), (0, 2), (-1, 0)):
        with pytest.raises(NotFoundError, match=f"has no pixel at x {x}, y {y}"):
            value_at(values, x, y)
