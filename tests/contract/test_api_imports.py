"""Captured folders through the door."""

import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from backend.contract.requests import CreateScan
from backend.contract.scans import ScanState
from backend.domain.errors import InvalidCaptureError
from tests.contract.api_server import api, browser, program, serving, toy_house
from tests.scans.toy_house import House


@dataclass
class Imports:
    """Stands in for the import itself, which has its own tests: notes what it was handed."""

    house: House
    seen: list[tuple[str, str, dict[str, bytes]]] = field(default_factory=list)
    error: Exception | None = None

    def __call__(self, path: str, name: str, who: str) -> ScanState:
        folder = Path(path).parent
        files = {
            p.relative_to(folder).as_posix(): p.read_bytes()
            for p in folder.rglob("*")
            if p.is_file()
        }
        self.seen.append((name, who, files))
        if self.error:
            raise self.error
        request = CreateScan(method="toy", rig="toy", name=name or "unnamed")
        return self.house.services.create_scan(request, who)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def place(data: Path) -> Iterator[tuple[str, House]]:
    with toy_house(data) as house, serving(api(house, data)) as address:
        yield address, house


@pytest.fixture
def imports(place: tuple[str, House], monkeypatch: pytest.MonkeyPatch) -> Imports:
    imports = Imports(place[1])
    monkeypatch.setattr(place[1].services, "import_capture", imports)
    return imports


@pytest.fixture
def client(place: tuple[str, House]) -> Iterator[httpx.Client]:
    with program(place[0]) as client:
        client.headers["X-Unglare-User"] = "Ada"
        yield client


def zipped(**members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, content in {"capture.json": b"{}", **members}.items():
            file.writestr(name, content)
    return buffer.getvalue()


def as_body(client: httpx.Client, content: bytes) -> httpx.Response:
    return client.post("/api/imports/upload", params={"name": "shaft"}, content=content)


def as_form(client: httpx.Client, content: bytes) -> httpx.Response:
    files = {"file": ("capture.zip", content, "application/zip")}
    return client.post("/api/imports/upload", data={"name": "shaft"}, files=files)


@pytest.mark.parametrize("send", [as_body, as_form])
def test_a_zip_file_is_unpacked_handed_over_and_removed(
    client: httpx.Client,
    imports: Imports,
    data: Path,
    send: Callable[[httpx.Client, bytes], httpx.Response],
) -> None:
    picture = bytes(range(256)) * 1000

    answer = send(client, zipped(picture=picture))

    assert answer.status_code == 201, answer.text
    assert answer.json()["name"] == "shaft"
    assert imports.seen == [("shaft", "Ada", {"capture.json": b"{}", "picture": picture})]
    assert list((data / "uploads").iterdir()) == []


@pytest.mark.parametrize("send", [as_body, as_form])
@pytest.mark.parametrize(
    ("content", "status"),
    [
        pytest.param(b"not a zip", 422, id="no zip"),
        pytest.param(b"", 422, id="empty"),
        pytest.param(bytes(2**20 + 2**15), 413, id="more than the limit"),
        pytest.param(bytes(2**20 + 2**18), 413, id="much more than the limit"),
        pytest.param(zipped(**{"../outside": b"x"}), 422, id="a path that leads out"),
    ],
)
def test_what_cant_be_imported_leaves_nothing_behind(
    client: httpx.Client,
    imports: Imports,
    data: Path,
    send: Callable[[httpx.Client, bytes], httpx.Response],
    content: bytes,
    status: int,
) -> None:
    answer = send(client, content)

    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert imports.seen == []
    assert list((data / "uploads").glob("*")) == []  # made by the first upload that is let in
    assert not (data / "outside").exists()


def test_what_the_import_finds_wrong_is_said(
    client: httpx.Client, imports: Imports, data: Path
) -> None:
    imports.error = InvalidCaptureError("Frame 3 is missing; add it.")

    answer = as_body(client, zipped())

    assert (answer.status_code, answer.json()["detail"]) == (422, "Frame 3 is missing; add it.")
    assert list((data / "uploads").iterdir()) == []


@pytest.mark.parametrize(
    ("body", "content_type"),
    [
        (b"x", "multipart/form-data"),
        (b"no boundary here", "multipart/form-data; boundary=abc"),
        (b"--abc\r\nContent-Disposition: form-data\r\n", "multipart/form-data; boundary=abc"),
        (b"", "multipart/form-data; boundary=" + "b" * 1000),
    ],
)
def test_a_form_that_cant_be_read_is_refused(
    client: httpx.Client, imports: Imports, body: bytes, content_type: str
) -> None:
    answer = client.post(
        "/api/imports/upload", content=body, headers={"Content-Type": content_type}
    )

    assert (answer.status_code, answer.json()["type"]) == (422, "invalid-capture")


def test_a_browsers_form_is_answered_with_a_page_for_its_frame(
    place: tuple[str, House], imports: Imports
) -> None:
    headers = {"Accept": "text/html,application/xhtml+xml"}
    with browser(place[0]) as client:
        good, bad = (
            client.post(
                "/api/imports/upload",
                headers=headers,
                files={"file": ("c.zip", content, "application/zip")},
            )
            for content in (zipped(), b"not a zip")
        )

    assert (good.status_code, bad.status_code) == (201, 422)
    assert "“unnamed” stands in the list of scans" in good.text
    assert "no readable zip file" in bad.text
    for answer in (good, bad):
        assert answer.headers["x-frame-options"] == "SAMEORIGIN"
        assert "frame-ancestors 'self'" in answer.headers["content-security-policy"]


def test_another_page_cant_upload(place: tuple[str, House], imports: Imports) -> None:
    with browser(place[0]) as client:
        client.headers["Origin"] = "https://evil.example"

        answer = as_form(client, zipped())

    assert answer.status_code == 403
    assert imports.seen == []


def test_a_folder_of_the_server_is_imported_by_its_path(
    client: httpx.Client, imports: Imports, tmp_path: Path
) -> None:
    (tmp_path / "capture.json").write_bytes(b"{}")

    answer = client.post("/api/imports", json={"path": str(tmp_path / "capture.json")})

    assert answer.status_code == 201
    assert imports.seen == [("", "Ada", {"capture.json": b"{}"})]


def test_the_page_for_uploads_tells_the_limit(place: tuple[str, House]) -> None:
    with browser(place[0]) as client:
        page = client.get("/import")
    stranger = httpx.get(place[0] + "/import", trust_env=False)

    assert "at most 1 MiB" in page.text
    assert stranger.headers["location"] == "/login?next=/import"
