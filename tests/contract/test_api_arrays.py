"""Arrays over HTTP: uploads that a setting may name, and what all frames say at one pixel."""

import io
import re
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from backend.services import array_uploads
from tests.contract.api_server import VIEWER_TOKEN, api, program, serving, toy_house
from tests.scans.toy import HEIGHT_PX, WIDTH_PX
from tests.scans.toy_house import House

RAMP = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, House]]:
    folder = tmp_path_factory.mktemp("data")
    with toy_house(folder) as house, serving(api(house, folder)) as address:
        yield address, house


@pytest.fixture
def client(place: tuple[str, House]) -> Iterator[httpx.Client]:
    with program(place[0]) as client:
        yield client


@pytest.fixture(scope="module")
def scan(place: tuple[str, House]) -> str:
    house = place[1]
    return house.run_through(house.create(settings={"toy_fringes": {"steps": 4}}).id).id


def npy(array: np.ndarray[Any, Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def picture(array: np.ndarray[Any, Any], suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, array)[1].tobytes()


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (npy(RAMP), RAMP),
        (npy(RAMP.astype(np.float64).T), RAMP.T),
        (npy(np.where(RAMP > 0.5, np.nan, RAMP)), np.where(RAMP > 0.5, np.nan, RAMP)),
        (npy(RAMP > 0.5), (RAMP > 0.5).astype(np.float32)),
        (picture((RAMP * 255).astype(np.uint8)), (RAMP * 255).astype(np.uint8) / np.float32(255)),
        (
            picture((RAMP * 65535).astype(np.uint16)),
            (RAMP * 65535).astype(np.uint16) / np.float32(65535),
        ),
        (
            picture(cv2.cvtColor(np.full((2, 3), 51, np.uint8), cv2.COLOR_GRAY2BGRA)),
            np.full((2, 3), 0.2, np.float32),
        ),
        (picture(np.full((2, 3), 255, np.uint8), ".tiff"), np.ones((2, 3), np.float32)),
    ],
    ids=[
        "npy",
        "transposed doubles",
        "painted in part",
        "booleans",
        "8 bit",
        "16 bit",
        "gray in colour",
        "tiff",
    ],
)
def test_a_mask_is_kept_as_factors(client: httpx.Client, body: bytes, expected: Any) -> None:
    answer = client.post("/api/artifacts", content=body)
    assert answer.status_code == 201, answer.text
    kept = np.load(io.BytesIO(client.get(f"/api/artifacts/{answer.json()['hash']}").content))
    assert kept.dtype == np.float32
    np.testing.assert_allclose(kept, expected, atol=1e-6)


def test_an_array_is_kept_as_it_is(client: httpx.Client) -> None:
    wanted = np.array([[[1.5, np.nan, 3e9]]])
    answer = client.post("/api/artifacts?kind=array", content=npy(wanted)).json()
    kept = np.load(io.BytesIO(client.get(f"/api/artifacts/{answer['hash']}").content))
    assert (kept.dtype, answer["shape"]) == (np.float64, [1, 1, 3])
    np.testing.assert_array_equal(kept, wanted)


GIANT = bytearray(picture(np.zeros((2, 2), np.uint8)))
GIANT[16:24] = (60_000).to_bytes(4) * 2
COLOURED = picture(np.arange(12, dtype=np.uint8).reshape(2, 2, 3))


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        (b"", "0 bytes is neither a .npy file nor a picture"),
        (b"GIF89a nothing", "neither a .npy file nor a picture of 8 or 16 bit"),
        (npy(RAMP)[:-4], r"can't be read .*: save it again"),
        (npy(np.array(["a"])), "holds <U1: save numbers"),
        (npy(np.array([{}], dtype=object)), "can't be read"),
        (npy(RAMP * 2), "from 0 to 1, but the upload has 0 to 2"),
        (npy(np.where(RAMP > 0.5, np.inf, RAMP)), "from 0 to 1, but the upload has 0 to inf"),
        (npy(RAMP[None]), "height x width, but the upload is 1 x 3 x 4"),
        (npy(np.zeros((0, 3))), "height x width, but the upload is 0 x 3"),
        (COLOURED, "is in colour: save it in shades of gray"),
        (bytes(GIANT), "60000 x 60000 px"),
    ],
    ids=["empty", "text", "cut", "texts", "objects", "bright", "inf", "stack", "nothing", "colour", "giant"],
)  # fmt: skip
def test_what_is_no_mask_is_refused_in_a_sentence(
    client: httpx.Client, body: bytes, sentence: str
) -> None:
    answer = client.post("/api/artifacts", content=body)
    assert answer.status_code == 422, answer.text
    assert re.search(sentence, answer.json()["detail"]), answer.json()["detail"]


