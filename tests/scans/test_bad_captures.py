"""Captures of fringes that can't be measured: one sentence each, at the import or at the stage that finds it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.cli.application import run
from tests.scans.test_golden_export import GOLDEN

Frames = list[dict[str, Any]]


@dataclass(frozen=True)
class Bad:
    """What is wrong, and words of what is said about it."""

    name: str
    change: Callable[[Frames, Path], Frames]
    words: str


def without(*files: str) -> Callable[[Frames, Path], Frames]:
    return lambda frames, folder: [f for f in frames if not f["file"].endswith(files)]


def only_periods(*periods: float) -> Callable[[Frames, Path], Frames]:
    def change(frames: Frames, folder: Path) -> Frames:
        return [f for f in frames if f["pattern"].get("periods") in periods]

    return change


def repainted(gray: int) -> Callable[[Frames, Path], Frames]:
    def change(frames: Frames, folder: Path) -> Frames:
        for frame in frames:
            cv2.imwrite(str(folder / frame["file"]), np.full((96, 128), gray, np.uint8))
        return frames

    return change


def no_fringes(frames: Frames, folder: Path) -> Frames:
    return [f | {"pattern": {"kind": "uniform", "gray": 255}} for f in frames]


def other_gain(frames: Frames, folder: Path) -> Frames:
    return [frames[0] | {"gain_db": 6.0}, *frames[1:]]


BAD = [
    Bad("incomplete step set", without("left/0005.png"), "incomplete"),
    Bad("two steps only", without("0002.png", "0003.png", "0006.png", "0007.png", "0010.png", "0011.png"), "step"),
    Bad("no fringes at all", no_fringes, "no fringes"),
    Bad("different gains", other_gain, "different gains"),
    Bad("one frequency", only_periods(64.0), "frequencies, got 1"),
    Bad("frequencies with a common divisor", only_periods(64.0, 70.0), "70"),
    Bad("all black", repainted(4), "0.0% of all pixels"),
    Bad("all white", repainted(255), "saturated at every exposure"),
]  # fmt: skip


@pytest.fixture
def fringes(tmp_path: Path) -> Path:
    """Return the golden sample's fringes as somebody else's capture."""
    folder = tmp_path / "capture"
    shutil.copytree(GOLDEN, folder)
    (folder / "scan.json").unlink()
    document = json.loads((folder / "capture.json").read_text())
    document["frames"] = [f for f in document["frames"] if f["stage"] == "fringe_capture"]
    for frame in document["frames"]:
        del frame["journal"]
    (folder / "capture.json").write_text(json.dumps(document))
    return folder


@pytest.mark.scan
@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad.name)
def test_what_cannot_be_measured_ends_in_one_sentence(fringes, tmp_path, capsys, bad):
    document = json.loads((fringes / "capture.json").read_text())
    document["frames"] = bad.change(document["frames"], fringes)
    (fringes / "capture.json").write_text(json.dumps(document))
    status = run(["import", str(fringes), "--data", str(tmp_path / "data"), "--json", "--quiet"])
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert status == 1, answer
    assert "Defect" not in answer["error"]
    assert "\n" not in answer["error"]
    assert bad.words in answer["error"]
    assert "Traceback" not in err


@pytest.mark.scan
def test_the_capture_itself_can_be_measured(fringes, tmp_path, capsys):
    assert run(["import", str(fringes), "--data", str(tmp_path / "data"), "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] > 1000
