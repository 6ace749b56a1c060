"""The views: one per kind of hint, numbers in words, colours, picking."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app import markup
from app.client import PointsPreview, ScalarOfPoints
from app.numbers import duration, heading, named, number, percent, quantity
from app.palette import colours, paint, stops
from app.space import LYING, UNIT, Placement
from app.views.frames import FrameMenu, pattern_text
from app.views.histogram import Counts, chips_html
from app.views.mask import Labels, crisp, draw, share, shrunk
from app.views.picture import range_of
from app.views.points import colours as point_colours
from app.views.points import find_ground, hit, modes, spacing_mm
from app.views.table import table_html
from app.views.value import fact_rows
from backend.contract.scans import ArtifactRef, FieldView, FrameRef

EVIL = '<img src=x onerror="x">'


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"), (float("nan"), "–"), (True, "yes"), ("so", "so"), (304367, "304\u202f367"), (41.666667, "41.67"),
        (0.00002, "2e-05"), (-1.041, "-1.041"), (12.0, "12"), (1234.5678, "1\u202f235"), (0.0, "0"),
    ],
)  # fmt: skip
def test_numbers_in_words(value: object, text: str) -> None:
    assert number(value) == text


def test_quantities_carry_their_unit() -> None:
    assert quantity([8.333333, 25.0], "ms") == "8.333 / 25 ms"
    assert quantity(None, "ms") == "–"
    assert (percent(0.98712), percent(0.00002)) == ("98.7 %", "0.002 %")
    assert (named("saturated_share", 0.25), named("peak_gray", 29.0, "gray")) == ("25 %", "29 gray")
    assert heading("brightest_gray") == ("brightest", "gray")
    assert [duration(s) for s in (0.84, 42.4, 135.0, 7300.0)] == [
        "0.8 s",
        "42 s",
        "2 min 15 s",
        "2 h 1 min",
    ]


def test_whatever_is_shown_is_escaped() -> None:
    drawn = [
        markup.chip(EVIL), markup.facts([(EVIL, EVIL)]), markup.table([(EVIL, EVIL)], [[EVIL]]), markup.section(EVIL, "", note=EVIL),
        markup.legend([("#000000", EVIL, EVIL)]), markup.gradient_bar(["#000000"], EVIL, EVIL, EVIL),
        markup.tag("a", "x", href=EVIL), table_html({EVIL: EVIL}), table_html([{EVIL: EVIL}]),
    ]  # fmt: skip

    assert [html for html in drawn if "<img" in html] == []


def test_facts_are_numbers_texts_and_one_per_camera() -> None:
    fields = [
        FieldView(name="t_ms", hint={"title": "Time", "unit": "ms", "digits": 3}, per_camera=False, value=1.23456),
        FieldView(name="n", hint={"title": "N"}, per_camera=True, value={"left": 1, "right": None}),
        FieldView(name="lit_share", hint={"title": "Lit"}, per_camera=False, value=0.5),
    ]  # fmt: skip

    assert fact_rows(fields) == [("Time", "1.23 ms"), ("N", "left 1 · right –"), ("Lit", "50 %")]


# ---- histogram


@pytest.mark.parametrize(
    ("borders", "peaks", "zones"),
    [
        ((10.0, 100.0, 200.0), (50.0, 150.0), [(10.0, 100.0), (100.0, 200.0)]),
        ((100.0,), (50.0, 150.0), [(0.0, 100.0), (100.0, 255.0)]),
        ((10.0, 200.0), None, [(10.0, 200.0)]),
        ((), None, []),
    ],
)
def test_borders_with_and_without_ends(
    borders: tuple[float, ...], peaks: tuple[float, ...] | None, zones: list[tuple[float, float]]
) -> None:
    assert Counts(np.ones(256), borders=borders, peaks=peaks).zones() == zones


@given(st.lists(st.integers(0, 255), min_size=2, max_size=8, unique=True))
def test_zones_share_out_every_pixel_between_the_ends_once(levels: list[int]) -> None:
    borders = tuple(float(v) for v in sorted(levels))
    counts = np.random.default_rng(1).integers(0, 100, 256).astype(float)
    inside = counts[int(borders[0]) : int(borders[-1]) + 1].sum()

    assert sum(Counts(counts, borders=borders).shares()) == pytest.approx(inside / counts.sum())


def test_each_zone_gets_a_chip() -> None:
    html = chips_html(Counts(np.ones(256), borders=(0.0, 100.0, 255.0)))

    assert html.count("ug-zone-range") == 2
    assert "0–100" in html


# ---- masks


def test_bits_are_told_apart_and_counted() -> None:
    labels = Labels.of({"labels": {"1": "dark", "4": "edge"}, "bits": True})
    values = np.array([[0, 1, 5], [4, 4, 0]], np.uint8)

    assert labels.present(values) == [1, 4]
    assert labels.reasons(5) == ["dark", "edge"]
    assert labels.reasons(0) == []
    assert share(labels, 4, values) == pytest.approx(3 / 6)


def test_labels_without_text_are_numbers() -> None:
    labels = Labels.of({"labels": {}, "bits": False})

    assert labels.present(np.array([[0, 1, 3]])) == [1, 3]
    assert (labels.reasons(3), labels.reasons(0)) == (["3"], [])


@given(st.integers(0, 99), st.integers(0, 79), st.integers(1, 100))
def test_shrinking_loses_no_bit(x: int, y: int, max_px: int) -> None:
    values = np.zeros((80, 100), np.uint8)
    values[y, x] = 4
    labels = Labels({4: "edge"}, bits=True)
    step = -(-100 // max_px)
    whole = y < 80 - 80 % step and x < 100 - 100 % step  # what doesn't fill a block is cut off

    assert bool((shrunk(labels, values, max_px) == 4).any()) == (whole or step == 1)


def test_labels_are_drawn_in_their_colours_over_the_picture() -> None:
    labels = Labels({1: "lit"})
    drawn = draw(labels, np.array([[0, 1]], np.uint8), np.array([[200, 200]], np.uint8))

    assert drawn[0, 0].tolist() == [110, 110, 110]
    assert drawn[0, 1, 2] > drawn[0, 1, 0] + 50  # the first label is blue


def test_a_small_picture_keeps_square_pixels_when_it_is_enlarged() -> None:
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)

    assert np.array_equal(crisp(picture, 7)[::3, ::3], picture)


# ---- pictures and frames


def test_colours_end_where_the_hint_says_or_at_percentiles() -> None:
    values = np.linspace(0.0, 100.0, 10_000).reshape(100, 100)
    values[0, 0] = np.nan

    assert range_of([], -1.0, 1.0).low == -1.0
    assert range_of([values], None, None).low == pytest.approx(1.0, abs=0.1)
    assert range_of([values], None, 50.0).high == 50.0
    assert range_of([np.full((4, 4), np.nan)], None, None).high > 0.0


def test_painting_keeps_holes_apart_from_colours() -> None:
    painted = paint(np.array([0.0, 1.0, np.nan]), 0.0, 1.0, "turbo")

    assert painted[0].tolist() == colours("turbo")[0].tolist()
    assert painted[1].tolist() == colours("turbo")[255].tolist()
    assert painted[2].tolist() == [22, 25, 30]
    assert stops("gray", 2) == ["#000000", "#ffffff"]


def _frame(camera: str, exposure_ms: float | None, step: int) -> FrameRef:
    image = ArtifactRef(hash="0" * 16, shape=(4, 4), dtype="uint8")
    pattern = {"kind": "sine", "axis": "x", "periods": 70.0, "shift_rad": step * np.pi / 2}
    return FrameRef(
        camera=camera,
        pattern=pattern,
        exposure_ms=exposure_ms,
        gain_db=0,
        role="fringe",
        bit_depth=8,
        image=image,
    )


def test_frames_are_chosen_by_exposure_and_pattern() -> None:
    menu = FrameMenu(
        tuple(_frame(c, t, k) for t in (8.0, 25.0) for k in (0, 1) for c in ("left", "right"))
    )
    picked = menu.pick("25 ms", menu.patterns()[1])

    assert menu.exposures() == ["8 ms", "25 ms"]
    assert [(f.camera, f.exposure_ms) for f in picked] == [("left", 25.0), ("right", 25.0)]
    assert all(pattern_text(f.pattern) == "sine x · 70 periods · shift 90°" for f in picked)


def test_what_was_never_chosen_falls_back_to_the_first_frame() -> None:
    picked = FrameMenu((_frame("left", None, 0),)).pick("8 ms", "nothing")

    assert [f.camera for f in picked] == ["left"]


# ---- points


def _table_with_a_block(tilt_rad: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-100, 100, (20_000, 2))
    height = np.where((np.abs(xy) < 30).all(axis=1), 40.0, 0.0)
    flat = np.column_stack([xy, 700.0 - height])
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.asarray(
        (flat - [0, 0, 700]) @ R.T + [0, 0, 700] + rng.normal(0, 0.02, flat.shape), dtype=np.float32
    )


def test_the_table_is_found_and_heights_are_counted_from_it() -> None:
    points = _table_with_a_block()
    ground = find_ground(points, np.array([0.0, 0.0, -1.0]))
    heights = ground.heights_mm(points)

    assert ground.is_table
    assert ground.up @ [0.0, 0.0, -1.0] == pytest.approx(np.cos(0.2), abs=1e-3)
    assert np.percentile(heights, 50) == pytest.approx(0.0, abs=0.1)
    assert heights.max() == pytest.approx(40.0, abs=0.3)


def test_without_a_table_heights_start_at_the_farthest_point() -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(5000, 3))
    ball = 50.0 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0, 0, 700]
    ground = find_ground(ball.astype(np.float32), np.array([0.0, 0.0, -1.0]))

    assert not ground.is_table
    assert ground.heights_mm(ball).max() == pytest.approx(100.0, abs=1.0)


def test_a_cloud_can_be_coloured_by_everything_it_knows() -> None:
    points = _table_with_a_block()
    sigma = ScalarOfPoints(
        "sigma_mm", "Noise", "mm", 0.0, 0.1, np.full(len(points), 0.05, np.float32)
    )
    cloud = PointsPreview(len(points), points, np.full((len(points), 3), 7, np.uint8), (sigma,))
    ways = modes(cloud, find_ground(points, np.array([0.0, 0.0, -1.0])))

    assert list(ways) == ["Height", "Intensity", "Depth", "Noise"]
    assert ways["Noise"].unit == "mm"
    assert (point_colours(cloud, ways["Intensity"]) == 7).all()
    assert point_colours(cloud, ways["Height"]).shape == points.shape


def test_a_ray_hits_the_first_point_on_its_way() -> None:
    points = np.array([[0, 0, 700], [0, 0, 650], [50, 0, 600]], np.float32)
    origin, ahead = np.zeros(3), np.array([0.0, 0.0, 1.0])

    assert hit(points, origin, ahead, 0.01) == 1
    assert hit(points, origin, -ahead, 0.01) is None
    assert hit(points, np.array([500.0, 0, 0]), ahead, 0.01) is None


def test_points_are_drawn_as_large_as_they_are_apart() -> None:
    x, y = np.meshgrid(np.arange(0, 200, 2.0), np.arange(0, 100, 2.0))
    grid = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 700.0)])

    assert spacing_mm(grid) == pytest.approx(2.0, rel=0.1)


@given(st.tuples(*[st.floats(-300, 300)] * 3), st.tuples(*[st.floats(-1, 1)] * 3))
def test_scene_and_rig_are_turned_into_each_other(
    point: tuple[float, ...], up: tuple[float, ...]
) -> None:
    direction = np.array(up) - np.array([0.0, 0.0, 2.0])
    placement = Placement.of(direction, np.array([1.0, 0, 0]), np.array([10.0, 20, 700]))
    here = np.array(point)

    assert placement.to_rig_mm(placement.to_scene(here)) == pytest.approx(here, abs=1e-6)
    assert placement.to_scene(placement.origin_mm + direction)[2] == pytest.approx(
        np.linalg.norm(direction) * UNIT
    )
    assert np.linalg.det(placement.R) == pytest.approx(1.0)


def test_cameras_look_down_on_the_scene() -> None:
    assert LYING.to_scene(np.array([0.0, 0.0, 0.0]))[2] == pytest.approx(7.0)
