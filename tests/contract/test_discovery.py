"""Cameras are asked by unicast, and searched for only on request; no test here broadcasts."""

import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from backend.cli.application import run
from backend.devices import discovery
from backend.devices.discovery import ask_addresses, ask_known, controller_of, known_addresses
from backend.devices.drivers import (
    aravis_camera,
    gentl_camera,
    gige_link,
    pylon_camera,
    video_camera,
)
from backend.devices.drivers.aravis_library import AravisMissingError, Listed
from backend.devices.found import FoundCamera
from backend.devices.pages import PageDesk
from backend.devices.peers.gige_camera import GigECamera
from backend.devices.peers.gvcp import (
    DISCOVERY_BYTES,
    MAGIC,
    PORT,
    Bootstrap,
    Command,
    Status,
    ask,
    request,
)
from backend.devices.rig_shelf import RigShelf
from backend.devices.sim import create_rig
from backend.domain.errors import InvalidSettingError

Discover = Callable[..., tuple[int, str, str]]
"""Runs the command; returns its status, output and error output."""
SMALL = {"scene": "plane", "size": "160x120", "projector_size": "160x100", "realtime": True}


@pytest.fixture
def cameras(addresses: tuple[str, str]) -> Iterator[tuple[str, str]]:
    with create_rig(SMALL) as rig, ExitStack() as stack:
        for camera, address in zip(rig.cameras.values(), addresses, strict=True):
            stack.enter_context(GigECamera(camera, address))
        yield addresses


@contextmanager
def impostor(address: str, data: bytes, *, answers_from: str = "") -> Iterator[None]:
    """Answer whatever comes to an address with the same datagram, perhaps from another one."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        listening.bind((address, PORT))
        listening.settimeout(5.0)
        if answers_from:
            other.bind((answers_from, 0))
        answering = other if answers_from else listening

        def answer() -> None:
            try:
                while True:
                    asked, client = listening.recvfrom(2048)
                    if not asked:
                        return
                    answering.sendto(data, client)
            except OSError:
                return

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            yield
        finally:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ending:
                ending.sendto(b"", (address, PORT))
            thread.join()


# ---------------------------------------------------------------- by address


def test_known_addresses_tell_who_is_there(cameras):
    left, right = ask_addresses([*cameras, "127.78.200.200"])
    assert (left.address, left.serial, left.vendor) == (cameras[0], "SIM-L", "unglare")
    assert (right.address, right.serial) == (cameras[1], "SIM-R")
    assert left.rig_line == f"{{driver: aravis, address: {cameras[0]}}}"


def test_who_controls_a_camera_is_told(cameras):
    assert controller_of(cameras[0]) == ""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        control = struct.pack(">II", Bootstrap.CONTROL, 2)
        client.sendto(request(Command.WRITE_REGISTER, control), (cameras[0], PORT))
        client.recv(64)
        assert controller_of(cameras[0]) == "a program at 127.0.0.1"
        (left,) = ask_addresses([cameras[0]])
        assert left.controlled_by == "a program at 127.0.0.1"
    assert controller_of(cameras[1]) == ""


@pytest.mark.parametrize(
    ("status", "expected"),
    [(Status.ACCESS_DENIED, "another program, exclusively"), (Status.NOT_IMPLEMENTED, None)],
)
def test_a_camera_that_does_not_say_who_controls_it(addresses, status, expected):
    refusal = struct.pack(">HHHH", status, Command.READ_REGISTER + 1, 0, 0xFFFF)
    with impostor(addresses[0], refusal):
        assert controller_of(addresses[0]) == expected


@pytest.mark.parametrize(
    "junk",
    [b"", b"\0", b"\0\0\0\3", struct.pack(">BBHHH", MAGIC, 0, 3, 0, 1), bytes(400)],
    ids=["nothing", "a byte", "half a header", "a short answer", "zeros"],
)
def test_what_is_no_answer_is_no_camera(addresses, junk):
    with impostor(addresses[0], junk):
        assert ask([addresses[0]], timeout_s=0.1) == ()
        assert controller_of(addresses[0], timeout_s=0.1) is None


def test_an_answer_of_somebody_who_was_not_asked_does_not_count(addresses):
    registers = bytearray(DISCOVERY_BYTES)
    registers[Bootstrap.SERIAL : Bootstrap.SERIAL + 2] = b"S1"
    answer = struct.pack(">HHHH", 0, Command.DISCOVERY + 1, len(registers), 0xFFFF) + registers
    asked, other = addresses
    with impostor(asked, answer):
        assert [found.serial for found in ask([asked], timeout_s=2.0)] == ["S1"]
    with impostor(asked, answer, answers_from=other):
        assert ask([asked], timeout_s=0.2) == ()


@pytest.mark.parametrize("address", ["255.255.255.255", "224.0.0.1", "0.0.0.0", "camera", "1.2.3", ""])  # fmt: skip
def test_what_is_no_single_address_is_refused_before_anybody_is_asked(monkeypatch, address):
    monkeypatch.setattr(discovery, "ask", lambda *_, **__: pytest.fail("somebody was asked"))
    with pytest.raises(InvalidSettingError, match=f"'{address}' is no single device's IPv4"):
        ask_addresses(["127.78.0.2", address])


def test_the_system_keeps_a_networks_broadcast_address_from_being_asked():
    assert ask(["127.255.255.255"], timeout_s=0.05) == ()


# ---------------------------------------------------------------- by rig files


def shelf_with(folder: Path, **files: str) -> RigShelf:
    folder.mkdir()
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text)
    return RigShelf(folder, PageDesk())


def rig_text(*entries: str) -> str:
    lines = [f"  camera-{number}: {entry}" for number, entry in enumerate(entries)]
    return "\n".join(["cameras:", *lines, "projector: {driver: page, size: 1280x800}"])


def test_rig_files_name_the_addresses(tmp_path, cameras):
    left, right = cameras
    shelf = shelf_with(
        tmp_path / "rigs",
        bench=rig_text(f"{{driver: aravis, address: {left}}}", "{driver: pylon, serial: 123}"),
        table=rig_text(f"{{driver: pylon, address: {left}}}", "{driver: other, address: COM3}"),
        broken="cameras: [",
    )
    assert known_addresses(shelf) == {left: ("bench: camera-0", "table: camera-0")}
    (found,) = ask_known(shelf)
    assert (found.serial, found.used_in) == ("SIM-L", ("bench: camera-0", "table: camera-0"))
    (other,) = ask_known(shelf, [right])
    assert (other.serial, other.used_in) == ("SIM-R", ())


# ---------------------------------------------------------------- by searching


@pytest.fixture
def nothing_to_find(monkeypatch, tmp_path):
    """Replace every driver's enumeration at its edge: what a test doesn't provide isn't there."""
    monkeypatch.setattr(aravis_camera, "listed_devices", lambda: ())
    monkeypatch.setattr(pylon_camera, "_enumerated", lambda: ())
    monkeypatch.setattr(video_camera, "_SYSTEM", tmp_path / "no-video")
    monkeypatch.setenv(gentl_camera.PRODUCERS_PATH, "")


