"""A stage's signature is its declaration: what is read from it, and what is refused at import."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from jaxtyping import Float

from backend.domain.arrays import ArrayHash, LoadArray, array_hashes
from backend.domain.checks import Check, at_least, at_most, worst
from backend.domain.errors import NotFoundError
from backend.domain.hints import Picture, Value
from backend.domain.method import Method
from backend.domain.params import Params, setting, without_cosmetics
from backend.domain.shots import Progress, Shoot
from backend.domain.stage import stage
from backend.domain.states import Level, Review


class AreaParams(Params):
    """Settings of the stage under test."""

    factor: float = setting(2.0, title="Factor", unit="mm", ge=0)
    """What the width is multiplied with."""
    colour: str = setting("red", title="Colour", cosmetic=True)


@dataclass(frozen=True)
class Width:
    """An input."""

    width_mm: float


@dataclass(frozen=True)
class Depth:
    """An optional input."""

    depth_mm: float


@dataclass(frozen=True)
class Area:
    """A result with shown fields."""

    area_mm2: Annotated[float, Value("Area", unit="mm2")]
    maps: Annotated[Mapping[str, Float[np.ndarray, "h w"]], Picture("Map")]
    hidden: int = 0


def _large(result: Area, params: AreaParams) -> Check:
    return at_least("size", result.area_mm2, warning=1.0, failure=0.1, sentence="area", unit="mm2")


@stage(title="Area", version=3, review=Review.ALWAYS, checks=(_large,))
def area(
    width: Width, depth: Depth | None, params: AreaParams, shoot: Shoot, progress: Progress
) -> Area:
    """Multiply width by depth."""
    progress(1.0)
    return Area(width.width_mm * (depth.depth_mm if depth else 1.0) * params.factor, {})


@stage(title="Width", version=1)
def width() -> Width:
    """Measure the width."""
    return Width(4.0)


class PaintParams(Params):
    """Settings that refer to arrays."""

    paint: ArrayHash | None = setting(None, title="Paint")
    layers: tuple[ArrayHash, ...] = setting((), title="Layers")
    name: str = setting("cd" * 32, title="Name")


@stage(title="Paint", version=1)
def paint(params: PaintParams, load: LoadArray) -> Width:
    """Measure what was painted."""
    return Width(float(load(params.paint).sum()) if params.paint else 0.0)


def test_arrays_are_loaded_by_whoever_runs_the_stage():
    assert (paint.load_argument, paint.inputs) == ("load", ())
    params = PaintParams(paint="ab" * 32)
    assert paint.run({}, params, load=lambda array_hash: np.ones(3)) == Width(3.0)
    with pytest.raises(NotFoundError, match="no array abababababab"):
        paint.run({}, params)


def test_settings_tell_which_arrays_they_refer_to():
    params = PaintParams(paint="ab" * 32, layers=("01" * 32, "02" * 32))
    assert list(array_hashes(params)) == [
        ("paint", "ab" * 32), ("layers", "01" * 32), ("layers", "02" * 32),
    ]  # fmt: skip


def test_the_signature_is_read():
    assert [(i.name, i.type, i.optional) for i in area.inputs] == [
        ("width", Width, False),
        ("depth", Depth, True),
    ]
    assert area.params is AreaParams
    assert area.output is Area
    assert area.captures
    assert (area.shoot_argument, area.progress_argument) == ("shoot", "progress")


def test_shown_fields_carry_hint_and_camera():
    assert [(f.name, f.hint.kind, f.per_camera) for f in area.shown] == [
        ("area_mm2", "value", False),
        ("maps", "picture", True),
    ]


def test_description_holds_units_limits_and_help():
    factor = area.describe()["settings"]["properties"]["factor"]
    assert factor["unit"] == "mm"
    assert factor["minimum"] == 0
    assert factor["description"] == "What the width is multiplied with."


def test_run_supplies_inputs_by_name_and_none_for_what_is_missing():
    result = area.run({"width": Width(4.0)}, AreaParams(factor=3.0), shoot=None)
    assert result.area_mm2 == 12.0
    assert [c.level for c in area.check(result, AreaParams())] == [Level.OK]


def test_a_repeated_stage_keeps_its_algorithm_under_another_name():
    again = area.named("area_2")
    assert (again.name, again.function_name) == ("area_2", "area")


def test_cosmetic_settings_stay_out_of_the_key():
    assert without_cosmetics(AreaParams(colour="blue")) == {"factor": 2.0}


def _no_docstring(width: Width) -> Area:
    raise NotImplementedError


def _unannotated(width) -> Area:
    """Have an input without type."""
    raise NotImplementedError


def _no_dataclass(width: Width) -> float:
    """Return no dataclass."""
    raise NotImplementedError


def _two_types(width: Width | Depth) -> Area:
    """Read one of two types."""
    raise NotImplementedError


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (_no_docstring, "docstring"),
        (_unannotated, "annotate"),
        (_no_dataclass, "frozen dataclass"),
        (_two_types, "one type"),
    ],
)
def test_a_bad_declaration_is_refused_at_import(function, words):
    with pytest.raises(TypeError, match=words):
        stage(title="Bad", version=1)(function)


def test_inputs_are_wired_to_the_nearest_earlier_maker():
    method = Method("m", "M", (width, width.named("width_2"), area))
    assert [(w.input.name, w.source) for w in method.wires["area"]] == [
        ("width", "width_2"),
        ("depth", None),
    ]


@pytest.mark.parametrize(
    ("stages", "words"),
    [((area,), "reads 'width'"), ((width, width), "twice"), ((area, width), "reads 'width'")],
)
def test_a_method_that_cannot_be_wired_is_refused_at_import(stages, words):
    with pytest.raises(TypeError, match=words):
        Method("m", "M", stages)


def test_given_types_need_no_maker():
    assert Method("m", "M", (area,), given=(Width,)).wires["area"][0].source is None


@pytest.mark.parametrize(
    ("value", "level"), [(0.05, Level.FAILURE), (0.5, Level.WARNING), (1.0, Level.OK)]
)
def test_at_least_grades_small_values(value, level):
    check = at_least("x", value, warning=1.0, failure=0.1, sentence="s")
    assert (check.level, check.limit) == (level, 0.1 if level is Level.FAILURE else 1.0)


@pytest.mark.parametrize(
    ("value", "level"), [(3.0, Level.FAILURE), (1.5, Level.WARNING), (1.0, Level.OK)]
)
def test_at_most_grades_large_values(value, level):
    assert at_most("x", value, warning=1.0, failure=2.0, sentence="s").level is level


def test_the_worst_level_decides():
    levels = tuple(Check("c", level, "s") for level in (Level.OK, Level.FAILURE, Level.WARNING))
    assert worst(levels) is Level.FAILURE
    assert worst(()) is Level.OK
