"""What a scan is worth, and that nobody opens hardware to find out."""

import math
from dataclasses import replace

import numpy as np
import pytest

from backend.contract.requests import CreateScan
from backend.domain.errors import NotFoundError
from backend.numerics.reasons import Reason
from backend.numerics.scoring import Score, Scores, Truth
from backend.services.reporting import compare_with_truth, truth_document
from tests.scans.houses import real_house, run_unattended
from tests.unit.test_ply import make_cloud

SMALL = {"scene": "plane", "size": "160x120"}


def test_a_rig_that_is_no_simulation_is_not_asked(house):
    scan = house.run_through(house.create().id).id

    def opened(*_: object) -> None:
        raise AssertionError("nobody asked for the rig to be opened")

    house.services.context.rigs.use = opened
    figures = house.services.report(scan)
    assert figures.scores is None
    assert figures.light_s > 0


@pytest.mark.scan
def test_a_simulated_rig_that_is_gone_costs_the_truth_only(tmp_path, monkeypatch, caplog):
    with real_house(tmp_path) as services:
        state = services.create_scan(CreateScan(method="hdr-fringe", rig_options=SMALL), "ada")
        run_unattended(services, state.id)
        known = services.report(state.id)

        def gone(*_: object) -> None:
            raise NotFoundError("There is no such rig any more.")

        monkeypatch.setattr(services.context.rigs, "use", gone)
        unknown = services.report(state.id)
        services.export(state.id, str(tmp_path / "out"), False, "ada")
    assert known.scores is not None
    assert 0 < known.waited_s < known.duration_s
    assert known.document()["computing_s"] == pytest.approx(
        known.duration_s - known.waited_s, abs=0.002
    )
    assert unknown.scores is None
    assert unknown.points == known.points
    assert "no such rig" in caplog.text


def test_points_between_pixels_are_scored_and_saturated_ones_counted():
    cloud = make_cloud(10)
    flat = np.tile(np.array([0, 0, 700], np.float32), (1, 640, 1))
    lit, part = np.ones((1, 640), bool), np.zeros((1, 640), np.int16)
    truth = Truth(
        flat.astype(np.float32), np.zeros_like(flat, np.float32), lit, ~lit, part, ("wall",)
    )
    seen = {"left": np.full((1, 640), np.nan, np.float32)}
    given_up = {"left": np.arange(640)[None].astype(np.uint16) % 2 * np.uint16(Reason.SATURATED)}
    cloud = replace(cloud, depth_mm=seen, reasons=given_up)
    whole = compare_with_truth(cloud, truth)
    assert whole is not None
    assert whole.total.over_exposed_share == 0.5
    cloud.pixel_x[0] += 0.5
    between = compare_with_truth(cloud, truth)
    assert between is not None
    assert between.total.accepted == whole.total.accepted
    elsewhere = {"left": np.full((2, 640), np.nan, np.float32)}
    assert compare_with_truth(replace(cloud, depth_mm=elsewhere), truth) is None


def test_what_cannot_be_said_is_null():
    nothing = Score(0, 0, *[math.nan] * 7)
    document = truth_document(Scores(nothing, {"hole": nothing}, 0, 0, 0))
    assert document["truth"]["completeness"] is None
    assert document["parts"]["hole"]["base"] == 0
    assert "Base: pixels" in document["truth"]["definition"]
    assert truth_document(None) == {}
