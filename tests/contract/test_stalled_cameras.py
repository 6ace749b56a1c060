"""A camera whose driver hangs costs its scan, not the application: on the real server, with two rigs."""

import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import httpx
import pytest

from backend.contract.requests import CreateScan
from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.protocols import CameraSettings, Frame
from backend.jobs import device_threads, rig_thread
from backend.jobs.execution import Workshop, compute_inline
from backend.jobs.rigs import RigPool
from backend.jobs.runner import JobThreads
from backend.services.events import EventHub
from backend.services.services import Services
from tests.contract.api_server import api, program, serving
from tests.example_driver.acme_unglare import AcmeCamera, AcmeProjector, Options
from tests.scans.toy import toy_registry
from tests.scans.toy_house import data_folder, toy_offers

PACE_S = 0.3
"""After that a call of the device that is to hang counts as stuck."""
PATIENCE_S = 60.0
"""What all other calls have: a slow machine is no stuck driver."""


class Trouble:
    """Which call of which camera hangs, until it is let go."""

    def __init__(self) -> None:
        self.call = ""
        self.pace_s = PACE_S
        self.deaf = False
        """Also `abort` doesn't help."""
        self.reached = threading.Event()
        self.over = threading.Event()

    def hang(self, call: str, camera: str) -> None:
        if call == self.call and camera == "left":
            self.reached.set()
            assert self.over.wait(2 * PATIENCE_S)

    def patience_s(self, device: str) -> float:
        """How long a device may take; a rig may take what all its devices may take to open."""
        of_one = self.call in ("", "configure", "trigger", "get_frame")
        healthy = not self.call or (of_one and device != "left")
        return PATIENCE_S if healthy else self.pace_s

    def end(self) -> None:
        self.call = ""
        self.over.set()


class SulkyCamera(AcmeCamera):
    """A driver that doesn't keep its promises."""

    def __init__(self, name: str, options: Options, trouble: Trouble) -> None:
        super().__init__(name, options)
        self._trouble = trouble

    @property
    def answers_within_s(self) -> float:
        return self._trouble.patience_s(self.name)

    def open(self) -> None:
        self._trouble.hang("open", self.name)
        super().open()

    def close(self) -> None:
        self._trouble.hang("close", self.name)
        super().close()

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._trouble.hang("configure", self.name)
        return super().configure(settings)

    def trigger(self) -> None:
        self._trouble.hang("trigger", self.name)
        super().trigger()

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        self._trouble.hang("get_frame", self.name)
        return super().get_frame(timeout_s)

    def abort(self) -> None:
        if self._trouble.deaf:
            self._trouble.over.wait(2 * PATIENCE_S)
        super().abort()


class QuickProjector(AcmeProjector):
    def __init__(self, options: Options, trouble: Trouble) -> None:
        super().__init__("projector", "Lamp", options)
        self._trouble = trouble

    @property
    def answers_within_s(self) -> float:
        return self._trouble.patience_s("projector")


