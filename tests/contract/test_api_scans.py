"""A scan over HTTP, and every way a request can go wrong."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from backend.jobs.runner import InlineRunner
from tests.contract.api_server import VIEWER_TOKEN, api, program, serving, toy_house, toy_server
from tests.scans.toy import HEIGHT_PX, WIDTH_PX
from tests.scans.toy_house import House


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, House]]:
    folder = tmp_path_factory.mktemp("data")
    with toy_house(folder, InlineRunner) as house, serving(api(house, folder)) as address:
        yield address, house


@pytest.fixture
def client(place: tuple[str, House]) -> Iterator[httpx.Client]:
    with program(place[0]) as client:
        client.headers["X-Unglare-User"] = "Ada"
        yield client


@pytest.fixture
def viewer(place: tuple[str, House]) -> Iterator[httpx.Client]:
    with program(place[0], VIEWER_TOKEN) as client:
        yield client


def create(client: httpx.Client, **fields: Any) -> dict[str, Any]:
    answer = client.post(
        "/api/scans", json={"method": "toy", "rig": "toy", "name": "part"} | fields
    )
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def stage_of(state: dict[str, Any], name: str) -> dict[str, Any]:
    return next(s for s in state["stages"] if s["name"] == name)


@pytest.fixture(scope="module")
def finished(place: tuple[str, House]) -> dict[str, Any]:
    """A scan that ran through, as its whole state."""
    with program(place[0]) as client:
        scan = create(client, name="finished")["id"]
        answer = client.post(f"/api/scans/{scan}/runs", json={"unattended": True})
        assert answer.status_code == 202, answer.text
        state = client.get(f"/api/scans/{scan}").json()
    assert state["status"] == "done", state["job"]
    return dict(state)


def test_methods_describe_their_stages(client: httpx.Client) -> None:
    [method] = client.get("/api/methods").json()["methods"]

    assert method["stages"][0]["name"] == "toy_look"


def test_a_scan_goes_its_way_and_every_step_is_under_a_name(client: httpx.Client) -> None:
    scan = create(client)
    at_gate = client.post(f"/api/scans/{scan['id']}/runs", json={}).json()
    phase = stage_of(client.get(f"/api/scans/{scan['id']}").json(), "toy_phase")
    accepted = client.post(
        f"/api/stage-runs/{phase['stage_run']}/decision",
        json={"verdict": "accept", "reason": "looks right", "proceed": False},
    ).json()
    audit = client.get(f"/api/scans/{scan['id']}/audit").json()

    assert at_gate["id"] == scan["id"]
    assert phase["status"] == "awaiting_review"
    assert stage_of(accepted, "toy_phase")["decision"]["who"] == "Ada"
    assert {"created", "run", "accepted"} <= {line["action"] for line in audit}
    assert {line["who"] for line in audit} == {"Ada"}


def test_edit_and_undo_answer_with_the_whole_state(client: httpx.Client) -> None:
    scan = create(client)
    address = f"/api/scans/{scan['id']}"

    edited = client.patch(
        f"{address}/settings/toy_levels",
        json={"changes": {"step_gray": 32}, "revision": scan["revision"]},
    ).json()
    undone = client.post(f"{address}/undo", json={"revision": edited["revision"]}).json()

    assert stage_of(edited, "toy_levels")["settings"]["step_gray"]["value"] == 32
    assert stage_of(undone, "toy_levels")["settings"]["step_gray"]["source"] == "default"


def test_a_stale_edit_is_answered_with_the_other_one(client: httpx.Client) -> None:
    scan = create(client)
    address = f"/api/scans/{scan['id']}/settings/toy_levels"
    change = {"changes": {"step_gray": 32}, "revision": scan["revision"], "reason": "finer"}
    client.patch(address, json=change, headers={"X-Unglare-User": "Grace"})

    answer = client.patch(address, json=change | {"changes": {"step_gray": 16}})

    assert answer.status_code == 409
    problem = answer.json()
    assert problem["type"] == "stale-edit"
    assert problem["details"]["edit"]["who"] == "Grace"
    assert problem["details"]["edit"]["new"] == 32


@pytest.mark.parametrize("path", ["redo/toy_look", "redo/all"])
def test_redo_takes_the_pictures_again(
    client: httpx.Client, finished: dict[str, Any], path: str
) -> None:
    scan = create(client)

    answer = client.post(
        f"/api/scans/{scan['id']}/{path}", json={"all": path.endswith("all"), "revision": 0}
    )

    assert answer.status_code == 200, answer.text
    taken = [s["take"] for s in answer.json()["stages"] if s["name"] in ("toy_look", "toy_fringes")]
    first = taken[0]
    assert first > stage_of(scan, "toy_look")["take"]
    assert (taken[1] == first) is path.endswith("all")


def test_nothing_to_cancel_is_a_conflict(client: httpx.Client) -> None:
    answer = client.delete(f"/api/scans/{create(client)['id']}/runs")

    assert (answer.status_code, answer.json()["type"]) == (409, "conflict")


def test_the_list_is_paged_and_searched(client: httpx.Client) -> None:
    for name in ("needle one", "needle two", "hay"):
        create(client, name=name)

    found = client.get("/api/scans", params={"text": "needle"}).json()
    page = client.get("/api/scans", params={"text": "needle", "limit": 1, "offset": 1}).json()

    assert [scan["name"] for scan in found] == ["needle two", "needle one"]
    assert [scan["name"] for scan in page] == ["needle one"]


def test_a_viewer_looks_but_changes_nothing(viewer: httpx.Client, finished: dict[str, Any]) -> None:
    address = f"/api/scans/{finished['id']}"

    looks = [viewer.get(path).status_code for path in (address, "/api/scans", f"{address}/audit")]
    changes = [
        viewer.post("/api/scans", json={"method": "toy"}),
        viewer.post(f"{address}/runs", json={}),
        viewer.delete(f"{address}/runs"),
        viewer.patch(f"{address}/settings/toy_levels", json={"changes": {}, "revision": 0}),
    ]

    assert looks == [200] * 3
    assert {answer.status_code for answer in changes} == {403}
    assert "may look but not change" in changes[0].json()["detail"]


# ---- what goes wrong


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("{}", "Field method of the body is missing."),
        ('{"method": 7}', "Field method of the body is 7: Input should be a valid string."),
        (
            '{"method": "toy", "shape": 1}',
            "Field shape of the body is 1: Extra inputs are not permitted.",
        ),
        (
            json.dumps({"method": "toy", "name": "x" * 201}),
            f"Field name of the body is '{'x' * 78}…: String should have at most 200 characters.",
        ),
        ('{"method": ', "The body is no JSON: Expecting value."),
        ("[]", "The body can't be used: Input should be a valid dictionary or object"),
    ],
)
def test_a_bad_request_is_one_sentence(client: httpx.Client, body: str, sentence: str) -> None:
    answer = client.post("/api/scans", content=body, headers={"Content-Type": "application/json"})

    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == "invalid-request"
    assert answer.json()["detail"].startswith(sentence)


def test_several_findings_are_counted_and_listed(client: httpx.Client) -> None:
    answer = client.post("/api/scans", json={"name": 1, "note": 2})

    assert answer.json()["detail"] == "Field method of the body is missing (2 more)."
    assert len(answer.json()["details"]["errors"]) == 3


@pytest.mark.parametrize(
    ("method", "path", "status", "kind"),
    [
        ("GET", "/api/scans/nothere", 404, "not-found"),
        ("GET", "/api/nothing", 404, "not-found"),
        ("PUT", "/api/scans", 405, "method-not-allowed"),
        ("GET", "/api/scans?limit=0", 422, "invalid-request"),
        ("GET", "/api/artifacts/..%2F..%2Fetc%2Fpasswd", 404, "not-found"),
        ("GET", "/api/artifacts/ABCDEF0123456789", 422, "invalid-request"),
        ("GET", f"/api/artifacts/{'0' * 64}", 404, "not-found"),
        ("GET", "/api/rigs/unknown/cameras/left/preview", 404, "not-found"),
    ],
)
def test_what_isnt_there_or_cant_be_asked(
    client: httpx.Client, method: str, path: str, status: int, kind: str
) -> None:
    answer = client.request(method, path)

    assert answer.status_code == status
    assert answer.json()["type"] == kind
    assert answer.json()["detail"]


def test_a_rig_that_was_never_opened_has_no_picture_yet(tmp_path: Path) -> None:
    with toy_server(tmp_path) as address, program(address) as client:
        assert client.get("/api/rigs/toy/cameras/left/preview").status_code == 204


def test_an_expected_error_of_the_services_is_a_problem(client: httpx.Client) -> None:
    answer = client.post("/api/scans", json={"method": "divination"})

    assert answer.status_code == 404
    assert answer.json()["detail"] == "There is no method 'divination'; there are: toy."


def test_a_body_that_is_too_large_is_refused_before_it_is_read(client: httpx.Client) -> None:
    answer = client.post("/api/scans", content=b"{" + b" " * (9 * 2**20))

    assert (answer.status_code, answer.json()["type"]) == (413, "too-large")


def test_a_body_of_unknown_length_is_refused(client: httpx.Client) -> None:
    answer = client.post("/api/scans", content=iter([b"{}"]))

    assert (answer.status_code, answer.json()["type"]) == (411, "length-required")


def test_a_defect_is_named_in_the_answer_and_told_in_the_log(
    place: tuple[str, House],
    client: httpx.Client,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("the reason")

    monkeypatch.setattr(place[1].services, "methods", broken)

    answer = client.get("/api/methods")

    problem = answer.json()
    assert (answer.status_code, problem["type"]) == (500, "defect")
    assert "the reason" not in answer.text
    [record] = [r for r in caplog.records if problem["details"]["id"] in r.getMessage()]
    assert record.exc_info
    assert "the reason" in str(record.exc_info[1])
    assert answer.headers["x-content-type-options"] == "nosniff"


# ---- arrays


def phase_array(state: dict[str, Any]) -> str:
    fields = {f["name"]: f for f in stage_of(state, "toy_phase")["fields"]}
    return str(fields["phase_rad"]["arrays"]["left"]["hash"])


def test_an_array_comes_whole_and_only_once(client: httpx.Client, finished: dict[str, Any]) -> None:
    address = f"/api/artifacts/{phase_array(finished)}"

    answer = client.get(address)
    again = client.get(address, headers={"If-None-Match": answer.headers["etag"]})

    assert np.load(io.BytesIO(answer.content)).shape == (HEIGHT_PX, WIDTH_PX)
    assert int(answer.headers["content-length"]) == len(answer.content)
    assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
    assert (again.status_code, again.content) == (304, b"")


def test_an_array_comes_as_a_picture(client: httpx.Client, finished: dict[str, Any]) -> None:
    address = f"/api/artifacts/{phase_array(finished)}/preview"

    png = client.get(address, params={"max_px": 16, "colormap": "turbo"})
    jpeg = client.get(address, params={"format": "jpeg", "low": -1.5, "high": 1.5})
    again = client.get(
        address,
        params={"max_px": 16, "colormap": "turbo"},
        headers={"If-None-Match": png.headers["etag"]},
    )

    assert png.content.startswith(b"\x89PNG")
    assert jpeg.content.startswith(b"\xff\xd8")
    assert (png.headers["content-type"], jpeg.headers["content-type"]) == (
        "image/png",
        "image/jpeg",
    )
    assert png.headers["etag"] != jpeg.headers["etag"]
    assert again.status_code == 304


@pytest.mark.parametrize("query", ["colormap=psychedelic", "low=nan", "max_px=99999", "kind=mood"])
def test_a_picture_that_cant_be_drawn_is_refused(
    client: httpx.Client, finished: dict[str, Any], query: str
) -> None:
    answer = client.get(f"/api/artifacts/{phase_array(finished)}/preview?{query}")

    assert answer.status_code == 422


def test_a_pixel_tells_its_value(client: httpx.Client, finished: dict[str, Any]) -> None:
    address = f"/api/artifacts/{phase_array(finished)}"
    whole = np.load(io.BytesIO(client.get(address).content))

    value = client.get(f"{address}/at", params={"x": 3, "y": 5}).json()["value"]

    assert value == pytest.approx(float(whole[5, 3]))
    assert client.get(f"{address}/at", params={"x": WIDTH_PX, "y": 0}).status_code == 404


def test_a_cloud_comes_thinned_and_packed(client: httpx.Client, finished: dict[str, Any]) -> None:
    run = stage_of(finished, "toy_cloud")["stage_run"]

    body = client.get(f"/api/stage-runs/{run}/fields/points_mm/points").content

    length = int.from_bytes(body[:4], "little")
    header = json.loads(body[4 : 4 + length])
    n = header["n"]
    assert header["total"] >= n > 0
    assert len(body) == 4 + length + n * (12 + 3 + 4)
    assert header["scalars"]["height_mm"]["unit"] == "mm"


def test_only_the_scalar_asked_for(client: httpx.Client, finished: dict[str, Any]) -> None:
    run = stage_of(finished, "toy_cloud")["stage_run"]
    address = f"/api/stage-runs/{run}/fields/points_mm/points"

    assert client.get(address, params={"scalar": "height_mm"}).status_code == 200
    assert client.get(address, params={"scalar": "weight"}).status_code == 404
    assert client.get(address, params={"budget": 1}).status_code == 422


def test_a_cloud_file_is_sent_in_pieces(
    place: tuple[str, House],
    client: httpx.Client,
    finished: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parts = [b"ply\n", memoryview(b"points")]
    monkeypatch.setattr(place[1].services, "cloud_ply", lambda scan: iter(parts))

    answer = client.get(f"/api/scans/{finished['id']}/cloud.ply")

    assert answer.content == b"ply\npoints"
    assert answer.headers["content-type"] == "model/ply"
    assert answer.headers["content-disposition"] == f'attachment; filename="{finished["id"]}.ply"'


def test_a_scan_without_cloud_has_no_file(client: httpx.Client) -> None:
    answer = client.get(f"/api/scans/{create(client)['id']}/cloud.ply")

    assert (answer.status_code, answer.json()["type"]) == (409, "conflict")


def test_an_export_names_its_files(
    client: httpx.Client, finished: dict[str, Any], tmp_path: Path
) -> None:
    answer = client.post(
        f"/api/scans/{finished['id']}/export", json={"folder": str(tmp_path / "out")}
    )

    assert answer.status_code == 200, answer.text
    assert str(tmp_path / "out" / "scan.json") in answer.json()
    assert all(Path(file).is_file() for file in answer.json())


# ---- rigs, health, metrics


def test_the_rig_of_a_scan_is_the_one_it_was_made_with(
    client: httpx.Client, finished: dict[str, Any]
) -> None:
    rig = client.get(f"/api/scans/{finished['id']}/rig").json()

    assert [camera["name"] for camera in rig["cameras"]] == ["left", "right"]


def test_a_rig_is_opened_to_be_looked_at(client: httpx.Client) -> None:
    assert client.post("/api/rigs/toy/view", json={}).json()["reference"] == "left"
    broken = client.post("/api/rigs/other/view", json={"broken": True})
    assert broken.status_code == 502
    assert "doesn't answer" in broken.json()["detail"]


def test_rigs_are_offered(viewer: httpx.Client) -> None:
    assert "simulated" in [offer["name"] for offer in viewer.get("/api/rigs").json()]


def test_health_tells_strangers_little_and_users_each_part(
    place: tuple[str, House], viewer: httpx.Client
) -> None:
    stranger = httpx.get(place[0] + "/api/health", trust_env=False)
    known = viewer.get("/api/health")

    assert stranger.status_code == 200
    assert stranger.json()["parts"] == []
    parts = {part["name"]: part["status"] for part in known.json()["parts"]}
    assert parts == {"database": "ok", "store": "ok", "station": "warning", "rig": "ok"}
    assert known.json()["status"] == "warning"


def test_a_part_that_fails_is_a_503(
    place: tuple[str, House], viewer: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: object) -> None:
        raise OSError("the disk is gone")

    monkeypatch.setattr(place[1].services, "scans", gone)

    answer = viewer.get("/api/health")

    assert (answer.status_code, answer.json()["status"]) == (503, "failure")
    assert answer.json()["parts"][0] == {
        "name": "database",
        "status": "failure",
        "sentence": "the disk is gone",
    }


def test_metrics_count_what_was_done(viewer: httpx.Client, finished: dict[str, Any]) -> None:
    answer = viewer.get("/api/metrics")

    lines = answer.text.splitlines()
    values = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert float(values["unglare_frames_total"]) > 0
    assert float(values['unglare_jobs{status="finished"}']) >= 1
    assert float(values['unglare_stage_duration_seconds_count{stage="toy_cloud"}']) >= 1
    assert float(values["unglare_disk_free_bytes"]) > 0
    assert 'unglare_info{version="0.0.test"}' in values
    named = {line.split()[2] for line in lines if line.startswith("# TYPE")}
    assert {
        name.split("{")[0].removesuffix("_sum").removesuffix("_count") for name in values
    } <= named
