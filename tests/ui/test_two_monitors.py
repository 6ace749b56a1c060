"""The whole application on two monitors: server, kiosk and GigE Vision cameras that see what the second one shows."""

import signal
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, Playwright

from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.peers.monitor_display import Screen
from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.rig import SimulatedRig
from tests.loopback import loopback_address
from tests.ui.test_projector_page import patterns
from tests.ui.two_monitors import (
    PATIENCE_S,
    SIZE,
    Desktop,
    Program,
    Scan,
    Station,
    two_monitors,
    wait_for,
)

try:
    aravis()
except AravisMissingError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.ui

WORLD: dict[str, Any] = {"scene": "plane", "size": "320x240", "seed": 5}
MOST_COLUMN_ERROR_PX = 0.02
NOBODY = ""
BRIEF: dict[str, dict[str, Any]] = {"exposures": {"exposures_ms": [50.0]}}
"""One exposure: 12 shots."""


@pytest.fixture(scope="module")
def desktop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desktop]:
    with two_monitors(tmp_path_factory.mktemp("desktop")) as running:
        yield running


Addresses = tuple[str, str]


def simulate(desktop: Desktop, name: str, addresses: Addresses, *more: str) -> Program:
    """Start `unglare simulate-hardware`; its rig file is NAME.yaml."""
    options = [f"--{key}={value}" for key, value in WORLD.items()]
    options += [f"--address={address}" for address in addresses]
    file = desktop.folder / f"{name}.yaml"
    return desktop.unglare(
        f"simulate-{name}", "simulate-hardware", f"--write-rig={file}", *options, *more
    )


@contextmanager
def simulated(desktop: Desktop, station: Station, name: str, *more: str) -> Iterator[Program]:
    program = simulate(desktop, name, (loopback_address(), loopback_address()), *more)
    try:
        program.wait_until_it_says("Stop with Ctrl")
        station.add_rig(desktop.folder / f"{name}.yaml", name)
        yield program
        station.give_page_to(NOBODY)  # closing a rig whose cameras are gone takes their timeouts
    finally:
        status = program.stop(signal.SIGINT)
    assert status == 0, program.said


@pytest.fixture(scope="module")
def station(desktop: Desktop) -> Iterator[Station]:
    with closing(Station(desktop, desktop.folder / "data")) as running:
        yield running


@pytest.fixture(scope="module")
def hardware(desktop: Desktop, station: Station) -> Iterator[Program]:
    with simulated(desktop, station, "room") as running:
        yield running


@dataclass
class Window:
    """The kiosk, and its page by DevTools."""

    program: Program
    page: Page

    def command(self, name: str, **parameters: Any) -> Any:
        """Ask something of DevTools."""
        return self.page.context.new_cdp_session(self.page).send(name, parameters)


@contextmanager
def opened_window(desktop: Desktop, station: Station, playwright: Playwright) -> Iterator[Window]:
    with ExitStack() as closing_all:
        program, tools = station.open_page(desktop.folder / "kiosk")
        # A kiosk that is left over would open the next one's page, in a window of its own.
        closing_all.callback(program.stop)
        browser = playwright.chromium.connect_over_cdp(tools)
        closing_all.callback(browser.close)
        page = next(p for p in browser.contexts[0].pages if "/projector" in p.url)
        page.set_default_timeout(1000 * PATIENCE_S)
        # A scan that waits for the page shows its pattern at once, and so hides this text.
        page.get_by_text("waits for patterns").wait_for(state="attached")
        page.wait_for_function(
            "([left, width, height]) => screenX === left && innerWidth === width && innerHeight === height",
            arg=[SIZE[0], *SIZE],
        )
        yield Window(program, page)


@pytest.fixture
def window(desktop: Desktop, station: Station, playwright: Playwright) -> Iterator[Window]:
    """Return a kiosk of the test's own: many of them end badly."""
    with opened_window(desktop, station, playwright) as opened:
        yield opened


