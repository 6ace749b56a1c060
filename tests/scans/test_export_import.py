"""Exports: what is in the folder, that it comes back with the same results, and what is refused."""

import errno
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.contract.capture import Capture
from backend.contract.scan_file import ScanFile
from backend.domain.errors import (
    ConflictError,
    InvalidCaptureError,
    InvalidSettingError,
    StorageFullError,
)
from backend.domain.states import StageStatus
from backend.services.export_folder import ExportFolder
from tests.scans.toy_house import House, data_folder, hashes, inline_house, stage


@pytest.fixture
def other_house(tmp_path: Path) -> Iterator[House]:
    """Another installation, without the rig's pictures."""
    with inline_house(*data_folder(tmp_path / "elsewhere")) as house:
        yield house


@pytest.fixture
def scan(house: House) -> str:
    state = house.create(settings={"toy_fringes": {"steps": 5}})
    state = house.edit(state, "toy_levels", step_gray=32)
    return house.run_through(state.id).id


def export(house: House, scan: str, folder: Path, *, frames: bool = True) -> Path:
    house.services.export(scan, str(folder), frames, "ada")
    return folder


def scan_file(folder: Path) -> ScanFile:
    return ScanFile.model_validate_json((folder / "scan.json").read_text())


def test_scan_json_tells_how_the_scan_came_about(house, scan, tmp_path):
    written = scan_file(export(house, scan, tmp_path / "out"))
    state = house.services.scan(scan)
    assert (written.scan.id, written.method.name, written.unglare) == (scan, "toy", "test")
    assert {s.name: s.result_hash for s in written.stages} == {
        s.name: s.result_hash for s in state.stages
    }
    assert written.settings["toy_levels"]["step_gray"].value == 32
    assert written.settings["toy_levels"]["step_gray"].source == "edited"
    assert written.settings["toy_fringes"]["steps"].source == "recipe"
    assert written.settings["toy_look"]["exposure_ms"].chosen > 0
    assert [d.verdict for d in written.decisions] == ["accept"]
    assert [e.field for e in written.edits] == ["step_gray"]
    assert {"created", "edited", "finished"} <= {a.action for a in written.audit}
    assert written.devices["projector"]["serial"] == "2"
    assert all(s.versions == {"unglare": "test"} for s in written.stages)


