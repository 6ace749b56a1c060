"""Stages of all methods together: a name means one algorithm, and stands in a file of that name."""

from collections import defaultdict

from backend.domain.stage import Stage
from backend.methods import registry

STAGES: tuple[Stage, ...] = tuple(s for m in registry().methods.values() for s in m.stages)


def test_a_name_means_one_algorithm() -> None:
    functions = defaultdict(set)
    for stage in STAGES:
        functions[stage.function_name].add(stage.function)

    assert {name: len(f) for name, f in functions.items() if len(f) > 1} == {}


def test_every_stage_has_a_file_of_its_name() -> None:
    modules = {stage.function_name: stage.function.__module__ for stage in STAGES}

    assert modules == {name: f"backend.stages.{name}" for name in modules}


def test_every_stage_says_in_one_sentence_what_it_does() -> None:
    assert [s.name for s in STAGES if "\n" in s.doc or not s.doc.endswith(".")] == []
