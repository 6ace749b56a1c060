"""Calibrations over HTTP; what they do is tested in tests/scans."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.contract.api_server import VIEWER_TOKEN, api, program, serving, toy_house
from tests.scans import toy_house as toys
from tests.scans.test_calibrations import registry


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder: Path = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(toys, "toy_registry", registry)
        with toy_house(folder) as house, serving(api(house, folder)) as address:
            yield address


@pytest.fixture
def client(address: str) -> Iterator[httpx.Client]:
    with program(address) as client:
        client.headers["X-Unglare-User"] = "Ada"
        yield client


def test_a_result_is_kept_handed_over_taken_away_and_withdrawn(client: httpx.Client) -> None:
    scan = client.post("/api/scans", json={"method": "telling", "rig": "toy"}).json()["id"]
    client.post(f"/api/scans/{scan}/runs", json={}).raise_for_status()
    run = client.get(f"/api/scans/{scan}").json()["stages"][0]["stage_run"]
    kept = client.post(f"/api/stage-runs/{run}/calibration")
    assert kept.status_code == 201, kept.text
    number = kept.json()["number"]
    assert (kept.json()["who"], kept.json()["newest"]) == ("Ada", True)
    assert client.get("/api/rigs/toy/calibrations").json() == [kept.json()]
    assert client.get("/api/calibrations").json() == [kept.json()]

    state = client.post("/api/scans", json={"method": "toy", "rig": "toy"}).json()
    assert state["handed"][0]["calibration"] == number
    place = f"/api/scans/{state['id']}/given/Hint"
    assert client.delete(place).json()["handed"][0]["calibration"] is None
    given = client.put(place, json={"scan": scan})
    assert given.json()["handed"][0]["sentence"].startswith("From scan")
    assert client.put(place, json={"scan": scan, "calibration": 1}).status_code == 422
    assert client.delete(f"/api/calibrations/{number}").json()["withdrawn_by"] == "Ada"
    assert client.delete(f"/api/calibrations/{number}").status_code == 409


def test_viewers_keep_nothing(address: str) -> None:
    with program(address, VIEWER_TOKEN) as viewer:
        assert viewer.get("/api/calibrations").status_code == 200
        assert viewer.post("/api/stage-runs/x/calibration").status_code == 403
        assert viewer.delete("/api/calibrations/1").status_code == 403
        assert viewer.put("/api/scans/x/given/Hint", json={"scan": "y"}).status_code == 403