def test_an_upload_has_a_largest_size(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("backend.api.artifacts.LARGEST_UPLOAD_BYTES", 2**20)
    answer = client.post("/api/artifacts", content=npy(np.zeros((600, 600), np.float32)))
    assert answer.status_code == 413
    assert answer.json()["detail"].startswith("The upload is larger than 1 MiB")
    assert array_uploads.LARGEST_UPLOAD_BYTES > 2**20


def test_viewers_upload_nothing(place: tuple[str, House]) -> None:
    with program(place[0], VIEWER_TOKEN) as viewer:
        assert viewer.post("/api/artifacts", content=npy(RAMP)).status_code == 403


def test_an_uploaded_mask_can_be_set(client: httpx.Client, scan: str) -> None:
    mask = client.post("/api/artifacts", content=npy(np.ones((HEIGHT_PX, WIDTH_PX)))).json()["hash"]
    revision = client.get(f"/api/scans/{scan}").json()["revision"]
    path = f"/api/scans/{scan}/settings/toy_levels"
    refused = client.patch(path, json={"changes": {"mask": "0" * 64}, "revision": revision})
    answer = client.patch(path, json={"changes": {"mask": mask}, "revision": revision})
    assert refused.status_code == 422
    assert answer.status_code == 200, answer.text
    revision = answer.json()["revision"]
    client.post(f"/api/scans/{scan}/undo", json={"revision": revision}).raise_for_status()


AT = "/api/scans/{}/stages/{}/fields/{}/at"


def test_a_pixel_tells_its_gray_levels_over_the_axis(client: httpx.Client, scan: str) -> None:
    query: dict[str, str | int] = {"camera": "right", "x": 5, "y": 3}
    levels = client.get(AT.format(scan, "toy_fringes", "frames"), params=query).json()
    frames = client.get(f"/api/scans/{scan}").json()["stages"][2]["fields"][0]["frames"]
    own = [f for f in frames if f["camera"] == "right"]
    there = [
        client.get(f"/api/artifacts/{f['image']['hash']}/at", params={"x": 5, "y": 3}).json()
        for f in own
    ]
    assert levels["gray"] == [v["value"] for v in there]
    assert levels["exposure_ms"] == [f["exposure_ms"] for f in own]
    assert levels["axis"] == pytest.approx([k * np.pi / 2 for k in range(4)] * 2)
    assert (levels["slope"], levels["offset"], levels["full_scale_gray"]) == (None, 2.5, 255)


@pytest.mark.parametrize(
    ("stage", "field", "query", "status", "sentence"),
    [
        ("toy_fringes", "frames", {"camera": "top", "x": 0, "y": 0}, 404, "no frames of camera 'top'; there are of left, right"),
        ("toy_fringes", "frames", {"camera": "left", "x": WIDTH_PX, "y": 0}, 404, f"no pixel at x {WIDTH_PX}"),
        ("toy_fringes", "note", {"camera": "left", "x": 0, "y": 0}, 404, "no frames 'note'; it has frames"),
        ("toy_none", "frames", {"camera": "left", "x": 0, "y": 0}, 404, "no stage 'toy_none'"),
    ],
    ids=["camera", "pixel", "field", "stage"],
)  # fmt: skip
def test_what_is_not_there_is_named(
    client: httpx.Client, scan: str, stage: str, field: str, query: Any, status: int, sentence: str
) -> None:
    answer = client.get(AT.format(scan, stage, field), params=query)
    assert answer.status_code == status
    assert sentence in answer.json()["detail"]


def test_a_stage_that_has_not_run_has_no_pixels(client: httpx.Client) -> None:
    scan = client.post("/api/scans", json={"method": "toy", "rig": "toy"}).json()["id"]
    answer = client.get(
        AT.format(scan, "toy_fringes", "frames"), params={"camera": "left", "x": 0, "y": 0}
    )
    assert (answer.status_code, answer.json()["detail"]) == (
        409, "Fringes has no result now: run it first.",
    )  # fmt: skip
