"""Patterns as pictures: what is exported is what a scan projects."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from backend.cli.application import run
from backend.devices.pattern_set import PatternSet, pattern_hash, unpacked
from backend.devices.sim.display import Display
from backend.domain.errors import ConflictError
from backend.domain.patterns import WHITE, Gray, Pattern, Sine, StaticPicture, Uniform
from backend.jobs.rendering import render
from backend.numerics.test_patterns import TEST_PATTERNS, test_pattern
from backend.services.pattern_sets import (
    Pack,
    Trial,
    Wanted,
    _Shown,
    describe,
    export_patterns,
    pictures_of,
    refuse_folder,
)

SIZE = "128x96"
WANTED = Wanted("toy", 128, 96)


def picture(path: Path) -> np.ndarray:
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert read is not None
    return read


# ---------------------------------------------------------------- the command


@pytest.mark.scan
def test_an_exported_set_holds_every_picture_that_a_scan_projects(tmp_path, monkeypatch, capsys):
    """The trials that find out are scans: what they load into the projector is what any scan loads."""
    projected: set[str] = set()
    load = Display.load

    def noting(self, patterns):
        projected.update(pattern_hash(pattern) for pattern in patterns)
        load(self, patterns)

    monkeypatch.setattr(Display, "load", noting)
    out = tmp_path / "set"
    asked = ("patterns", "export", "--projector-size", SIZE, "--pack", "24bit", "--out", str(out))
    assert run([*asked, "--quiet", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    written = PatternSet.read(out)
    assert answer["patterns"] == written.model_dump(mode="json")["patterns"]
    assert written.left_out == ()
    assert projected == {pattern.hash for pattern in written.patterns}
    assert len(projected) > 12
    _is_sound(written, out)


def _is_sound(written: PatternSet, folder: Path) -> None:
    """The list is true of every file, and the packed images hold the same pictures."""
    images = written.image_pictures(folder)
    for number, pattern in enumerate(written.patterns):
        assert pattern.number == number
        read = picture(folder / pattern.file)
        assert read.dtype == np.uint8
        assert read.shape == (written.height_px, written.width_px)
        assert pattern_hash(read) == pattern.hash
        assert pattern.image is not None
        assert pattern.position is not None
        inside = unpacked(images[pattern.image], pattern.position, written.bit_depth)
        np.testing.assert_array_equal(inside, read)
    assert {path.name for path in folder.iterdir()} == {"patterns.json", *written.files}


@pytest.mark.parametrize("kind", TEST_PATTERNS)
def test_test_patterns_are_written(kind, tmp_path, capsys):
    path = tmp_path / "pattern.png"
    asked = ("patterns", "test", "--kind", kind, "--projector-size", SIZE, "--out", str(path))
    assert run([*asked, "--label", "left"]) == 0
    np.testing.assert_array_equal(picture(path), test_pattern(kind, 128, 96, label="left"))
    assert TEST_PATTERNS[kind] in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--kind", "stars", "--out", "a.png"), "There is no test pattern 'stars': choose white"),
        (("--kind", "white", "--out", "a.jpg"), "a.jpg is no name of a picture"),
        (("--kind", "white", "--out", "/nowhere/a.png"), "/nowhere/a.png can't be written"),
        (("--kind", "white", "--out", "a.png", "--projector-size", "8x8"), "8 x 8 px is too small"),
        (("--kind", "white", "--out", "a.png", "--projector-size", "large"), "write WIDTHxHEIGHT"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence(arguments, sentence, capsys):
    assert run(["patterns", "test", "--projector-size", SIZE, *arguments]) == 1
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.splitlines()) == 1


def test_an_unknown_method_is_one_sentence(tmp_path, capsys):
    arguments = ("--method", "magic", "--projector-size", SIZE, "--out", str(tmp_path / "set"))
    assert run(["patterns", "export", *arguments, "--quiet"]) == 1
    assert "magic" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


# ---------------------------------------------------------------- what can be written


def trial(unreached: tuple[str, ...] = (), **stages: tuple[tuple[Pattern, ...], int]) -> Trial:
    shown = {
        name: _Shown(tuple(p.model_dump_json() for p in patterns), masked)
        for name, (patterns, masked) in stages.items()
    }
    titles = {name: name.title() for name in (*stages, *unreached)}
    return Trial(shown, titles, dict.fromkeys(unreached, "It failed."))


FRINGE, OTHER = Sine(periods=4), Sine(periods=5)


def test_patterns_are_written_once_and_white_and_black_always():
    same = trial(first=((WHITE, FRINGE), 0), second=((FRINGE, OTHER, StaticPicture()), 0))
    patterns, left_out = pictures_of((same, same), WANTED)
    assert left_out == ()
    assert [p.what.split(",")[0] for p in patterns] == [
        "even field",
        "fringes",
        "fringes",
        "nothing",
    ]
    assert [p.stages for p in patterns] == [
        ("first",),
        ("first", "second"),
        ("second",),
        ("second",),
    ]
    np.testing.assert_array_equal(
        patterns[1].picture, render(FRINGE, width_px=128, height_px=96, gamma=1.0)
    )


def test_levels_and_gamma_are_the_projectors():
    empty = trial()
    wanted = Wanted("toy", 128, 96, gamma=2.2, levels=(100,))
    patterns, _ = pictures_of((empty, empty), wanted)
    assert [int(p.picture[0, 0]) for p in patterns] == [255, 0, 100]
    bent, _ = pictures_of((trial(a=((FRINGE,), 0)),) * 2, wanted)
    np.testing.assert_array_equal(
        bent[0].picture, render(FRINGE, width_px=128, height_px=96, gamma=2.2)
    )


def test_the_test_patterns_come_after_the_methods_own():
    wanted = Wanted("toy", 128, 96, test_patterns=True)
    patterns, _ = pictures_of((trial(a=((FRINGE,), 0)),) * 2, wanted)
    words = ["checker", "squares", "focus", "lines", "identify"]
    assert [p.what for p in patterns[3:]] == [f"test pattern {word}" for word in words]
    np.testing.assert_array_equal(patterns[5].picture, test_pattern("focus", 128, 96))


def test_patterns_that_differ_from_scene_to_scene_are_left_out_with_a_sentence():
    first = trial(ramp=((FRINGE, Uniform(gray=3)), 0))
    second = trial(ramp=((FRINGE, Uniform(gray=4)), 0))
    patterns, left_out = pictures_of((first, second), WANTED)
    assert [p.what for p in patterns[1:]] == ["even field, gray 255", "even field, gray 0"]
    assert left_out == (
        "Ramp (ramp): 1 pattern can't be exported, as the scan's own frames decide on them.",
    )


def test_masked_patterns_are_left_out_with_a_sentence():
    both = trial(code=((FRINGE,), 12))
    _, left_out = pictures_of((both, both), WANTED)
    assert left_out == (
        "Code (code): 12 patterns can't be exported, as a mask that is made of the scan's own frames dims them.",
    )


def test_a_stage_that_was_not_reached_is_said():
    both = trial(unreached=("late",), early=((FRINGE,), 0))
    _, left_out = pictures_of((both, both), WANTED)
    assert left_out == (
        "Late (late) wasn't reached in the trial, what it shows is missing: It failed.",
    )


# ---------------------------------------------------------------- the folder


def written(folder: Path, *patterns: Pattern, pack: Pack = "24bit") -> PatternSet:
    pictures, left_out = pictures_of((trial(a=(patterns, 0)),) * 2, WANTED)
    return export_patterns(pictures, left_out, WANTED, folder, pack)


def test_gray_sets_have_three_patterns_in_an_image(tmp_path):
    kept = written(tmp_path / "set", FRINGE, OTHER)
    assert kept.bit_depth == 8
    assert [(p.image, p.position) for p in kept.patterns] == [(0, 0), (0, 1), (0, 2), (1, 0)]
    _is_sound(kept, tmp_path / "set")


def test_black_and_white_sets_have_24_patterns_in_an_image(tmp_path):
    code = [Gray(bit=b, bits=7, codes=128, inverse=i) for b in range(7) for i in (False, True)]
    rows = [
        Gray(axis="y", bit=b, bits=7, codes=96, inverse=i) for b in range(7) for i in (False, True)
    ]
    kept = written(tmp_path / "set", *code, *rows)
    assert kept.bit_depth == 1
    assert len(kept.patterns) == 30
    assert len(kept.images) == 2
    _is_sound(kept, tmp_path / "set")


def test_pictures_alone_need_no_images(tmp_path):
    kept = written(tmp_path / "set", FRINGE, pack="none")
    assert kept.images == ()
    assert {p.image for p in kept.patterns} == {None}
    assert sorted(path.suffix for path in (tmp_path / "set").iterdir()) == [
        ".json",
        ".png",
        ".png",
        ".png",
    ]


def test_an_older_set_is_replaced_and_anything_else_is_not(tmp_path):
    written(tmp_path / "set", FRINGE, OTHER)
    kept = written(tmp_path / "set", FRINGE)
    assert {path.name for path in (tmp_path / "set").iterdir()} == {"patterns.json", *kept.files}
    (tmp_path / "set" / "notes.txt").write_text("mine")
    with pytest.raises(ConflictError, match=r"notes\.txt"):
        refuse_folder(tmp_path / "set")


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        (
            Sine(axis="y", periods=12, shift_rad=np.pi / 2),
            "fringes, from row to row, 12 periods, shifted by 90°",
        ),
        (
            Gray(bit=3, bits=10, codes=912, inverse=True),
            "Gray code, from column to column, bit 3 of 10, inverse",
        ),
        (Uniform(gray=12), "even field, gray 12"),
    ],
)
def test_patterns_are_said_in_words(pattern, words):
    assert describe(pattern) == words
