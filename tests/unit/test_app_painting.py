"""What the station does with painted pictures, search maps and response curves, without a browser."""

from typing import Any

import numpy as np
import pytest

from app.panels.paint import factors, tinted
from app.views.axes import Axes
from app.views.painting import Canvas, Tool, shape
from app.views.response import lines, note
from backend.contract.scans import ArtifactRef, FieldView, PixelLevels, SettingView, StageState
from backend.domain.states import StageStatus

BASE = np.full((40, 60), 0.8, np.float32)


@pytest.mark.parametrize(
    ("tool", "path", "area_px"),
    [
        ("rectangle", [(10.0, 5.0), (19.0, 8.0)], 40),
        ("rectangle", [(19.0, 8.0), (10.0, 5.0)], 40),
        ("ellipse", [(10.0, 5.0), (30.0, 25.0)], np.pi * 10 * 10),
        ("brush", [(20.0, 20.0), (40.0, 20.0)], 20 * 10 + np.pi * 25),
        ("brush", [(20.0, 20.0)], np.pi * 25),
    ],
    ids=["rectangle", "drawn backwards", "ellipse", "brush", "dot"],
)
def test_a_stroke_covers_its_shape(tool: Tool, path: Any, area_px: float) -> None:
    covered = shape((40, 60), tool, path, radius_px=5.0)
    assert covered.sum() == pytest.approx(area_px, rel=0.2)
    rows, columns = np.nonzero(covered)
    middle = np.mean([path[0], path[-1]], axis=0)
    assert (columns.mean(), rows.mean()) == pytest.approx(tuple(middle), abs=0.6)


@pytest.mark.parametrize("tool", ["brush", "rectangle", "ellipse"])
def test_a_stroke_beyond_the_picture_paints_what_is_inside(tool: Tool) -> None:
    assert shape((40, 60), tool, [(-50.0, -50.0), (20.0, 20.0)], radius_px=4.0)[5, 5]
    assert not shape((40, 60), tool, [(-50.0, -50.0), (-20.0, -20.0)], radius_px=4.0).any()


def test_paint_lies_over_what_was_found_and_can_be_taken_back() -> None:
    canvas = Canvas(BASE)
    canvas.stroke("rectangle", [(0.0, 0.0), (9.0, 9.0)], radius_px=1.0, factor=0.3)
    canvas.stroke("rectangle", [(0.0, 0.0), (4.0, 9.0)], radius_px=1.0, factor=None)
    assert np.isnan(canvas.painted[5, 2])
    assert (canvas.whole[5, 2], canvas.whole[5, 7]) == pytest.approx((0.8, 0.3))
    assert canvas.strokes == 2
    canvas.undo()
    assert canvas.whole[5, 2] == pytest.approx(0.3)
    canvas.scale(2.0)
    assert (canvas.whole[5, 2], canvas.whole[30, 30]) == pytest.approx((0.6, 1.0))
    canvas.undo()
    canvas.undo()
    canvas.undo()
    assert np.isnan(canvas.painted).all()
    assert np.isnan(Canvas(BASE).painted).all()


def test_only_so_many_strokes_are_remembered() -> None:
    canvas = Canvas(BASE)
    for n in range(60):
        canvas.stroke("brush", [(float(n), 3.0)], radius_px=1.0, factor=0.5)
    assert canvas.strokes == 40


def test_labels_become_factors_and_paint_is_seen() -> None:
    assert factors(np.array([[0, 3]], np.uint8)).tolist() == [[0.0, 1.0]]
    assert np.isnan(factors(np.array([[np.nan]]))).all()
    picture = np.full((2, 2, 3), 90, np.uint8)
    drawn = tinted(picture, np.array([[np.nan, 0.0]], np.float32))
    assert drawn[0, 0].tolist() == [90, 90, 90]
    assert drawn[0, 1].tolist() != [90, 90, 90]


class Arrays:
    """Has arrays as the API's client does."""

    def __init__(self, **arrays: Any) -> None:
        self._arrays = {name: np.asarray(values) for name, values in arrays.items()}

    def array(self, artifact: str) -> Any:
        return self._arrays[artifact]


def a_stage(value: Any = None, **hint: Any) -> tuple[StageState, FieldView]:
    def data(name: str) -> FieldView:
        reference = ArtifactRef(hash=name, shape=(1,), dtype="<f8")
        return FieldView(name=name, hint={"kind": "data"}, per_camera=False, arrays={"": reference})

    cost = FieldView(
        name="cost",
        hint={"kind": "picture", "title": "Cost", "x": "low_gray", "y": "high_gray"} | hint,
        per_camera=False,
    )
    chosen = FieldView(name="chosen", hint={"kind": "data"}, per_camera=False, value=[20.0, 250.0])
    stage = StageState(
        name="s", title="S", status=StageStatus.DONE, message="", key=None, stage_run=None, take=0,
        settings={"pair": SettingView(value=value, source="edited" if value else "default")},
        fields=(cost, chosen, data("low_gray"), data("high_gray")),
    )  # fmt: skip
    return stage, cost


ARRAYS: Any = Arrays(low_gray=[10.0, 20.0, 30.5], high_gray=[250.0, 200.0])


def test_a_map_over_two_settings_knows_its_values() -> None:
    axes = Axes.of(ARRAYS, *a_stage(point="chosen", edits="pair"))
    assert axes is not None
    assert axes.setting == "pair"
    assert axes.point == (20.0, 250.0)
    assert axes.pixel_of(20.0, 250.0) == (1.0, 0.0)
    assert axes.pixel_of(15.0, 225.0) == (0.5, 0.5)
    assert axes.value_at(1.4, 0.6) == [20, 200]
    assert axes.value_at(-3, 99) == [10, 200]
    assert axes.rows(2, 0) == [("Low", "30.5 gray"), ("High", "250 gray")]


def test_the_edited_point_counts_and_other_pictures_have_no_axes() -> None:
    axes = Axes.of(ARRAYS, *a_stage([30.5, 200], point="chosen", edits="pair"))
    assert axes is not None
    assert axes.point == (30.5, 200.0)
    unknown = Axes.of(ARRAYS, *a_stage(point="chosen", edits="another"))
    assert unknown is not None
    assert unknown.setting is None
    assert Axes.of(ARRAYS, *a_stage(x="missing")) is None


def levels(**changes: Any) -> PixelLevels:
    values: dict[str, Any] = {
        "camera": "left", "x": 1, "y": 2, "axis": (150.0, 50.0, 100.0), "gray": (255.0, 90.0, 180.0), "exposure_ms": (1.0,) * 3,
        "full_scale_gray": 255.0, "slope": 1.8, "offset": 0.0,
    }  # fmt: skip
    return PixelLevels(**(values | changes))


def test_gray_levels_come_in_the_order_of_the_axis_with_their_line() -> None:
    x, gray, line = lines(levels())
    assert (x.tolist(), gray.tolist()) == ([50.0, 100.0, 150.0], [90.0, 180.0, 255.0])
    assert line == pytest.approx([90.0, 180.0, 270.0])
    assert "slope 1.8, offset 0 gray, 1 saturated" in note(levels())


def test_a_pixel_without_line_or_axis_is_shown_all_the_same() -> None:
    x, gray, line = lines(levels(axis=None, slope=None))
    assert (x.tolist(), gray.tolist()) == ([0.0, 1.0, 2.0], [255.0, 90.0, 180.0])
    assert line.tolist() == gray.tolist()
    assert "no line" in note(levels(slope=None))
