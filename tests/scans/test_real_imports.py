"""Real captures, imported and run: where each ends, and what the shell's cloud is worth."""

import os
from pathlib import Path

import cv2  # noqa: F401  before open3d: both bring an OpenMP runtime
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from backend.domain.states import StageStatus
from backend.jobs.loading import NO_RIG
from backend.stages.cloud import Cloud
from backend.storage.codec import decode
from tests.scans.houses import real_house, run_unattended, stage_of

pytestmark = pytest.mark.skipif(
    "UNGLARE_DATA" not in os.environ, reason="UNGLARE_DATA names no folder of real captures"
)


def real(path: str) -> Path:
    return Path(os.environ["UNGLARE_DATA"]) / path


def test_the_shell_becomes_the_authors_cloud(tmp_path):
    with real_house(tmp_path) as services:
        imported = services.import_capture(str(real("gray-inverse-procam-shell")), "", "test")
        assert (imported.rig, imported.method) == (NO_RIG, "adaptive-code")
        state = run_unattended(services, imported.id)
        assert stage_of(imported, "code_capture").status is StageStatus.GIVEN
        assert stage_of(imported, "base_exposure").status is StageStatus.UNAVAILABLE
        assert {stage_of(state, name).status for name in ("edges", "code_cloud")} == {
            StageStatus.DONE
        }
        run = stage_of(state, "code_cloud").stage_run
        assert run is not None
        with services.context.database.reading() as repositories:
            document = repositories.runs.get(run).document
        assert document is not None
        cloud = decode(document, Cloud, services.context.store)
        file = real("gray-inverse-procam-shell/reference/upstream_cloud.ply")
        reference = np.asarray(o3d.io.read_point_cloud(file).points) * [1, -1, -1]
        distance = cKDTree(cloud.points_mm).query(reference)[0]
    assert cloud.point_count >= 290_000
    assert cloud.epipolar_sigma_px <= 1.1
    assert np.median(distance) <= 0.2
    assert np.percentile(distance, 95) <= 0.6


@pytest.mark.parametrize(
    ("path", "last"),
    [
        ("ps-3freq-board-bottle/capture-board.json", "fringe_phase"),
        ("ps-3freq-board-bottle/capture-bottle.json", "fringe_phase"),
        ("ps-3freq-xy-box/capture.json", "fringe_phase"),
    ],
)
def test_fringes_without_calibration_end_with_the_phase_and_say_so(tmp_path, path, last):
    with real_house(tmp_path) as services:
        imported = services.import_capture(str(real(path)), "", "test")
        assert stage_of(imported, "fringe_capture").status is StageStatus.GIVEN
        assert stage_of(imported, "pre_exposure").status is StageStatus.UNAVAILABLE
        state = run_unattended(services, imported.id)
    assert stage_of(state, last).status is StageStatus.DONE
    assert state.stages[-1].status is StageStatus.UNAVAILABLE
    assert "needs rig calibration" in state.stages[-1].message
