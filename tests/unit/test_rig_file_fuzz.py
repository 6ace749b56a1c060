"""Whatever stands in a rig file is taken, or refused in one sentence that names the file; nothing is half kept."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.devices import plain_yaml
from backend.devices.errors import RigConfigError
from backend.devices.pages import PageDesk
from backend.devices.rig_shelf import RigShelf

BENCH = """
title: Bench
cameras:
  left:  {driver: aravis, address: 192.0.2.2, sensor: {full_well_e: 10500, read_noise_e: 6.5}, limits: {longest_exposure_ms: 500}}
  right: {driver: video, source: 0, exposure_us: 20000}
projector: {driver: page, size: 1280x800, refresh_hz: 60, gamma: 2.2}
reference: right
snap_exposures: true
"""
BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 10)}]\n" for i in range(9)
)


def added(data: bytes, name: str = "bench.yaml") -> str:
    """Try to add a file; return the sentence that it is refused with, empty if it is taken."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / name
        source.write_bytes(data)
        shelf = RigShelf(Path(folder) / "rigs", PageDesk())
        try:
            kept = shelf.add(source)
        except RigConfigError as error:
            refused = error.sentence
        else:
            shelf.read(kept.name)
            return ""
        assert not list((Path(folder) / "rigs").glob("*")), "half kept"
        assert "\n" not in refused
        assert len(refused) < 900
        return refused


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "its aliases stand for more than"),
        ("a: &a [*a]", "stands for itself"),
        ("[" * 5000, "nested too deeply"),
        ("title: " + "1" * 5000, "isn't what it looks like"),
        ("title: 2026-99-99", "isn't what it looks like"),
        ("title: !!bool maybe", "isn't what it looks like"),
        ("title: !!timestamp x", "isn't what it looks like"),
        ("title: !!python/object/apply:os.system [ls]", "isn't YAML (line 1: could not determine a constructor"),
        ("title:\tBench\n\tcameras: {}", "isn't YAML (line "),
        ("? [a, b]\n: c", "isn't YAML (line 1"),
        ("--- 1\n--- 2", "isn't YAML"),
        ("title: \x01", "isn't YAML"),
        ("", "the whole file"),
        (BENCH.replace("cameras", "camera"), "; did you mean 'cameras'?"),
        (BENCH.replace("reference", "referenz"), "there is no entry 'referenz'; the entries are title, cameras"),
        (BENCH.replace("address", "adress"), "; did you mean 'address'?"),
        (BENCH.replace("aravis", "Aravis"), "left: there is no driver 'Aravis'; choose aravis"),
        (BENCH.replace("aravis", "Aravis"), "; did you mean 'aravis'?"),
        (BENCH.replace("longest_exposure_ms", "longest_exposure"), "; did you mean 'longest_exposure_ms'?"),
        (BENCH.replace("ms: 500", "ms: -500"), "cameras.left.limits.longest_exposure_ms can't be -500: input should be greater than 0"),
        (BENCH.replace("ms: 500", "ms: .nan"), "cameras.left.limits.longest_exposure_ms can't be nan"),
        (BENCH.replace("ms: 500", "ms: .inf"), "cameras.left.limits.longest_exposure_ms can't be inf"),
        (BENCH.replace("10500", "'many'"), "cameras.left.sensor.full_well_e can't be 'many'"),
        (BENCH.replace("left:", "'':"), "'' is no name for a camera"),
        (BENCH.replace("left:", "a/b:"), "'a/b' is no name for a camera"),
        (BENCH.replace("left:", "a b:"), "'a b' is no name for a camera"),
        (BENCH.replace("left:", "..:"), "'..' is no name for a camera"),
        (BENCH.replace("left:", "7:"), "cameras.7"),
        (BENCH.replace("title: Bench", f"title: [{'x, ' * 5000}]"), "title: input should be a valid string"),
        (BENCH.replace("title: Bench", "t" * 500 + ": 1"), "there is no entry 'ttt"),
        (BENCH + 'calibration: "a\\0b"', "can't be read (embedded null byte)"),
        (BENCH + "calibration: .", "is no file"),
        (BENCH + "calibration: /dev/zero", "is no file"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_sentence_with_the_way_out(text: str, words: str) -> None:
    sentence = added(text.encode())
    assert words in sentence
    assert "bench.yaml" in sentence or sentence.startswith(("left: ", "rig file"))


@pytest.mark.parametrize("encoded", [lambda text: text.encode("utf-8-sig"), str.encode])
def test_a_byte_order_mark_is_no_matter(encoded: Callable[[str], bytes]) -> None:
    assert added(encoded(BENCH)) == ""


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_other_encodings_are_named(encoding: str) -> None:
    assert "is no UTF-8 text (byte " in added(BENCH.replace("Bench", "Größe").encode(encoding))


def test_a_huge_file_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_yaml, "MOST_BYTES", 1000)
    assert "bench.yaml has 0.0 MB, at most 0.0 are read" in added(b"#" * 1001)


