import numpy as np
import pytest

from backend.numerics.errors import PatternError
from backend.numerics.test_patterns import (
    COARSE_CELL_PX,
    LINE_STEP_PX,
    TEST_PATTERNS,
    test_pattern,
)

SIZES = [(64, 48), (65, 49), (160, 100), (101, 203), (912, 1140), (1280, 800), (1921, 1081)]


@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[0]}x{s[1]}")
@pytest.mark.parametrize("kind", TEST_PATTERNS)
def test_every_pattern_has_the_projectors_size_two_levels_and_is_the_same_twice(kind, size):
    width, height = size
    picture = test_pattern(kind, width, height)
    assert picture.shape == (height, width)
    assert picture.dtype == np.uint8
    if (
        kind != "identify"
    ):  # letters are written without smoothing, too, but that is the font's matter
        assert set(np.unique(picture).tolist()) <= {0, 255}
    np.testing.assert_array_equal(picture, test_pattern(kind, width, height))


@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[0]}x{s[1]}")
@pytest.mark.parametrize("kind", ["white", "focus", "lines", "identify"])
def test_the_outermost_pixels_are_lit(kind, size):
    picture = test_pattern(kind, *size)
    assert (picture[[0, -1], :] == 255).all()
    assert (picture[:, [0, -1]] == 255).all()


@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[0]}x{s[1]}")
def test_lines_are_one_pixel_wide_and_counted(size):
    width, height = size
    picture = test_pattern("lines", width, height)
    between = picture[LINE_STEP_PX // 2] == 255  # a row between two level lines
    wanted = sorted({*range(0, width, LINE_STEP_PX), width - 1})
    assert np.flatnonzero(between).tolist() == wanted
    beside = picture[:, LINE_STEP_PX // 2] == 255
    assert np.flatnonzero(beside).tolist() == sorted({*range(0, height, LINE_STEP_PX), height - 1})


def test_even_fields_are_even():
    assert (test_pattern("white", 70, 50) == 255).all()
    assert (test_pattern("black", 70, 50) == 0).all()


@pytest.mark.parametrize(("kind", "cell"), [("checker", 1), ("squares", COARSE_CELL_PX)])
def test_neighbouring_squares_of_a_checker_differ(kind, cell):
    picture = test_pattern(kind, 160, 100)
    assert (picture[:, cell:] != picture[:, :-cell]).all()
    assert (picture[cell:] != picture[:-cell]).all()
    assert (picture[:cell, :cell] == picture[0, 0]).all()
    np.testing.assert_array_equal(picture, test_pattern("checker", 160, 100, cell_px=cell))


@pytest.mark.parametrize("size", [(160, 100), (912, 1140), (1280, 800)])
def test_focus_has_a_star_in_each_corner_and_the_middle(size):
    """Half of a star's disc is lit, whatever part of the picture it stands in."""
    width, height = size
    picture = test_pattern("focus", width, height)
    part = min(width, height) // 3 - 2
    middle_y, middle_x = (height - part) // 2, (width - part) // 2
    bottom, right = height - 1 - part, width - 1 - part
    for top, left in ((1, 1), (1, right), (bottom, 1), (bottom, right), (middle_y, middle_x)):
        star = picture[top + 1 : top + part - 1, left + 1 : left + part - 1]
        assert (star == 255).mean() == pytest.approx(np.pi / 8, rel=0.12)


def test_focus_has_lines_of_one_pixel_both_ways():
    picture = test_pattern("focus", 912, 1140) == 255
    upright = (picture[:, 1:-1] & ~picture[:, :-2] & ~picture[:, 2:]).sum()
    level = (picture[1:-1] & ~picture[:-2] & ~picture[2:]).sum()
    assert min(upright, level) > 5000


def test_identify_tells_up_left_from_every_other_corner_and_projectors_apart():
    picture = test_pattern("identify", 640, 480, label="left wall")
    block = 40
    lit = {
        (row, column): picture[rows, columns].mean()
        for row, rows in enumerate((slice(0, block), slice(-block, None)))
        for column, columns in enumerate((slice(0, block), slice(-block, None)))
    }
    assert lit[0, 0] > 250
    assert max(value for corner, value in lit.items() if corner != (0, 0)) < 30
    assert (picture != test_pattern("identify", 640, 480, label="right wall")).any()


@pytest.mark.parametrize("label", ["", "Beamer größer", "a\nb", "x" * 200])
def test_any_label_is_written(label):
    assert test_pattern("identify", 64, 48, label=label).shape == (48, 64)


def test_the_text_is_large():
    """Readable across the room: a tenth of the height, most of the width."""
    picture = test_pattern("identify", 1280, 800, label="projector")
    inner = picture[180:350, 2:-2]
    rows, columns = np.nonzero(inner)
    assert np.ptp(rows) > 80
    assert np.ptp(columns) > 600


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("stars", 64, 48), "there is no test pattern 'stars': choose white, black"),
        (("white", 63, 48), "63 x 48 px is too small"),
        (("white", 64, 47), "64 x 47 px is too small"),
    ],
)
def test_refusals_are_one_sentence(arguments, sentence):
    with pytest.raises(PatternError, match=sentence):
        test_pattern(*arguments)


def test_squares_need_a_width():
    with pytest.raises(PatternError, match="squares of 0 px"):
        test_pattern("checker", 64, 48, cell_px=0)
