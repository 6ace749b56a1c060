"""From JSON schemas to controls and back."""

from types import SimpleNamespace
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from app.forms.form import Form
from app.forms.schema import Setting, UnreadableError, read, read_schema, write
from backend.domain.params import Params, setting


class Everything(Params):
    """One setting of each type."""

    share: float = setting(0.05, title="Share", unit="%", ge=0, le=0.5)
    """A sentence."""
    count: int = setting(4, title="Steps", ge=3, lt=33)
    automatic: float | None = setting(None, title="Exposure", unit="ms", auto="t_ms", gt=0)
    borders: tuple[float, ...] | None = setting(None, title="Borders", unit="gray")
    size: tuple[int, int] = setting((640, 480), title="Size", unit="px")
    flag: bool = setting(True, title="Flag", advanced=True)
    word: Literal["one", "two"] = setting("one", title="Word")
    text: str = setting("", title="Text")
    table: dict[str, float] = setting({}, title="Table")


SETTINGS = {s.name: s for s in read_schema(Everything.model_json_schema())}


@pytest.mark.parametrize(
    ("name", "kind", "optional", "limits"),
    [
        ("share", "number", False, "0 to 0.5"),
        ("count", "integer", False, "3 to 33"),
        ("automatic", "number", True, "at least 1e-09"),
        ("borders", "numbers", True, ""),
        ("size", "numbers", False, ""),
        ("flag", "switch", False, ""),
        ("word", "choice", False, ""),
        ("text", "text", False, ""),
        ("table", "document", False, ""),
    ],
)
def test_every_type_of_setting_is_read(name: str, kind: str, optional: bool, limits: str) -> None:
    found = SETTINGS[name]

    assert (found.kind, found.optional, found.limits) == (kind, optional, limits)


def test_titles_units_and_help_come_from_the_schema() -> None:
    assert SETTINGS["share"].label == "Share [%]"
    assert SETTINGS["share"].doc == "A sentence."
    assert SETTINGS["flag"].advanced
    assert SETTINGS["word"].choices == ("one", "two")


def test_a_name_tells_title_and_unit_where_nobody_wrote_them() -> None:
    class Plain(BaseModel):
        baseline_mm: float = 180.0

    (found,) = read_schema(Plain.model_json_schema())

    assert found.label == "Baseline [mm]"


def test_a_shared_definition_is_followed() -> None:
    schema = {
        "$defs": {"Mode": {"enum": ["a", "b"], "title": "Mode", "type": "string"}},
        "properties": {"mode": {"$ref": "#/$defs/Mode", "title": "How", "default": "a"}},
    }

    (found,) = read_schema(schema)

    assert (found.title, found.kind, found.choices) == ("How", "choice", ("a", "b"))


def test_a_long_schema_shows_the_first_few() -> None:
    schema = {"properties": {f"x{i}": {"type": "number", "default": 0} for i in range(30)}}

    assert [s.advanced for s in read_schema(schema)].count(False) == 6


@pytest.mark.parametrize(
    ("name", "text", "chosen", "value"),
    [
        ("automatic", "auto", None, None),
        ("automatic", "", None, None),
        ("automatic", "auto: 41.67", 41.666667, None),
        ("automatic", "auto: 50", 41.666667, 50.0),
        ("automatic", " 12.5 ", 41.666667, 12.5),
        ("borders", "9, 48; 117 238", None, [9.0, 48.0, 117.0, 238.0]),
        ("borders", "auto: 9, 50", [9.0, 48.0], [9.0, 50.0]),
        ("text", " tea ", None, "tea"),
        ("table", '{"a": 1}', None, {"a": 1}),
    ],
)
def test_what_is_typed_becomes_a_value(name: str, text: str, chosen: Any, value: Any) -> None:
    assert read(SETTINGS[name], text, chosen) == value


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("automatic", "soon", "not a number"),
        ("automatic", "-3", "out of range"),
        ("automatic", "nan", "out of range"),
        ("borders", "9, x", "not a number"),
        ("table", "{", "JSON"),
    ],
)
def test_what_is_no_value_is_refused_with_a_reason(name: str, text: str, said: str) -> None:
    with pytest.raises(UnreadableError, match=said):
        read(SETTINGS[name], text)


@given(st.lists(st.floats(0.001, 9999, allow_nan=False), min_size=1, max_size=6))
def test_a_list_that_is_written_reads_back_to_four_digits(values: list[float]) -> None:
    numbers = Setting("x", "x", "numbers", optional=True)

    assert read(numbers, write(numbers, values)) == pytest.approx(values, rel=1e-3)


@given(st.floats(1e-3, 1e7, allow_nan=False))
def test_leaving_an_automatic_value_alone_keeps_it_automatic(chosen: float) -> None:
    number = Setting("x", "x", "number", optional=True)

    assert read(number, write(number, None, chosen), chosen) is None


class _Controls:
    """Makes text controls as viser does, without a browser."""

    def __init__(self) -> None:
        self.texts: list[Any] = []

    def add_html(self, content: str, **_: Any) -> SimpleNamespace:
        return SimpleNamespace(content=content, visible=True)

    def add_text(self, label: str, value: str, **_: Any) -> SimpleNamespace:
        self.texts.append(SimpleNamespace(value=value, on_update=lambda changed: changed))
        made: SimpleNamespace = self.texts[-1]
        return made


def test_what_nobody_touches_keeps_all_its_digits() -> None:
    gui: Any = _Controls()
    period = Setting("period_ms", "Period", "number", default=1000 / 120, optional=True)
    size = Setting("size", "Size", "numbers", default=(1280, 960))
    form = Form(gui, (period, size), on_edit=lambda *_: None, on_error=lambda *_: None)

    assert gui.texts[0].value == "8.333"
    assert form.values() == {"period_ms": 1000 / 120, "size": [1280, 960]}
    gui.texts[0].value = "8.4"
    assert form.values()["period_ms"] == 8.4
