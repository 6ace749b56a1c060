"""What makes the interface fit methods that nobody has written yet."""

import re
from pathlib import Path

import pytest

from backend.domain.hints import Hint
from backend.methods import registry

APP = Path(__file__).resolve().parents[2] / "app"
SOURCES = sorted(APP.rglob("*.py"))
_ENGLISH = {"fusion", "exposures", "zones", "stack", "interval", "surface", "edges", "codes"}
"""Stages named by a word of the language: looked for only where they are quoted."""


def _stage_names() -> list[str]:
    return sorted({s.name for m in registry().methods.values() for s in m.stages})


@pytest.mark.parametrize("name", _stage_names())
def test_no_stage_is_known_by_name(name: str) -> None:
    pattern = rf"[\"']{name}[\"']" if name in _ENGLISH else rf"\b{name}\b"

    assert [f.name for f in SOURCES if re.search(pattern, f.read_text())] == []


def test_every_kind_of_hint_has_its_view() -> None:
    shown = "".join(f.read_text() for f in SOURCES)
    kinds = {kind.__name__.lower() for kind in Hint.__subclasses__()}

    # A scalar is only ever a colour of the points.
    assert {k for k in kinds if f'"{k}"' not in shown} == {"scalar"}