def of_pylon(device_class: str, serial: str, address: str = "") -> SimpleNamespace:
    return SimpleNamespace(
        GetDeviceClass=lambda: device_class,
        GetSerialNumber=lambda: serial,
        GetIpAddress=lambda: address,
        GetVendorName=lambda: "Basler",
        GetModelName=lambda: "a2A",
    )


@pytest.mark.usefixtures("nothing_to_find")
def test_every_driver_is_asked_and_says_how_its_cameras_are_opened(monkeypatch, tmp_path, cameras):
    monkeypatch.setattr(
        aravis_camera,
        "listed_devices",
        lambda: (
            Listed("GigEVision", cameras[0], "SimRig", "SimCam", "S1"),
            Listed("USB3Vision", "USB3Vision-1", "Maker", "U3", "0042"),
        ),
    )
    infos = (
        of_pylon("BaslerGigE", "24000001", "127.78.200.9"),
        of_pylon("BaslerUsb", "24000002"),
        of_pylon("BaslerCamEmu", "0815-0000"),
    )
    monkeypatch.setattr(pylon_camera, "_enumerated", lambda: infos)
    node = tmp_path / "video" / "video2"
    node.mkdir(parents=True)
    (node / "index").write_text("0")
    (node / "name").write_text("Webcam")
    monkeypatch.setattr(video_camera, "_SYSTEM", node.parent)
    result = discovery.search(["aravis", "pylon", "video"])
    assert [camera.rig_line for camera in result.cameras] == [
        f"{{driver: aravis, address: {cameras[0]}}}",
        "{driver: aravis, serial: '0042'}",
        "{driver: pylon, address: 127.78.200.9}",
        "{driver: pylon, serial: '24000002'}",
        "{driver: video, source: 2}",
    ]
    controlled = [camera.controlled_by for camera in result.cameras]
    assert controlled == ["", None, None, None, None]
    assert result.problems == ()


@pytest.mark.usefixtures("nothing_to_find")
def test_the_producers_that_are_registered_are_asked(monkeypatch):
    genicam = pytest.importorskip("genicam")
    pytest.importorskip("harvesters")
    folder = Path(genicam.__file__).parent
    monkeypatch.setenv(gentl_camera.PRODUCERS_PATH, f"{folder}:{folder / 'nowhere'}")
    result = discovery.search(["gentl"])
    assert [(c.serial, c.options["serial"]) for c in result.cameras] == [("0", "0"), ("1", "1"), ("2", "2")]  # fmt: skip
    assert str(folder / "viky.cti") in result.cameras[0].rig_line


