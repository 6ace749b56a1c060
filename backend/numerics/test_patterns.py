"""Pictures to set a projector up with: even fields, checkers, focus stars, single-pixel lines, its name and size.

All but the even fields and checkers light the outermost pixels, so that a picture that is cropped or scaled shows at once.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from backend.numerics.errors import PatternError
from backend.numerics.patterns import WHITE

SMALLEST_PX = (64, 48)
"""Width and height below which the pictures' parts would lie on each other."""
LINE_STEP_PX = 16
"""From one single-pixel line of `lines` to the next."""
COARSE_CELL_PX = 32

_SPOKES = 18
"""White sectors of a focus star."""
_WIDTHS_PX = (1, 2, 3, 4)
"""Line widths of the groups between the focus stars."""

TEST_PATTERNS: Mapping[str, str] = MappingProxyType(
    {
        "white": "white everywhere: brightness and evenness of the field",
        "black": "black everywhere: how much light is left",
        "checker": "a checker of single pixels: an even gray, unless the picture is scaled",
        "squares": f"a checker of {COARSE_CELL_PX} px: geometry, and light that bleeds over",
        "focus": "stars in the corners and the middle, groups of fine lines between them: focus",
        "lines": f"single-pixel lines every {LINE_STEP_PX} px and the outermost pixels: scaled, cropped or sharp",
        "identify": "the projector's name and size, with its upper left corner marked",
    }
)
"""What `test_pattern` draws, each with a line about what to look for."""


def test_pattern(
    kind: str,
    width_px: int,
    height_px: int,
    *,
    label: str = "projector",  # noqa: PT028 - this is no test
    cell_px: int | None = None,  # noqa: PT028 - nor is this
) -> UInt8[np.ndarray, "h w"]:
    """Draw a test pattern.

    Parameters
    ----------
    kind
        One of `TEST_PATTERNS`.
    width_px, height_px
        Size of the projector, at least `SMALLEST_PX`.
    label
        What `identify` writes above the size; characters that its font hasn't become `?`.
    cell_px
        Width of a square of `checker` and `squares` in [px], >= 1. None: 1 and `COARSE_CELL_PX`.

    Raises
    ------
    PatternError
        If there is no such kind, or the size is too small.

    Examples
    --------
    >>> int(test_pattern("checker", 64, 48).astype(int).sum()) == 255 * 64 * 48 // 2
    True
    """
    if kind not in TEST_PATTERNS:
        raise PatternError(f"there is no test pattern {kind!r}: choose {', '.join(TEST_PATTERNS)}")
    least_width, least_height = SMALLEST_PX
    if width_px < least_width or height_px < least_height:
        raise PatternError(
            f"a test pattern of {width_px} x {height_px} px is too small: give {least_width} x {least_height} px or more"
        )
    if cell_px is not None and cell_px < 1:
        raise PatternError(f"squares of {cell_px} px can't be drawn: give 1 px or more")
    if kind == "identify":
        return _identify(width_px, height_px, label)
    if kind in ("checker", "squares"):
        return _checker(
            width_px, height_px, cell_px or (1 if kind == "checker" else COARSE_CELL_PX)
        )
    return _DRAWN[kind](width_px, height_px)


# pytest collects functions by this prefix wherever they are imported.
test_pattern.__test__ = False  # type: ignore[attr-defined]  # an attribute that only pytest reads


def _white(width_px: int, height_px: int) -> UInt8[np.ndarray, "h w"]:
    return np.full((height_px, width_px), WHITE, np.uint8)


def _black(width_px: int, height_px: int) -> UInt8[np.ndarray, "h w"]:
    return np.zeros((height_px, width_px), np.uint8)