def test_every_file_is_named_with_its_hash(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    present = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    files = scan_file(folder).files
    assert present == {"scan.json", *files}
    for name, expected in files.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == expected


def test_maps_are_the_artifacts(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out", frames=False)
    names = {p.stem for p in (folder / "maps").iterdir()}
    assert {"toy_look.white.left", "toy_levels.labels", "toy_phase.phase_rad.right"} <= names
    field = next(
        f for f in stage(house.services.scan(scan), "toy_levels").fields if f.name == "labels"
    )
    expected = house.services.artifact(field.arrays[""].hash)
    np.testing.assert_array_equal(np.load(folder / "maps/toy_levels.labels.npy"), expected)


def test_frames_are_left_out_unless_asked_for(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out", frames=False)
    assert not (folder / "capture.json").exists()
    assert not (folder / "frames").exists()


def test_the_capture_is_in_the_import_format(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    capture = Capture.model_validate_json((folder / "capture.json").read_text())
    assert capture.reference_camera == "left"
    assert {f.stage for f in capture.frames} == {"toy_look", "toy_fringes"}
    fringe = next(f for f in capture.frames if f.stage == "toy_fringes")
    assert fringe.journal is not None
    assert fringe.exposure_ms == pytest.approx(2.0, abs=0.01)
    assert {link.to for link in capture.extrinsics} <= {"right", "projector"}


def test_an_export_gives_the_same_results_elsewhere(house, other_house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    imported = other_house.services.import_capture(str(folder), "", "bob")
    assert imported.rig == ""
    assert StageStatus.UNAVAILABLE not in {s.status for s in imported.stages}
    again = other_house.run_through(imported.id)
    assert hashes(again) == hashes(house.services.scan(scan))
    assert again.id != scan


def test_after_a_redo_the_present_take_counts(house, other_house, scan, tmp_path):
    state = house.redo(house.services.scan(scan), "toy_fringes")
    state = house.run_through(state.id)
    folder = export(house, scan, tmp_path / "out")
    again = other_house.services.import_capture(str(folder), "", "bob")
    assert hashes(other_house.run_through(again.id)) == hashes(state)


def test_an_imported_export_can_be_exported_again(house, other_house, scan, tmp_path):
    first = export(house, scan, tmp_path / "first")
    imported = other_house.services.import_capture(str(first), "", "bob")
    other_house.run_through(imported.id)
    second = export(other_house, imported.id, tmp_path / "second")
    kept = {n: h for n, h in scan_file(first).files.items() if n != "capture.json"}
    assert {n: h for n, h in scan_file(second).files.items() if n != "capture.json"} == kept


def test_a_shot_that_was_never_captured_is_asked_for_in_one_sentence(
    house, other_house, scan, tmp_path
):
    folder = export(house, scan, tmp_path / "out")
    imported = other_house.services.import_capture(str(folder), "", "bob")
    edited = other_house.edit(imported, "toy_fringes", exposures_ms=[2.0, 7.0])
    state = other_house.run(edited.id, unattended=True)
    failed = stage(state, "toy_fringes")
    assert failed.status is StageStatus.FAILED
    assert "fringe at 7 ms" in failed.message
    assert "\n" not in failed.message


def test_without_a_rig_nothing_can_be_taken_again(house, other_house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    imported = other_house.services.import_capture(str(folder), "", "bob")
    with pytest.raises(ConflictError, match="no rig"):
        other_house.redo(imported, "toy_fringes")


def test_a_replay_of_the_scan_is_the_same(house, scan):
    replay = house.services.replay(scan)
    assert replay.is_same
    assert {s.verdict for s in replay.stages} == {"same"}
    assert house.services.scans()[0].id == scan
    assert len(house.services.scans()) == 1


def test_a_replay_of_the_export_is_the_same(house, scan, tmp_path):
    told: list[float] = []
    folder = export(house, scan, tmp_path / "out")
    replay = house.services.replay_folder(str(folder), lambda done, text="": told.append(done))
    assert replay.is_same
    assert told


def test_a_replay_names_the_stages_that_differ(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    picture = folder / "frames/toy_fringes/left/0003.png"
    gray = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    assert gray is not None
    cv2.imwrite(str(picture), (gray // 2).astype(np.uint8))
    replay = house.services.replay_folder(str(folder))
    assert not replay.is_same
    verdicts = {s.name: s.verdict for s in replay.stages}
    assert verdicts["toy_levels"] == "same"
    assert verdicts["toy_fringes"] == verdicts["toy_phase"] == "different"


def test_a_replay_names_the_stage_that_has_no_result_now(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    document = json.loads((folder / "capture.json").read_text())
    document["frames"] = [
        f for f in document["frames"] if not f["file"].endswith("fringes/left/0002.png")
    ]
    (folder / "capture.json").write_text(json.dumps(document))
    replay = house.services.replay_folder(str(folder))
    failed = next(s for s in replay.stages if s.name == "toy_fringes")
    assert failed.verdict == "no result"
    assert "lack" in failed.message


def test_a_scan_without_results_cannot_be_replayed(house):
    with pytest.raises(ConflictError, match="run it first"):
        house.services.replay(house.create().id)


# bad folders


def _change(folder: Path, name: str, change: Any) -> None:
    document = json.loads((folder / name).read_text())
    change(document)
    (folder / name).write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("name", "change", "error", "words"),
    [
        (
            "scan.json",
            lambda d: d["method"].update(name="other"),
            InvalidCaptureError,
            "belong together",
        ),
        ("scan.json", lambda d: d.update(version=2), InvalidCaptureError, "version"),
        (
            "scan.json",
            lambda d: d["settings"]["toy_levels"]["step_gray"].update(value=1000),
            InvalidSettingError,
            "toy_levels.step_gray",
        ),
        (
            "scan.json",
            lambda d: d["given"]["RigFacts"]["document"].update(reference="right"),
            InvalidCaptureError,
            "hash differs",
        ),
        (
            "scan.json",
            lambda d: d["given"].update(Surprise=d["given"]["RigFacts"]),
            InvalidCaptureError,
            "Surprise",
        ),
        (
            "capture.json",
            lambda d: d["frames"].append(d["frames"][0]),
            InvalidCaptureError,
            "same shot",
        ),
        (
            "capture.json",
            lambda d: d["frames"][0]["journal"].update(metadata={}),
            InvalidCaptureError,
            "exposure and gain",
        ),
    ],
)
def test_a_tampered_export_is_refused_and_nothing_is_made(
    house, other_house, scan, tmp_path, name, change, error, words
):
    folder = export(house, scan, tmp_path / "out")
    _change(folder, name, change)
    with pytest.raises(error, match=words):
        other_house.services.import_capture(str(folder), "", "bob")
    assert other_house.services.scans() == ()


# the place of an export


def test_an_older_export_is_replaced(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    export(house, scan, folder, frames=False)
    assert not (folder / "frames").exists()
    assert [p.name for p in tmp_path.iterdir() if "out" in p.name] == ["out"]


def test_an_empty_folder_is_used(house, scan, tmp_path):
    (tmp_path / "out").mkdir()
    assert (export(house, scan, tmp_path / "out") / "scan.json").is_file()


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda folder: (folder / "notes.txt").write_text("mine"), "isn.t empty"),
        (lambda folder: (folder / "scan.json").write_text("{}"), "isn.t empty"),
    ],
)
def test_a_folder_with_other_things_is_refused(house, scan, tmp_path, prepare, words):
    folder = tmp_path / "out"
    folder.mkdir()
    prepare(folder)
    before = sorted(folder.iterdir())
    with pytest.raises(ConflictError, match=words):
        export(house, scan, folder)
    assert sorted(folder.iterdir()) == before


def test_other_files_in_an_export_are_not_thrown_away(house, scan, tmp_path):
    folder = export(house, scan, tmp_path / "out")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ConflictError, match=r"notes\.txt"):
        export(house, scan, folder)


def test_a_file_in_the_place_is_refused(house, scan, tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(ConflictError, match="is a file"):
        export(house, scan, tmp_path / "out")


def test_a_scan_without_frames_cannot_export_them(house, tmp_path):
    with pytest.raises(ConflictError, match="has no frames"):
        export(house, house.create().id, tmp_path / "out")


@pytest.mark.parametrize(
    ("number", "error", "words"),
    [
        (errno.ENOSPC, StorageFullError, "no room"),
        (errno.EACCES, ConflictError, "can't be written"),
    ],
)
def test_a_disk_that_refuses_leaves_nothing_behind(
    house, scan, tmp_path, monkeypatch, number, error, words
):
    write = ExportFolder.write

    def refuse(self: ExportFolder, name: str, parts: Any) -> None:
        if name == "capture.json":
            raise OSError(number, "refused")
        write(self, name, parts)

    folder = export(house, scan, tmp_path / "out", frames=False)
    before = (folder / "scan.json").read_bytes()
    monkeypatch.setattr(ExportFolder, "write", refuse)
    with pytest.raises(error, match=words):
        export(house, scan, folder)
    assert (folder / "scan.json").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir() if "out" in p.name] == ["out"]