def test_anchors_that_save_typing_are_taken() -> None:
    text = BENCH.replace("{full_well_e", "&s {full_well_e").replace("20000}", "20000, sensor: *s}")
    assert added(text.encode()) == ""


def test_a_calibration_that_is_named_in_the_middle_of_a_line_is_refused(tmp_path: Path) -> None:
    view = {"width_px": 640, "height_px": 480, "K": [[600, 0, 320], [0, 600, 240], [0, 0, 1]]}
    document = yaml.safe_load(BENCH) | {"calibration": "stereo.yaml"}
    (tmp_path / "stereo.yaml").write_text(
        json.dumps({"cameras": {"left": view, "right": view | {"t_mm": [-180, 0, 0]}}})
    )
    (tmp_path / "bench.yaml").write_text(json.dumps(document))
    shelf = RigShelf(tmp_path / "rigs", PageDesk())
    with pytest.raises(RigConfigError, match="write `calibration: FILE` on one of its own"):
        shelf.add(tmp_path / "bench.yaml")
    (tmp_path / "bench.yaml").write_text(BENCH + "calibration: stereo.yaml\n")
    (tmp_path / "rigs" / ".bench.yaml.partial").mkdir(parents=True)
    with pytest.raises(RigConfigError, match="can't be written"):
        shelf.add(tmp_path / "bench.yaml")
    assert [path.name for path in (tmp_path / "rigs").iterdir()] == [".bench.yaml.partial"]


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12) | st.dates()
    | st.sampled_from(["aravis", "video", "page", "dlpc350", "none", "Line1", "1280x800", "192.0.2.2", "left", ""])
)  # fmt: skip
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8) | st.integers(), inner, max_size=3),
    max_leaves=8,
)  # fmt: skip


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else ()
    return [path, *(place for key, part in inner for place in _places(part, (*path, key)))]


PLACES = _places(yaml.safe_load(BENCH))[1:]


@settings(max_examples=60, deadline=None)
@given(
    changes=st.lists(
        st.tuples(st.sampled_from(PLACES), st.sampled_from(["set", "drop", "add"]), VALUES, st.text(max_size=10)),
        min_size=1, max_size=3,
    )
)  # fmt: skip
def test_a_file_with_changed_entries_is_taken_or_refused(changes: list[Any]) -> None:
    document = yaml.safe_load(BENCH)
    for (*above, last), how, value, name in changes:
        entry = document
        for step in above:
            entry = entry.get(step) if isinstance(entry, dict) else None
        if isinstance(entry, dict):
            if how == "drop":
                entry.pop(last, None)
            else:
                entry[last if how == "set" else name] = value
    added(yaml.safe_dump(document, allow_unicode=True).encode("utf-8", "replace"))


@settings(max_examples=60, deadline=None)
@given(at=st.integers(0, len(BENCH)), more=st.text(max_size=6), less=st.integers(0, 12))
def test_a_file_with_changed_letters_is_taken_or_refused(at: int, more: str, less: int) -> None:
    added((BENCH[:at] + more + BENCH[at + less :]).encode("utf-8", "replace"))