@pytest.mark.usefixtures("nothing_to_find")
def test_a_producer_that_cant_be_loaded_does_not_stop_the_others(monkeypatch, tmp_path):
    genicam = pytest.importorskip("genicam")
    pytest.importorskip("harvesters")
    (tmp_path / "half_removed.cti").write_text("nothing that could be loaded")
    monkeypatch.setenv(gentl_camera.PRODUCERS_PATH, f"{tmp_path}:{Path(genicam.__file__).parent}")
    result = discovery.search(["gentl"])
    assert (len(result.cameras), result.problems) == (3, ())
    monkeypatch.setenv(gentl_camera.PRODUCERS_PATH, str(tmp_path))
    (problem,) = discovery.search(["gentl"]).problems
    assert "half_removed.cti can't be loaded" in problem


@pytest.mark.usefixtures("nothing_to_find")
def test_drivers_that_fail_do_not_stop_the_others(monkeypatch):
    def missing() -> tuple[Listed, ...]:
        raise AravisMissingError("libaravis isn't installed; run: apt-get install it")

    def broken() -> tuple[object, ...]:
        raise OSError("no bus")

    monkeypatch.setattr(aravis_camera, "listed_devices", missing)
    monkeypatch.setattr(pylon_camera, "_enumerated", broken)
    result = discovery.search(["aravis", "pylon", "video", "unheard-of"])
    assert result.cameras == ()
    first, second, third = result.problems
    assert first == "aravis: libaravis isn't installed; run: apt-get install it"
    assert second.startswith("pylon: searching failed with OSError: no bus")
    assert "unheard-of" in third


# ---------------------------------------------------------------- on the command line


@pytest.fixture
def discover(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Discover:
    def command(*arguments: str) -> tuple[int, str, str]:
        status = run(["rigs", "discover", *arguments, "--data", str(tmp_path)])
        return status, *capsys.readouterr()

    return command


def test_the_command_asks_the_addresses_of_the_rig_files(discover, tmp_path, cameras):
    nobody = "127.78.200.200"
    entries = (f"{{driver: aravis, address: {a}}}" for a in (cameras[0], nobody))
    shelf_with(tmp_path / "rigs", bench=rig_text(*entries))
    status, out, err = discover()
    assert status == 0
    for word in (cameras[0], "SIM-L", "nobody", "bench: camera-0", "{driver: aravis, address:"):
        assert word in out
    assert f"no camera answers at {nobody}; check cable, power and the address" in err


def test_the_commands_document_has_everything(discover, cameras):
    status, out, _ = discover(*cameras, "--json")
    document = json.loads(out)
    assert status == 0
    assert [camera["serial"] for camera in document["cameras"]] == ["SIM-L", "SIM-R"]
    assert document["cameras"][0]["options"] == {"address": cameras[0]}
    assert (document["silent"], document["problems"]) == ([], [])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "no rig file names an address to ask; give addresses, or --search"),
        (("127.78.0.2", "--search"), "give addresses or --search, not both"),
        (("left",), "'left' is no single device's IPv4 address"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(discover, arguments, sentence):
    status, _, err = discover(*arguments)
    assert status == 1
    assert sentence in err
    assert len(err.strip().splitlines()) == 1


def test_searching_is_only_done_when_asked_for(discover, monkeypatch, cameras):
    searched = []
    found = FoundCamera("pylon", {"serial": "1"}, vendor="Basler", model="a2A", serial="1")
    result = discovery.SearchResult((found,), ("gentl: it isn't installed",))

    def search() -> discovery.SearchResult:
        searched.append(1)
        return result

    monkeypatch.setattr(discovery, "search", search)
    discover(cameras[0])
    assert not searched
    status, out, err = discover("--search")
    assert searched == [1]
    assert status == 0
    for word in ("Basler a2A (1)", "not known", "{driver: pylon, serial: '1'}"):
        assert word in out
    assert "gentl: it isn't installed" in err


def test_an_address_of_another_network_is_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    routes = tmp_path / "route"
    heads = "Iface Destination Gateway Flags RefCnt Use Metric Mask"
    routes.write_text(f"{heads}\neth0 000200C0 00000000 0001 0 0 0 00FFFFFF\n")
    monkeypatch.setattr(gige_link, "ROUTES", routes)
    assert "give the card that the camera is plugged into" in discovery.why_silent("10.1.2.3")
    assert discovery.why_silent("192.0.2.9").endswith("check cable, power and the address")