def column_error_px(scan: Scan, camera: str = "left") -> float:
    """Compare the measured projector column with where the rig's exact geometry puts it, rms over good pixels."""
    rig = SimulatedRig(
        SimulatedRigConfig.model_validate({**WORLD, "projector_size": f"{SIZE[0]}x{SIZE[1]}"})
    )
    calibration, truth = rig.calibration(), rig.truth(camera)
    assert calibration is not None
    assert calibration.projector is not None
    assert calibration.projector_from_world is not None
    pose, camera_pose = calibration.projector_from_world, calibration.camera_from_world[camera]
    points = (truth.points_mm.reshape(-1, 3) - camera_pose.t_mm) @ camera_pose.R
    rotation, _ = cv2.Rodrigues(pose.R)
    model = calibration.projector
    pixels, _ = cv2.projectPoints(points, rotation, pose.t_mm, model.K, model.distortion)
    exact = pixels[:, 0, 0].reshape(truth.points_mm.shape[:2])
    measured = scan.array("fringe_phase", "projector_px", camera)
    good = truth.lit_and_seen & ~truth.edge_band & np.isfinite(measured)
    assert good.mean() > 0.5
    return float(np.sqrt(np.mean((measured - exact)[good] ** 2)))


def has_good_columns(scan: Scan) -> bool:
    assert scan.end()["error"] is None
    return all(
        column_error_px(scan, camera) <= MOST_COLUMN_ERROR_PX for camera in ("left", "right")
    )


def test_an_unattended_scan_with_real_protocols_is_as_good_as_its_noise(
    hardware: Program, window: Window, station: Station
) -> None:
    scan = station.scan("room", exposures={"steps": 8}).start()
    assert has_good_columns(scan)
    points = next(c for c in scan.stage("stereo_cloud")["checks"] if c["name"] == "points")
    assert points["value"] > 30_000


def test_injected_lag_is_refused_without_settling_and_found_and_then_the_scan_is_as_good(
    desktop: Desktop, window: Window, station: Station
) -> None:
    with simulated(desktop, station, "late", "--lag-ms=60"):
        file = desktop.folder / "late.yaml"
        file.write_text(file.read_text().replace("  gamma:", "  settle_ms: 0.0\n  gamma:"))
        station.add_rig(file, "hurried")
        error = station.scan("hurried", **BRIEF).start().end()["error"]
        assert error is not None
        assert "settle" in error or "pattern" in error
        station.give_page_to("late")
        station.post("/api/rigs/late/latency", repetitions=10)
        wait_for(lambda: station.get("/api/rigs/late/latency"), "the latency calibration")
        found = station.get("/api/rigs/late/latency")
        assert found["kept"], found["note"]
        # The lag, up to half a frame of the steps that are tried, and the frame that is added for safety.
        assert 60.0 <= found["settle_ms"] <= 90.0
        assert has_good_columns(station.scan("late", exposures={"steps": 8}).start())


def shows(screen: Screen, pattern: "np.ndarray[Any, Any]") -> bool:
    return np.array_equal(screen.gray(), pattern)


