"""Importing a captured folder: what becomes of it, and one sentence for each thing that may be wrong."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.domain.errors import UnglareError
from backend.domain.rig import RigCalibration, RigFacts
from backend.jobs.loading import NO_RIG
from backend.services.importing import Importer
from backend.storage.codec import decode
from tests.unit import capture_folders
from tests.unit.capture_folders import Levels, picture, write_capture

K = [[1000.0, 0, 4], [0, 1000.0, 3], [0, 0, 1]]
EYE = [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.fixture
def importer(sqlite_database, store):
    return Importer(sqlite_database, store, capture_folders.registry())


def given(importer: Importer, scan: str):
    with importer.database.reading() as repositories:
        return repositories.given.of(scan)


def calibrate(document: dict[str, Any], folder: Path) -> None:
    document["cameras"]["main"]["K"] = K
    document["projector"] = {"width_px": 16, "height_px": 12, "K": K}
    document["extrinsics"] = [
        {"kind": "camera-projector", "from": "main", "to": "projector", "R": EYE, "t_mm": [100, 0, 0]}
    ]  # fmt: skip


def test_frames_and_facts_are_given_to_the_new_scan(importer, tmp_path):
    scan = importer.run(write_capture(tmp_path), who="anna")
    rows = given(importer, scan)
    assert set(rows) == {"RigFacts", "levels"}
    levels = decode(rows["levels"].document, Levels, importer.store)
    assert [f.pattern.gray for f in levels.frames] == [0, 100, 200]
    np.testing.assert_array_equal(levels.frames[1].gray, picture(100))
    facts = decode(rows["RigFacts"].document, RigFacts, importer.store)
    assert facts.cameras["main"].width_px == capture_folders.WIDTH


def test_the_scan_has_no_rig_and_tells_where_it_comes_from(importer, tmp_path):
    scan = importer.run(write_capture(tmp_path) / "capture.json", who="anna")
    with importer.database.reading() as repositories:
        row, audit = repositories.scans.get(scan), repositories.audit.of(scan)
    assert (row.name, row.rig, row.method, row.who) == ("three levels", NO_RIG, "levels", "anna")
    assert [(line.action, line.who) for line in audit] == [("imported", "anna")]
    assert "3 frames" in audit[0].sentence


def test_a_name_of_ones_own_counts_more(importer, tmp_path):
    scan = importer.run(write_capture(tmp_path), who="anna", name="mine")
    with importer.database.reading() as repositories:
        assert repositories.scans.get(scan).name == "mine"


def test_the_calibration_is_given_in_the_reference_cameras_frame(importer, tmp_path):
    scan = importer.run(write_capture(tmp_path, calibrate), who="anna")
    document = given(importer, scan)["RigCalibration"].document
    calibration = decode(document, RigCalibration, importer.store)
    np.testing.assert_allclose(calibration.camera_from_world["main"].R, np.eye(3))
    np.testing.assert_allclose(calibration.projector_from_world.t_mm, [100, 0, 0])


def test_colours_become_their_mean(importer, tmp_path):
    colours = np.dstack([picture(0), picture(3), picture(6)])
    write_capture(tmp_path)
    cv2.imwrite(str(tmp_path / "0.png"), colours)
    scan = importer.run(tmp_path, who="anna")
    levels = decode(given(importer, scan)["levels"].document, Levels, importer.store)
    np.testing.assert_array_equal(levels.frames[0].gray, picture(3))


def test_twelve_bits_stay_twelve_bits(importer, tmp_path):
    def deepen(document, folder):
        document["cameras"]["main"]["bit_depth"] = 12
        for gray in (0, 100, 200):
            cv2.imwrite(str(folder / f"{gray}.png"), picture(gray * 15, np.uint16))

    scan = importer.run(write_capture(tmp_path, deepen), who="anna")
    levels = decode(given(importer, scan)["levels"].document, Levels, importer.store)
    assert levels.frames[2].bit_depth == 12
    assert levels.frames[2].gray.max() > 3000


def test_progress_counts_the_frames(importer, tmp_path):
    told = []
    importer.run(
        write_capture(tmp_path),
        who="anna",
        progress=lambda done, text="": told.append((done, text)),
    )
    assert told[0] == (0.0, "frame 1 of 3")
    assert told[-1][1] == "frame 3 of 3"


@dataclass(frozen=True)
class Wrong:
    """One thing that is wrong with a folder, and words of the sentence that says so."""

    name: str
    change: Any
    words: str


def _set(path: str, value: Any) -> Any:
    """Change one value of the document, e.g. `cameras.main.bit_depth`."""

    def change(document: dict[str, Any], folder: Path) -> None:
        *parents, last = path.split(".")
        place: Any = document
        for part in parents:
            place = place[int(part) if isinstance(place, list) else part]
        place[int(last) if isinstance(place, list) else last] = value

    return change


def _calibrated(path: str, value: Any) -> Any:
    def change(document: dict[str, Any], folder: Path) -> None:
        calibrate(document, folder)
        _set(path, value)(document, folder)

    return change


def _file(name: str, make: Any) -> Any:
    return lambda document, folder: make(folder / name)


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-8])


def _scan_json(document: Any) -> Any:
    return _file("scan.json", lambda file: file.write_text(json.dumps(document)))


WRONG = [
    Wrong("missing picture", _file("100.png", Path.unlink), r"100\.png is missing"),
    Wrong("truncated picture", _file("100.png", _cut), "truncated"),
    Wrong("empty picture", _file("100.png", lambda f: f.write_bytes(b"")), "truncated"),
    Wrong("no picture", _file("100.png", lambda f: f.write_text("hello")), "no picture"),
    Wrong("wrong size", _set("cameras.main.width_px", 9), "8x6 px, but its camera has 9x6"),
    Wrong(
        "mixed bit depths",
        _file("100.png", lambda f: cv2.imwrite(str(f), picture(100, np.uint16))),
        "16 bits a pixel, but its camera's bit depth is 8",
    ),
    Wrong("unknown pattern", _set("frames.1.pattern", {"kind": "spiral"}), "spiral"),
    Wrong("unknown format", _set("format", "other"), "unglare-capture"),
    Wrong("unknown version", _set("version", 2), "version"),
    Wrong("unknown method", _set("method", "magic"), "no method 'magic'.*levels"),
    Wrong("unknown camera", _set("frames.1.camera", "right"), "camera 'right'"),
    Wrong("unknown stage", _set("frames.1.stage", "polish"), "'polish'.*levels"),
    Wrong("no frames", _set("frames", []), "frames"),
    Wrong("file outside", _set("frames.1.file", "../../etc/passwd"), "lies outside"),
    Wrong("negative exposure", _set("frames.1.exposure_ms", -1), "exposure_ms"),
    Wrong("not finite", _calibrated("cameras.main.K", [[float("nan"), 0, 0], *K[1:]]), "finite"),
    Wrong(
        "singular", _calibrated("cameras.main.K", [[0, 0, 0], *K[1:]]), "'main'.*calibrate again"
    ),
    Wrong("no rotation", _calibrated("extrinsics.0.R", [[2.0, 0, 0], *EYE[1:]]), "no rotation"),
    Wrong("mirror", _calibrated("extrinsics.0.R", [[-1.0, 0, 0], *EYE[1:]]), "no rotation"),
    Wrong("no base line", _calibrated("extrinsics.0.t_mm", [0, 0, 0]), "base line"),
    Wrong("seven coefficients", _calibrated("cameras.main.distortion", [0.0] * 7), "7 distortion"),
    Wrong("unknown device", _calibrated("extrinsics.0.to", "screen"), "screen"),
    Wrong("too few frames", lambda d, f: d["frames"].__delitem__(slice(1, 3)), "Two fields"),
    Wrong("foreign scan.json", _scan_json({"format": "theirs"}), "isn't a scan of ours"),
    Wrong("broken scan.json", _scan_json({"format": "unglare-scan", "version": 1}), "remove it"),
    Wrong("scan.json is a list", _scan_json([]), "one JSON object"),
]


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.name)
def test_what_is_wrong_is_said_in_one_sentence_and_nothing_is_made(importer, tmp_path, wrong):
    folder = write_capture(tmp_path / "capture", wrong.change)
    with pytest.raises(UnglareError, match=wrong.words) as raised:
        importer.run(folder, who="anna")
    assert "\n" not in raised.value.sentence
    assert raised.value.sentence.endswith(".")
    with importer.database.reading() as repositories:
        assert repositories.scans.count() == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", r"isn't JSON.*line 1"), ("[]", "one JSON object"), ("\xff", "can't be read")],
)
def test_a_file_that_is_no_json_object_is_refused(importer, tmp_path, text, words):
    (tmp_path / "capture.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(UnglareError, match=words):
        importer.run(tmp_path, who="anna")


def test_a_folder_without_capture_is_refused(importer, tmp_path):
    with pytest.raises(UnglareError, match=r"no file .*capture\.json"):
        importer.run(tmp_path, who="anna")


def test_a_gray_level_beyond_the_bit_depth_is_refused(importer, tmp_path):
    def deepen(document, folder):
        document["cameras"]["main"]["bit_depth"] = 10
        for gray in (0, 100, 200):
            cv2.imwrite(str(folder / f"{gray}.png"), picture(gray * 15, np.uint16))

    with pytest.raises(UnglareError, match="more than 10 bits can"):
        importer.run(write_capture(tmp_path, deepen), who="anna")
