"""An export of version 1, kept: whatever becomes of the program, it reads what it once wrote.

Made by `unglare scan --scene high-contrast --size 128x96 --seed 7 --name golden --frames
--set pre_exposure.exposure_ms=41.6667 --set exposures.exposures_ms=50,`, without its maps and cloud.
"""

import json
import shutil
from pathlib import Path

import pytest

from backend.contract.capture import Capture
from backend.contract.scan_file import ScanFile
from backend.domain.states import StageStatus
from tests.scans.houses import real_house, run_unattended, stage_of

GOLDEN = Path(__file__).parents[1] / "golden" / "export-v1"


def test_its_files_are_still_understood():
    scan = ScanFile.model_validate_json((GOLDEN / "scan.json").read_text())
    capture = Capture.model_validate_json((GOLDEN / "capture.json").read_text())
    assert (scan.scan.name, scan.method.name, capture.method) == (
        "golden",
        "hdr-fringe",
        "hdr-fringe",
    )
    assert len(capture.frames) == len({f.file for f in capture.frames}) == 30


@pytest.mark.scan
def test_its_captures_give_what_they_gave(tmp_path):
    """The frames and how they enter the stages have to stay bit by bit; algorithms may improve."""
    then = ScanFile.model_validate_json((GOLDEN / "scan.json").read_text())
    hashes = {stage.name: stage.result_hash for stage in then.stages}
    with real_house(tmp_path) as services:
        state = run_unattended(services, services.import_capture(str(GOLDEN), "", "test").id)
        points = services.report(state.id).points
    assert all(s.status is StageStatus.DONE for s in state.stages)
    assert stage_of(state, "fringe_capture").result_hash == hashes["fringe_capture"]
    assert points == pytest.approx(then.metrics["points"], rel=0.05)


@pytest.mark.scan
def test_without_its_scan_json_only_the_fringes_are_read(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "bare")
    (tmp_path / "bare/scan.json").unlink()
    with real_house(tmp_path / "data") as services:
        imported = services.import_capture(str(tmp_path / "bare"), "", "test")
        audit = services.audit(imported.id)
        state = run_unattended(services, imported.id)
    assert stage_of(imported, "fringe_capture").status is StageStatus.GIVEN
    assert stage_of(imported, "pre_exposure").status is StageStatus.UNAVAILABLE
    assert "6 of pre_exposure" in audit[0].sentence
    assert state.stages[-1].status is StageStatus.DONE


def test_the_sample_stays_small():
    files = [f for f in GOLDEN.rglob("*") if f.is_file()]
    assert sum(f.stat().st_size for f in files) < 300_000
    assert json.loads((GOLDEN / "capture.json").read_text())["version"] == 1
