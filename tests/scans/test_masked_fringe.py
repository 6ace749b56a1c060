"""Fringes under the mask the rig finds, and under bands: what no exposure brings back, they do."""

from typing import Any

import pytest

from backend.contract.requests import CreateScan
from backend.numerics.scoring import Score
from backend.services.services import Services
from tests.scans.houses import real_house, run_unattended

pytestmark = pytest.mark.scan

METAL = {"scene": "metal", "size": "480x360", "projector_size": "640x400"}


def bracket_of(services: Services, **wanted: Any) -> Score:
    """Run a scan of the metal parts to its end and score its bracket."""
    made = CreateScan(method="masked-fringe", rig_options=METAL, **wanted)
    scan = services.create_scan(made, "ada").id
    job = run_unattended(services, scan).job
    assert job is not None
    assert job.error is None
    scores = services.report(scan).scores
    assert scores is not None
    return scores.parts["bracket"]


def test_bands_measure_what_second_reflections_spoil(tmp_path):
    with real_house(tmp_path) as services:
        without = bracket_of(services, preset="mask only")
        with_bands = bracket_of(services)
    assert with_bands.completeness > without.completeness + 0.05
    assert with_bands.outlier_share < 0.03
