"""Fringes under the mask the rig finds, and under bands: what no exposure brings back, they do."""

import pytest

from backend.contract.requests import CreateScan
from tests.scans.houses import real_house, run_unattended

pytestmark = pytest.mark.scan

METAL = {"scene": "metal", "size": "480x360", "projector_size": "640x400"}


def test_bands_measure_what_second_reflections_spoil(tmp_path):
    with real_house(tmp_path) as services:
        made = CreateScan(method="masked-fringe", rig_options=METAL, preset="mask only")
        masked = services.create_scan(made, "ada").id
        assert run_unattended(services, masked).job.error is None
        without = services.report(masked).scores.parts["bracket"]
        made = CreateScan(method="masked-fringe", rig_options=METAL)
        banded = services.create_scan(made, "ada").id
        assert run_unattended(services, banded).job.error is None
        with_bands = services.report(banded).scores.parts["bracket"]
    assert with_bands.completeness > without.completeness + 0.05
    assert with_bands.outlier_share < 0.03
