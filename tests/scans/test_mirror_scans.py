"""Mirrors before the simulated screen, measured end to end: errors against the truth, dents, defects, refusals."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.cli.application import run

pytestmark = pytest.mark.scan

SMALL = ("--method", "fringe-reflection", "--size", "320x240")

Scan = Callable[..., dict[str, Any]]


@pytest.fixture
def scan(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch) -> Scan:
    """Make a scan with a data folder of the test's own, return its answer."""
    monkeypatch.setenv("UNGLARE_DATA_FOLDER", str(tmp_path / "data"))

    def command(*arguments: str) -> dict[str, Any]:
        run(["scan", *SMALL, *map(str, arguments), "--json", "--quiet"])
        answer: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
        return answer

    return command


@pytest.mark.parametrize(
    "arguments",
    [
        ("--scene", "mirror-parabola", "--chain", "D"),
        ("--scene", "mirror-freeform", "--chain", "E", "--set", "slopes.order=6"),
    ],
)
def test_mirrors_are_measured_to_20_urad_and_a_tenth_of_a_micrometre(scan, arguments):
    """8 bit, with noise; heights are asked for without."""
    answer = scan(*arguments)
    assert answer["status"] == "finished", answer.get("error")
    assert answer["rig"] == "sim-lcd"
    figures = answer["mirror"]
    assert figures["measured"] > 0.99 * figures["base"] > 20_000
    assert figures["slope_rms_urad"] < 20
    assert figures["height_rms_um"] < 0.1
    assert answer["truth"]["completeness"] > 0.99


def test_a_dent_of_5_um_shows_in_height_and_curvature(scan, tmp_path):
    out = tmp_path / "out"
    answer = scan("--scene", "mirror-dent", "--rig-option", "noise=false", "--out", out)
    assert answer["mirror"]["height_rms_um"] < 0.1
    assert answer["mirror"]["slope_rms_urad"] < 10
    height_um = np.load(out / "maps/surface.error_um.camera.npy")
    curvature = np.load(out / "maps/slopes.curvature_per_m.camera.npy")
    known = np.isfinite(height_um)
    usual = np.median(height_um[known])
    lowest = np.unravel_index(np.nanargmin(height_um), height_um.shape)
    assert height_um[lowest] - usual == pytest.approx(-5.0, abs=0.3)
    inner = np.isfinite(curvature)
    spread = 1.4826 * np.median(np.abs(curvature[inner] - np.median(curvature[inner])))
    assert curvature[lowest] - np.median(curvature[inner]) > 10 * spread


def test_a_defective_frame_is_named_and_left_out(scan):
    answer = scan("--rig-option", "defect_frame=20", "--rig-option", "defect=dimmed")
    assert answer["status"] == "finished", answer.get("error")
    check = next(
        check
        for stage in answer["stages"]
        for check in stage["checks"]
        if check["name"] == "defective frames"
    )
    # The stack's six pictures of one fringe pattern come first.
    assert check["level"] == "warning"
    assert check["sentence"].startswith("frame 14 of")
    assert answer["mirror"]["height_rms_um"] < 0.1


def test_a_mirror_outside_the_view_ends_in_one_sentence(scan):
    answer = scan("--rig-option", "aim_mm=900,0")
    assert answer["status"] == "failed"
    assert answer["error"].startswith("The screen isn't seen")
    assert "\n" not in answer["error"]


def test_without_calibration_a_scan_ends_before_the_slopes_and_says_why(scan):
    stages = {s["name"]: s for s in scan("--rig-option", "calibrated=false")["stages"]}
    assert stages["screen_phase"]["status"] == "done"
    assert stages["slopes"]["status"] == "unavailable"
    assert "needs rig calibration" in stages["slopes"]["message"]
