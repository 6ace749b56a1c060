"""The rig's page in a browser: live pictures, exposure, patterns, latency, disconnecting, who may do what."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, expect

from backend.api.sessions import Role
from backend.jobs.rigs import Owner
from backend.services import latency, latency_bench, latency_triggered
from tests.ui.bench_served import Bench, serve_bench
from tests.ui.browser import PATIENCE_MS, Desk
from tests.ui.conftest import open_desk

pytestmark = [pytest.mark.ui, pytest.mark.timeout(400)]


@pytest.fixture(autouse=True)
def _patience() -> None:
    expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with pytest.MonkeyPatch.context() as patch:
        for module in (latency_bench, latency_triggered):
            patch.setattr(module, "STEADY_S", 0.06)
        with serve_bench() as running:
            yield running


@pytest.fixture(scope="module")
def desk(chromium: Browser, bench: Bench) -> Iterator[Desk]:
    with open_desk(chromium) as opened:
        yield opened.open(bench.served.address("Anna"))
        assert opened.defects() == []
        assert bench.served.messages.refused_operators() == []


@pytest.fixture
def page(desk: Desk) -> Iterator[Desk]:
    """The page of the bench, from the start page."""
    desk.page.locator("label.ug-set-up").click()
    expect(desk.page.locator(".ug-live-card b").first).to_be_visible()
    yield desk
    desk.page.locator("label.ug-back").filter(visible=True).click()
    expect(desk.page.locator("label.ug-set-up")).to_be_visible()


def pattern(page: Desk, name: str) -> Locator:
    return page.page.locator(".ug-pattern", has_text=re.compile(f"^{name}$"))


def card(page: Desk, camera: str) -> Locator:
    return page.page.locator(".ug-live-card", has_text=camera)


def mean_gray(page: Desk, camera: str = "left") -> float:
    text = card(page, camera).locator(".ug-shares").inner_text()
    found = re.search(r"mean (\d+) of 255", " ".join(text.split()))
    assert found, text
    return float(found.group(1))


def wait_for(page: Desk, condition: Any) -> None:
    """Wait for what the page tells sooner or later."""
    for _ in range(PATIENCE_MS // 100):
        if condition():
            return
        page.page.wait_for_timeout(100)
    raise AssertionError(f"it didn't happen within {PATIENCE_MS} ms")


def set_exposure(page: Desk, text: str, shown: str) -> None:
    page.control("Exposure [ms]").fill(text)
    expect(page.control("Exposure [ms]")).to_have_value(shown)
    expect(card(page, "left").locator(".ug-note")).to_have_text(f"{shown} ms")


def test_devices_and_pictures_are_shown(bench: Bench, page: Desk) -> None:
    devices = page.page.locator(".ug-device")
    expect(devices).to_have_count(3)
    expect(devices.nth(0)).to_contain_text("10.0.0.2")
    expect(devices.nth(2)).to_contain_text("60 Hz")
    expect(devices.nth(0).locator(".ug-state")).to_have_text("armed")
    taken = bench.rigs.opened[-1].eyes["left"].frames
    wait_for(page, lambda: bench.rigs.opened[-1].eyes["left"].frames > taken + 3)
    expect(page.page.locator(".uplot").first).to_be_visible()


def test_a_typed_exposure_snaps_and_moves_the_levels(page: Desk) -> None:
    set_exposure(page, "17", "16.67")
    before = mean_gray(page)
    set_exposure(page, "35", "33.33")
    expect(page.page.locator(".ug-setting-note", has_text="2 periods of 16.67 ms")).to_be_visible()
    wait_for(page, lambda: mean_gray(page) > 1.7 * before)


def test_what_was_typed_survives_a_click_right_after_it(page: Desk) -> None:
    set_exposure(page, "17", "16.67")
    page.control("Exposure [ms]").fill("60")
    pattern(page, "squares").click()
    expect(pattern(page, "squares")).to_have_class(re.compile("ug-on"))
    expect(card(page, "left").locator(".ug-note")).to_have_text("66.67 ms")
    expect(page.control("Exposure [ms]")).to_have_value("66.67")
    expect(pattern(page, "squares")).to_have_class(re.compile("ug-on"))
    pattern(page, "white").click()


def test_an_exposure_is_searched(page: Desk) -> None:
    pattern(page, "white").click()
    set_exposure(page, "200", "200")
    auto = page.page.locator("label.ug-link", has_text=re.compile("^auto$"))
    auto.click()
    expect(auto).to_be_hidden()
    expect(auto).to_be_visible()
    expect(card(page, "left").locator("b").nth(1)).to_have_text("0 %")
    assert 16 < float(page.control("Exposure [ms]").input_value()) < 50


def test_a_pattern_is_projected_and_seen(bench: Bench, page: Desk) -> None:
    pattern(page, "white").click()
    expect(pattern(page, "white")).to_have_class(re.compile("ug-on"))
    set_exposure(page, "17", "16.67")
    white = mean_gray(page)
    pattern(page, "squares").click()
    expect(pattern(page, "squares")).to_have_class(re.compile("ug-on"))
    wait_for(page, lambda: 0.3 * white < mean_gray(page) < 0.7 * white)
    expect(card(page, "left").locator(".ug-shares")).to_contain_text(re.compile("black [1-9]"))
    pattern(page, "gray").click()
    expect(page.control("Gray level")).to_have_value("128")
    pattern(page, "white").click()
    wait_for(page, lambda: mean_gray(page) > 0.9 * white)


def test_saturated_pixels_are_counted_and_marked_red(page: Desk) -> None:
    pattern(page, "white").click()
    set_exposure(page, "200", "200")
    wait_for(page, lambda: mean_gray(page) > 240)
    expect(card(page, "left").locator("b").nth(1)).not_to_have_text("0 %")
    page.settle(3)
    assert page.colourful(above=120) > 0.2
    set_exposure(page, "17", "16.67")
    page.settle(3)
    assert page.colourful(above=120) < 0.05


def test_a_click_magnifies_a_part(page: Desk) -> None:
    expect(page.page.get_by_text("Magnifier")).to_be_hidden()
    page.settle(3)
    box = page.page.locator("canvas[data-engine]").bounding_box()
    assert box is not None
    page.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 4)
    expect(page.page.locator(".ug-pixel", has_text="left, pixel")).to_be_visible()
    sharp = page.page.locator(".ug-sharp .ug-value")
    expect(sharp).to_have_count(3)
    expect(sharp.filter(has_text="% of best")).to_have_count(3)
    page.page.locator("label.ug-link", has_text="close").filter(visible=True).click()
    expect(page.page.get_by_text("Magnifier")).to_be_hidden()


def test_the_latency_is_measured_shown_and_kept(bench: Bench, page: Desk) -> None:
    page.button("Latency").click()
    expect(page.page.locator(".ug-work")).to_contain_text("Latency calibration")
    expect(page.page.locator(".ug-owner")).to_contain_text("Anna runs the latency calibration")
    expect(page.control("Exposure [ms]")).to_be_disabled()
    settled = page.page.locator(".ug-fact", has_text="Settle time")
    expect(settled).to_be_visible()
    expect(page.page.get_by_text("Kept for this rig")).to_be_visible()
    expect(page.page.locator(".ug-device").nth(2)).to_contain_text("settles in")

    found = latency.Latency.kept(bench.shelf.folder, "bench")
    assert found is not None
    assert 40.0 < found.settle_ms < 120.0
    assert bench.rigs.opened[-1].projector.settle_ms == found.settle_ms
    expect(page.control("Exposure [ms]")).to_be_enabled()


def test_a_latency_calibration_can_be_cancelled(page: Desk) -> None:
    page.button("Latency").click()
    page.page.locator("label.ug-link", has_text="cancel").click()
    expect(page.page.get_by_text("Latency calibration: cancelled.")).to_be_visible()
    expect(page.button("Latency")).to_be_enabled()


def test_disconnecting_gives_the_devices_back(bench: Bench, page: Desk) -> None:
    rig = bench.rigs.opened[-1]
    page.button("Disconnect").click()
    expect(page.page.locator(".ug-rig-link")).to_contain_text("disconnected")
    assert {device.state.value for device in (*rig.eyes.values(), rig.projector)} == {"closed"}
    expect(page.page.locator(".ug-live-card")).to_have_count(0)
    page.button("Connect").click()
    expect(page.page.locator(".ug-rig-link")).to_contain_text("connected")
    expect(card(page, "left").locator("b").first).to_be_visible()
    assert bench.rigs.opened[-1] is not rig


def test_who_captures_is_named_and_controls_wait(bench: Bench, page: Desk) -> None:
    pool = bench.services.context.rigs
    with pool.lease("bench", {}, Owner("17", "Bracket", "Bo")):
        expect(page.page.locator(".ug-owner")).to_contain_text("Bo captures scan 'Bracket'")
        expect(page.button("Disconnect")).to_be_disabled()
        expect(page.control("Exposure [ms]")).to_be_disabled()
        expect(page.page.locator("label.ug-pattern")).to_have_count(0)
    expect(page.page.locator(".ug-owner")).to_have_count(0)
    expect(page.button("Disconnect")).to_be_enabled()


def test_nothing_is_polled_when_the_page_is_closed(bench: Bench, page: Desk) -> None:
    rig = bench.rigs.opened[-1]
    page.page.locator("label.ug-back").filter(visible=True).click()
    expect(page.page.locator("label.ug-set-up")).to_be_visible()
    wait_for(page, lambda: rig.eyes["left"].state.value == "ready")
    taken = rig.eyes["left"].frames
    page.page.wait_for_timeout(700)
    assert rig.eyes["left"].frames == taken
    page.page.locator("label.ug-set-up").click()
    expect(page.page.locator(".ug-live-card b").first).to_be_visible()


def test_a_rig_that_failed_to_load_says_why(page: Desk) -> None:
    page.choose("Rig", "Broken bench")
    expect(page.page.locator(".ug-why").filter(visible=True)).to_contain_text("vendor_sdk")
    expect(page.button("Latency")).to_be_disabled()
    page.choose("Rig", "Bench 1")
    expect(card(page, "left").locator("b").first).to_be_visible()


def test_a_viewer_sees_the_rig_that_is_set_up(chromium: Browser, bench: Bench, page: Desk) -> None:
    with open_desk(chromium) as viewer:
        viewer.open(bench.served.address("Vera", Role.VIEWER))
        page.button("Reconnect").click()  # something happens to it
        expect(card(viewer, "left").locator("b").first).to_be_visible()
        expect(viewer.page.locator(".ug-device")).to_have_count(3)
        expect(viewer.page.locator("label.ug-pattern")).to_have_count(0)
        expect(viewer.button("Disconnect")).to_have_count(0)
        assert viewer.defects() == []
