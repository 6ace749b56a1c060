"""Zip files from strangers."""

import asyncio
import errno
import io
import os
import stat
import zipfile
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.api.errors import TooLargeError
from backend.api.uploads import save, unpack, upload_folder
from backend.domain.errors import InvalidCaptureError, StorageFullError

LIMIT = 100_000


def zip_file(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, content in members.items():
            zipped.writestr(name, content)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    target = tmp_path / "target"
    target.mkdir()
    return target


@pytest.mark.parametrize("inside", ["", "shot/", "shot/of/a/part/"])
def test_a_capture_comes_out_as_it_went_in(tmp_path: Path, folder: Path, inside: str) -> None:
    members = {inside + "capture.json": b"{}", inside + "left/0.png": b"pixels"}

    capture = unpack(zip_file(tmp_path / "c.zip", members), folder, LIMIT)

    assert capture == folder / inside / "capture.json"
    assert (capture.parent / "left" / "0.png").read_bytes() == b"pixels"


def link(path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as zipped:
        member = zipfile.ZipInfo("capture.json")
        member.external_attr = (stat.S_IFLNK | 0o777) << 16
        zipped.writestr(member, "/etc/passwd")
    return path


def encrypted(path: Path) -> Path:
    zip_file(path, {"capture.json": b"{}"})
    content = bytearray(path.read_bytes())
    content[6] |= 1  # local header
    content[content.index(b"PK\x01\x02") + 8] |= 1  # central directory
    path.write_bytes(content)
    return path


def damaged(path: Path) -> Path:
    zip_file(path, {"capture.json": os.urandom(1000)})
    content = bytearray(path.read_bytes())
    content[300:310] = bytes(10)
    path.write_bytes(content)
    return path


def no_zip(path: Path) -> Path:
    path.write_bytes(b"Rar!")
    return path


def twice(path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("capture.json", "{}")
        with pytest.warns(UserWarning, match="Duplicate name"):
            zipped.writestr("capture.json", "{}")
    return path


def of(*names: str) -> Callable[[Path], Path]:
    return lambda path: zip_file(path, dict.fromkeys(names, b"{}"))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        pytest.param(of("../capture.json"), "outside of its folder", id="up"),
        pytest.param(of("a/../../capture.json"), "outside of its folder", id="down and up"),
        pytest.param(of("/tmp/capture.json"), "outside of its folder", id="absolute"),
        pytest.param(of("..\\capture.json"), "outside of its folder", id="backslash"),
        pytest.param(of("C:/capture.json"), "outside of its folder", id="drive"),
        pytest.param(of("bell\x07.png"), "outside of its folder", id="control character"),
        pytest.param(link, "the link 'capture.json'", id="link"),
        pytest.param(encrypted, "no readable zip file", id="encrypted"),
        pytest.param(damaged, "no readable zip file", id="damaged"),
        pytest.param(no_zip, "no readable zip file", id="no zip"),
        pytest.param(twice, "twice", id="the same name twice"),
        pytest.param(of("a", "a/b"), "no file can have", id="a file that is a folder"),
        pytest.param(of("x" * 300), "no file can have", id="long name"),
        pytest.param(of("notes.txt"), "0 files named capture.json", id="no capture.json"),
        pytest.param(of("a/capture.json", "b/capture.json"), "2 files named", id="two captures"),
    ],
)
def test_what_isnt_a_capture_is_refused_with_a_sentence(
    tmp_path: Path, folder: Path, make: Callable[[Path], Path], sentence: str
) -> None:
    archive = make(tmp_path / "bad.zip")
    before = set(tmp_path.iterdir())

    with pytest.raises(InvalidCaptureError, match=sentence):
        unpack(archive, folder, LIMIT)

    assert set(tmp_path.iterdir()) == before


def test_a_bomb_is_stopped_at_the_limit(tmp_path: Path, folder: Path) -> None:
    members = {"capture.json": b"{}", "a.raw": bytes(60_000), "b.raw": bytes(60_000)}

    with pytest.raises(TooLargeError, match="larger than 0 MiB"):
        unpack(zip_file(tmp_path / "bomb.zip", members), folder, LIMIT)

    written = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    assert written <= LIMIT


@given(st.text(st.sampled_from("ab./\\:~"), min_size=1, max_size=12))
def test_no_name_leads_out_of_the_folder(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    outer = tmp_path_factory.mktemp("outer")
    (outer / "target").mkdir()
    archive = zip_file(outer / "z.zip", {name: b"x"})

    with pytest.raises(InvalidCaptureError):
        unpack(archive, outer / "target", LIMIT)

    assert {p.name for p in outer.iterdir()} == {"target", "z.zip"}


async def pieces(*sizes: int) -> AsyncIterator[bytes]:
    for size in sizes:
        yield b"x" * size


def test_a_body_is_written_as_it_comes(tmp_path: Path) -> None:
    size = asyncio.run(save(pieces(0, 3, 2**20, 5), tmp_path / "body", 2**21))

    assert size == 2**20 + 8 == (tmp_path / "body").stat().st_size


def test_a_body_is_cut_as_soon_as_it_is_too_large(tmp_path: Path) -> None:
    asked: list[int] = []

    async def endless() -> AsyncIterator[bytes]:
        while True:
            asked.append(1)
            yield b"x" * 10_000

    with pytest.raises(TooLargeError):
        asyncio.run(save(endless(), tmp_path / "body", LIMIT))

    assert len(asked) == LIMIT // 10_000 + 1


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class FullFile(io.BytesIO):
        def write(self, data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", lambda *_: FullFile())

    with pytest.raises(StorageFullError, match="is full"):
        asyncio.run(save(pieces(2**21), tmp_path / "body", 2**22))


def test_the_folder_of_an_upload_is_gone_afterwards(tmp_path: Path) -> None:
    def fail() -> None:
        with upload_folder(tmp_path / "uploads") as folder:
            (folder / "half").write_bytes(b"x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()

    assert list((tmp_path / "uploads").iterdir()) == []