class Place:
    """A server with the rigs `sulky` and `good`, and words for what tests do."""

    def __init__(self, client: httpx.Client, trouble: Trouble) -> None:
        self.client = client
        self.trouble = trouble

    def start(self, rig: str) -> str:
        request = CreateScan(method="toy", rig=rig, name=f"part on {rig}")
        answer = self.client.post("/api/scans", json=request.model_dump(mode="json"))
        assert answer.status_code == 201, answer.text
        scan = str(answer.json()["id"])
        answer = self.client.post(f"/api/scans/{scan}/runs", json={"unattended": True})
        assert answer.status_code == 202, answer.text
        return scan

    def state(self, scan: str) -> dict[str, Any]:
        return dict(self.client.get(f"/api/scans/{scan}").json())

    def ended(self, scan: str, *, within_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait for the job's end, as a client does: by asking."""
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            job = self.state(scan)["job"]
            if job["status"] not in ("queued", "running"):
                return dict(job)
            threading.Event().wait(0.1)
        raise AssertionError(f"scan {scan} doesn't end: {job}")

    def stopped_by(self, call: str, *, deaf: bool = False) -> str:
        """Start a scan whose left camera hangs in a call; returns when it hangs."""
        self.trouble.call, self.trouble.deaf = call, deaf
        scan = self.start("sulky")
        assert self.trouble.reached.wait(PATIENCE_S)
        return scan


def rigs_with(trouble: Trouble) -> Any:
    def open_rig(name: str, options: Mapping[str, Any]) -> AssembledRig:
        acme = Options(cell=name, size=(24, 16))
        mine = trouble if name == "sulky" else Trouble()
        cameras = {side: SulkyCamera(side, acme, mine) for side in ("left", "right")}
        lamp = QuickProjector(Options(cell=name, size=(32, 8)), mine)
        return AssembledRig(name, cameras, lamp, sensors=dict.fromkeys(cameras, SensorFacts()))

    return open_rig


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    for module, name in (
        (device_threads, "AFTER_STOP_S"),
        (device_threads, "_MOMENT_S"),
        (rig_thread, "GRACE_S"),
    ):
        monkeypatch.setattr(module, name, PACE_S)
    trouble, hub = Trouble(), EventHub()
    database, store = data_folder(tmp_path)
    pool = RigPool(rigs_with(trouble), hub.publish)
    shop = Workshop(database, store, pool, toy_registry, hub.publish, {"unglare": "test"})
    services = Services(
        database=database, store=store, runner=JobThreads(shop, compute_inline(shop)), rigs=pool,
        registry=toy_registry(), events=hub, version="test", rig_patience_s=PACE_S,
        offers=toy_offers,
    )  # fmt: skip
    house = type("Served", (), {"services": services})()
    try:
        with serving(api(house, tmp_path)) as address, program(address) as client:
            client.timeout = httpx.Timeout(PATIENCE_S)
            try:
                yield Place(client, trouble)
            finally:
                trouble.end()
    finally:
        services.close()


CALLS = ("open", "configure", "trigger", "get_frame")


@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_never_returns_ends_its_scan_by_name_and_the_next_works(
    place: Place, call: str
) -> None:
    scan = place.stopped_by(call)
    job = place.ended(scan)
    assert job["status"] == "failed"
    assert job["error"].startswith("left: its driver hasn't come back from "), job["error"]
    assert "\n" not in job["error"]
    place.trouble.end()
    assert place.ended(place.start("sulky"))["status"] == "finished"


@pytest.mark.parametrize("call", ["open", "get_frame"])
def test_everything_else_goes_on_meanwhile(place: Place, call: str) -> None:
    place.trouble.call, place.trouble.deaf = call, True
    # As patient as usual: the call hangs as long as this test looks at what else is going on.
    place.trouble.pace_s = PATIENCE_S
    scan = place.start("sulky")
    assert place.trouble.reached.wait(PATIENCE_S)
    assert place.ended(place.start("good"))["status"] == "finished"
    for path in ("/api/health", "/api/scans", "/api/rigs", f"/api/scans/{scan}"):
        took_s = []
        for _ in range(5):
            began_s = time.monotonic()
            assert place.client.get(path).status_code == 200
            took_s.append(time.monotonic() - began_s)
        assert min(took_s) < 1.0, path  # 5 ms where nothing else runs
    assert place.state(scan)["job"]["status"] == "running"
    place.trouble.end()
    assert place.ended(scan)["status"] == "finished"


@pytest.mark.parametrize(
    ("call", "deaf"),
    [("open", False), ("configure", True), ("get_frame", False), ("get_frame", True)],
)
def test_cancelling_works_while_a_call_hangs(place: Place, call: str, deaf: bool) -> None:
    place.trouble.pace_s = 20.0
    scan = place.stopped_by(call, deaf=deaf)
    assert place.client.delete(f"/api/scans/{scan}/runs").status_code == 200
    assert place.ended(scan, within_s=15.0)["status"] == "cancelled"
    place.trouble.end()
    assert place.ended(place.start("sulky"))["status"] == "finished"


def test_a_camera_that_is_still_stuck_says_so_every_time_and_works_again_later(
    place: Place,
) -> None:
    first = place.ended(place.stopped_by("trigger", deaf=True))
    again = [place.ended(place.start("sulky")) for _ in range(3)]
    assert {job["status"] for job in (first, *again)} == {"failed"}
    assert all(job["error"].startswith("left: its driver ") for job in again)
    assert "still stuck in an earlier call" in again[-1]["error"]
    place.trouble.end()
    assert place.ended(place.start("sulky"))["status"] == "finished"


def test_a_camera_that_doesnt_close_is_left_behind(place: Place) -> None:
    assert place.ended(place.start("sulky"))["status"] == "finished"
    place.trouble.call = "close"
    assert place.client.post("/api/rigs/sulky/disconnect").status_code == 202
    assert place.trouble.reached.wait(PATIENCE_S)
    place.trouble.call = "nothing more"  # what is stuck is waited for no longer than before
    while place.client.get("/api/rigs/sulky/state").json()["link"] != "closed":
        threading.Event().wait(0.1)
    # The old device is stuck still, the new one opens beside it.
    job = place.ended(place.start("sulky"))
    assert job["status"] == "finished", job


@pytest.mark.parametrize("work", ["check", "latency"])
def test_work_at_a_rig_without_a_scan_ends_by_name_too(place: Place, work: str) -> None:
    def told() -> dict[str, Any]:
        return dict(place.client.get("/api/rigs/sulky/state").json())

    place.client.post("/api/rigs/sulky/connect", json={})
    while told()["link"] != "open":
        threading.Event().wait(0.1)
    place.trouble.call = "trigger"
    body = {"repetitions": 3} if work == "latency" else None
    answer = place.client.post(f"/api/rigs/sulky/{work}", json=body)
    assert answer.status_code == 202, answer.text
    while (done := told()["work"])["status"] == "running":
        threading.Event().wait(0.1)
    said = " ".join([done["error"] or "", *done["problems"]])
    assert "left: its driver hasn't come back from" in said, done
    place.trouble.end()
    assert place.ended(place.start("sulky"))["status"] == "finished"


@pytest.mark.parametrize("work", ["check", "latency"])
def test_work_is_cancelled_while_its_rig_opens(place: Place, work: str) -> None:
    place.trouble.pace_s = 20.0
    place.trouble.call = "open"
    body = {"repetitions": 3} if work == "latency" else None
    place.client.post(f"/api/rigs/sulky/{work}", json=body)
    assert place.trouble.reached.wait(PATIENCE_S)
    assert place.client.delete("/api/rigs/sulky/work").status_code == 200
    while (told := place.client.get("/api/rigs/sulky/state").json())["owner"] is not None:
        threading.Event().wait(0.05)
    assert told["work"]["status"] in ("running", "cancelled")  # its last word comes a moment later
    assert not place.trouble.over.is_set(), "the camera hangs still"
    place.trouble.end()
    assert place.ended(place.start("sulky"))["status"] == "finished"


def test_many_who_wait_for_a_rig_that_hangs_leave_room_for_others(
    place: Place,
) -> None:
    place.trouble.pace_s = 20.0
    place.trouble.call = "open"

    def ask(_: int) -> int:
        return place.client.post("/api/rigs/sulky/view", json={}).status_code

    with ThreadPoolExecutor(24) as crowd:
        asked = [crowd.submit(ask, number) for number in range(24)]
        assert place.trouble.reached.wait(PATIENCE_S)
        wait(asked[:20], timeout=0.5)
        assert place.client.get("/api/health").status_code == 200
        place.trouble.end()
    answers = [one.result() for one in asked]
    assert set(answers) == {200, 409}
    assert answers.count(200) >= 4


def test_ending_the_application_doesnt_wait_for_a_camera(place: Place) -> None:
    scan = place.stopped_by("trigger", deaf=True)
    place.ended(scan)
    began_s = time.monotonic()
    place.client.post("/api/rigs/sulky/disconnect")
    assert time.monotonic() - began_s < 5.0