def test_every_pixel_of_the_second_monitor_is_as_asked(
    desktop: Desktop, hardware: Program, window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page's own drawing, read back from the X server; other device pixel ratios: test_projector_page."""
    monkeypatch.setenv("DISPLAY", desktop.display)
    with closing(Screen(desktop.region)) as screen:
        for pattern in patterns(*SIZE):
            window.page.evaluate(
                """([w, h, gray]) => { receive({data: JSON.stringify({t: "load", slot: 0, w, h})});
                   receive({data: new Uint8Array(gray).buffer}); show({id: 1, slot: 0}); }""",
                [*SIZE, pattern.ravel().tolist()],
            )
            wait_for(partial(shows, screen, pattern), "the pattern", 20.0)


@pytest.mark.parametrize("shot", [4])
def test_a_camera_that_is_killed_in_mid_scan_and_comes_back(
    desktop: Desktop, station: Station, window: Window, addresses: Addresses, shot: int
) -> None:
    with ExitStack() as stopping:
        program = simulate(desktop, "frail", addresses)
        stopping.callback(program.stop)
        program.wait_until_it_says("Stop with Ctrl")
        station.add_rig(desktop.folder / "frail.yaml", "frail")
        scan = station.scan("frail", **BRIEF).start("fringe_capture")
        scan.wait_for_shot(shot)
        program.stop(signal.SIGKILL)
        again = simulate(desktop, "frail", addresses)
        stopping.callback(again.stop)
        again.wait_until_it_says("Stop with Ctrl")
        ends_or_goes_on(scan)


def test_a_pixel_format_that_the_cameras_lack_is_one_sentence(
    desktop: Desktop, hardware: Program, station: Station, window: Window
) -> None:
    text = (desktop.folder / "room.yaml").read_text()
    file = desktop.folder / "odd.yaml"
    file.write_text(text.replace("driver: aravis", "driver: aravis\n    pixel_format: Mono9"))
    station.add_rig(file, "odd")
    station.give_page_to("odd")
    refused = station.client.post("/api/scans", json={"method": "hdr-fringe", "rig": "odd"})
    assert refused.status_code == 422
    assert "left: PixelFormat Mono9 is not one of Mono8" in refused.json()["detail"]
    assert station.scan("room", **BRIEF).start("fringe_capture").end()["error"] is None


def ends_or_goes_on(scan: Scan) -> None:
    """Check that a disturbed scan went on, or ended with one sentence and goes on when told to; nothing is lost."""
    error = scan.end()["error"]
    if error is not None:
        assert "\n" not in error
        assert "kept" in error
        assert scan.start("fringe_capture").end()["error"] is None
    assert len(scan.frames()) == 24


def reload(window: Window, desktop: Desktop) -> None:
    window.page.reload()


def freeze(window: Window, desktop: Desktop) -> None:
    window.page.evaluate(
        "() => { setTimeout(() => { const end = Date.now() + 3000; while (Date.now() < end); }, 0) }"
    )


def zoom_and_back(window: Window, desktop: Desktop) -> None:
    window.command("Emulation.setPageScaleFactor", pageScaleFactor=1.5)
    window.page.wait_for_timeout(500)
    window.command("Emulation.setPageScaleFactor", pageScaleFactor=1.0)


def shrink_and_back(window: Window, desktop: Desktop) -> None:
    number = window.command("Browser.getWindowForTarget")["windowId"]
    window.command("Browser.setWindowBounds", windowId=number, bounds={"windowState": "normal"})
    window.page.wait_for_timeout(500)
    window.command("Browser.setWindowBounds", windowId=number, bounds={"windowState": "fullscreen"})


def open_a_second_page(window: Window, desktop: Desktop) -> None:
    with window.page.context.expect_page() as opened:
        window.command("Target.createTarget", url=window.page.url, background=True)
    second = opened.value
    # A window in the background draws nothing, so what waits for animation frames would wait for ever.
    refused = "() => document.body.innerText.includes('Another page is this projector already')"
    wait_for(lambda: second.evaluate(refused), "the refusal of the second page")
    second.close()


def pull_the_cable_and_plug_in(window: Window, desktop: Desktop) -> None:
    desktop.unplug()
    window.page.wait_for_timeout(500)
    desktop.plug_in()
    number = window.command("Browser.getWindowForTarget")["windowId"]
    window.command("Browser.setWindowBounds", windowId=number, bounds={"windowState": "normal"})
    bounds = {"left": SIZE[0], "top": 0, "width": SIZE[0], "height": SIZE[1]}
    window.command("Browser.setWindowBounds", windowId=number, bounds=bounds)
    window.command("Browser.setWindowBounds", windowId=number, bounds={"windowState": "fullscreen"})


@pytest.mark.parametrize(
    "disturb",
    [
        *(reload, freeze, zoom_and_back, shrink_and_back),
        *(open_a_second_page, pull_the_cable_and_plug_in),
    ],
    ids=lambda d: d.__name__,
)
def test_a_page_disturbed_in_mid_scan(
    disturb: Any, desktop: Desktop, hardware: Program, station: Station, window: Window
) -> None:
    scan = station.scan("room", **BRIEF).start("fringe_capture")
    scan.wait_for_shot(4)
    disturb(window, desktop)
    window.page.wait_for_function(
        "([left, width, height]) => screenX === left && innerWidth === width && innerHeight === height",
        arg=[SIZE[0], *SIZE],
    )
    ends_or_goes_on(scan)


def test_a_page_closed_in_mid_scan_and_opened_again(
    desktop: Desktop, hardware: Program, station: Station, playwright: Playwright
) -> None:
    with opened_window(desktop, station, playwright) as window:
        scan = station.scan("room", **BRIEF).start("fringe_capture")
        scan.wait_for_shot(4)
        window.page.close()
    with opened_window(desktop, station, playwright):
        ends_or_goes_on(scan)


def test_a_server_killed_in_mid_scan_finds_its_window_again(
    desktop: Desktop, hardware: Program, station: Station, window: Window
) -> None:
    scan = station.scan("room", **BRIEF).start("fringe_capture")
    scan.wait_for_shot(4)
    station.fall_and_rise()
    window.page.get_by_text("waits for patterns").wait_for()
    assert scan.state["job"]["status"] == "interrupted"
    assert scan.start("fringe_capture").end()["error"] is None
    assert len(scan.frames()) == 24