def _checker(width_px: int, height_px: int, cell_px: int) -> UInt8[np.ndarray, "h w"]:
    rows, columns = np.indices((height_px, width_px), sparse=True)
    return _lit((rows // cell_px + columns // cell_px) % 2 == 0)


def _lines(width_px: int, height_px: int) -> UInt8[np.ndarray, "h w"]:
    rows, columns = np.indices((height_px, width_px), sparse=True)
    lit = (rows % LINE_STEP_PX == 0) | (columns % LINE_STEP_PX == 0)
    return _framed(_lit(lit))


def _focus(width_px: int, height_px: int) -> UInt8[np.ndarray, "h w"]:
    """Draw a third of the height each: stars, line groups and the middle star, stars."""
    picture = _black(width_px, height_px)
    size_px = min(width_px, height_px) // 3 - 2
    right_px, bottom_px = width_px - 1 - size_px, height_px - 1 - size_px
    middle_x, middle_y = (width_px - size_px) // 2, (height_px - size_px) // 2
    star = _star(size_px)
    for top, left in (
        (1, 1),
        (1, right_px),
        (bottom_px, 1),
        (bottom_px, right_px),
        (middle_y, middle_x),
    ):
        picture[top : top + size_px, left : left + size_px] = star
    for columns in (slice(2, middle_x - 2), slice(middle_x + size_px + 2, width_px - 2)):
        _draw_groups(picture[middle_y : middle_y + size_px, columns])
    return _framed(picture)


def _star(size_px: int) -> UInt8[np.ndarray, "h w"]:
    """Draw sectors that narrow towards the centre: where they run into gray, the picture is as sharp as that."""
    place = np.arange(size_px) - (size_px - 1) / 2
    x, y = place[np.newaxis, :], place[:, np.newaxis]
    inside = np.hypot(x, y) <= size_px / 2
    return _lit(inside & (np.sin(_SPOKES * np.arctan2(y, x)) >= 0))


def _draw_groups(field: UInt8[np.ndarray, "h w"]) -> None:
    """Fill the upper half with upright lines, the lower one with level ones, each width beside the next."""
    height_px, width_px = field.shape
    share_px = width_px // len(_WIDTHS_PX)
    half_px = height_px // 2
    for number, line_px in enumerate(_WIDTHS_PX):
        left = number * share_px
        group_px = max(share_px - 2, 1)
        across = np.arange(group_px) // line_px % 2 == 0
        down = np.arange(max(half_px - 2, 1)) // line_px % 2 == 0
        field[: down.size, left : left + group_px] = _lit(across)[np.newaxis, :]
        field[half_px : half_px + down.size, left : left + group_px] = _lit(down)[:, np.newaxis]


def _identify(width_px: int, height_px: int, label: str) -> UInt8[np.ndarray, "h w"]:
    """Write name and size large; a filled corner says where up and left are."""
    picture = _black(width_px, height_px)
    corner_px = min(width_px, height_px) // 6
    cv2.fillConvexPoly(picture, np.array([[0, 0], [corner_px, 0], [0, corner_px]]), WHITE)
    third_px = height_px // 3
    _write(picture[third_px - third_px // 2 : third_px + third_px // 2], label)
    _write(
        picture[2 * third_px - third_px // 2 : 2 * third_px + third_px // 2],
        f"{width_px} x {height_px}",
    )
    if corner_px >= 24:
        # Words only where there is room: the corner says the same.
        edge_px = corner_px // 2
        _write(picture[4 : 4 + edge_px, corner_px + 4 : width_px // 2], "UP + LEFT")
    return _framed(picture)


def _write(field: UInt8[np.ndarray, "h w"], text: str) -> None:
    """Write one line in the middle of a field, as large as it allows."""
    height_px, width_px = field.shape
    shown = text.encode("ascii", "replace").decode("ascii").replace("\n", " ") or "?"
    font = cv2.FONT_HERSHEY_SIMPLEX
    (wide, high), base = cv2.getTextSize(shown, font, 10.0, 1)
    scale = 10.0 * 0.86 * min(width_px / wide, height_px / (high + base))
    thickness = max(1, round(scale * 2.0))
    (wide, high), base = cv2.getTextSize(shown, font, scale, thickness)  # base: below the line
    # OpenCV needs contiguous rows of its own: a view into a larger picture is drawn aside and put back.
    drawn = np.zeros((height_px, width_px), np.uint8)
    origin = ((width_px - wide) // 2, (height_px + high - base) // 2)
    cv2.putText(drawn, shown, origin, font, scale, WHITE, thickness)
    np.maximum(field, drawn, out=field)


def _framed(picture: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    picture[[0, -1], :] = WHITE
    picture[:, [0, -1]] = WHITE
    return picture


def _lit(where: Bool[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.where(where, WHITE, 0).astype(np.uint8)


_DRAWN: Mapping[str, Callable[[int, int], UInt8[np.ndarray, "h w"]]] = {
    "white": _white,
    "black": _black,
    "focus": _focus,
    "lines": _lines,
}
