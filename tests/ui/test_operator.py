"""What an operator does in a browser, and what arrives at the services."""

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import expect

from backend.api.sessions import Role
from backend.contract import requests
from backend.domain.states import Verdict
from tests.ui.browser import PATIENCE_MS, Desk
from tests.ui.conftest import POINTS
from tests.ui.fake_methods import EVIL
from tests.ui.fake_scans import Scan
from tests.ui.served import Served

pytestmark = [pytest.mark.ui, pytest.mark.timeout(400)]

Seat = Callable[..., Desk]
MakeScan = Callable[..., Scan]


@pytest.fixture(autouse=True)
def _patience() -> None:
    expect.set_options(timeout=PATIENCE_MS)


def wishes(served: Served, scan: Scan, what: str) -> list[Any]:
    """Return what was asked of this kind since the scan was made."""
    since = next(
        i
        for i, (_, w, r) in enumerate(served.services.asked)
        if w == "create" and r.name == scan.name
    )
    return [r for _, w, r in served.services.asked[since:] if w == what]


def run_to_gate(served: Served, scan: Scan) -> None:
    """Run until a stage asks."""
    served.services.run(scan.id, requests.StartRun(), "Bo")
    served.services.finish_jobs()


def test_from_the_list_to_a_stage_and_to_its_decision(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat()
    desk.control("Search").fill(scan.name)
    expect(desk.page.locator("label.ug-scan")).to_have_count(1)
    desk.open_scan(scan.name)

    for stage in scan.stages:
        expect(desk.step(stage.title)).to_be_visible()
    expect(desk.state).to_have_text("your decision")
    expect(desk.sentence).to_contain_text("3 zones fitted")
    desk.button("Accept").click()
    expect(desk.page.locator(".ug-status-title")).to_contain_text("Exposures")
    expect(desk.page.locator(".ug-finding.ug-is-warning")).to_contain_text("0.039 rad")

    (decision,) = wishes(served, scan, "decide")
    assert (decision.verdict, decision.proceed) == (Verdict.ACCEPT, True)


def test_the_key_accepts_and_does_not_move_the_camera(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)
    expect(desk.state).to_have_text("your decision")
    desk.settle(3)
    before = desk.camera()
    desk.page.locator(".ug-title").click()  # out of every input
    desk.page.keyboard.press("f")
    expect(desk.page.locator(".ug-status-title")).to_contain_text("Exposures")

    assert desk.camera() == pytest.approx(before)
    assert len(wishes(served, scan, "decide")) == 1


def test_a_border_that_is_dragged_becomes_an_edit(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)
    thumbs = desk.page.locator(".multi-slider-thumb")
    expect(thumbs).to_have_count(4)
    expect(desk.button("Override")).to_be_disabled()
    desk.drag(thumbs.nth(2), 30)
    expect(desk.page.locator(".ug-zone").nth(2)).not_to_contain_text("117")
    assert wishes(served, scan, "edit zones") == []  # nothing is sent before it is applied
    desk.button("Apply").click()
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("edited")

    (edit,) = wishes(served, scan, "edit zones")
    low, first, second, high = edit.changes["valleys_gray"]
    assert (low, first, high) == (9.0, 48.0, 238.0)
    assert 120.0 < second < 170.0
    served.services.finish_jobs()
    assert scan.status(scan.stage("zones")) == "awaiting_review"  # run again, up to here


def test_a_number_is_typed_applied_and_reset(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)
    box = desk.control("Histogram smoothing")
    expect(box).to_have_value("3.5")
    box.fill("7.25")
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("was 3.5 gray")
    desk.control("Reason, for the log").fill("too rough")
    expect(desk.control("Reason, for the log")).to_have_value("too rough")
    desk.button("Apply").click()
    reset = desk.page.locator("label.ug-link", has_text="reset")
    expect(reset).to_be_visible()
    served.services.finish_jobs()
    expect(desk.state).to_have_text("your decision")
    reset.click()
    expect(box).to_have_value("3.5")

    first, second = wishes(served, scan, "edit zones")
    assert first.changes == {"sigma_gray": 7.25}
    assert first.reason == "too rough"
    assert second.reset == ("sigma_gray",)


def test_what_can_t_be_read_is_said_and_not_sent(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)
    desk.control("Zone borders").fill("9, many")
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("“many” is not a number")
    desk.control("Histogram smoothing").fill("9")
    desk.button("Apply").click()
    expect(desk.page.locator(".mantine-Notification-root").last).to_contain_text("not a number")
    assert wishes(served, scan, "edit zones") == []

    # What couldn't be read is gone with its control; what could be read is kept.
    desk.select("Preview").select("Zones")
    expect(desk.control("Histogram smoothing")).to_have_value("9")
    desk.button("Apply").click()
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("edited")
    assert [e.changes for e in wishes(served, scan, "edit zones")] == [{"sigma_gray": 9.0}]


def test_the_server_s_refusal_is_shown_in_its_words(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)
    desk.control("Zone borders").fill("9")  # at least two
    desk.button("Apply").click()

    expect(desk.page.get_by_text("at least 2 items")).to_be_visible()


def test_progress_is_shown_and_a_job_can_be_cancelled(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    desk = seat().open_scan(scan.name)
    served.services.go_on.clear()
    desk.button("Run").click()
    expect(desk.sentence).to_have_text("Frame 18 of 72")
    expect(desk.page.locator(".ug-ends").first).to_contain_text("32 s left")
    expect(desk.page.locator(".ug-heading", has_text="Live")).to_be_visible()
    desk.button("Cancel").click()
    expect(desk.button("Run")).to_be_enabled()

    assert wishes(served, scan, "cancel") == [None]


def test_the_cloud_is_really_drawn_and_can_be_asked(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    served.services.accept_all(scan)
    desk = seat().open_scan(scan.name)
    desk.wait_for_points(POINTS // 2)
    desk.settle(3)
    share = desk.colourful()
    assert share > 0.04
    assert desk.points() <= POINTS
    canvas = desk.page.locator("canvas[data-engine]").bounding_box()
    assert canvas is not None
    desk.page.mouse.click(
        canvas["x"] + canvas["width"] * 0.5, canvas["y"] + canvas["height"] * 0.45
    )
    expect(desk.page.get_by_text("Point of the cloud")).to_be_visible()
    expect(
        desk.page.locator(".ug-heading", has_text=re.compile(r"Pixel \d+, \d+ of left"))
    ).to_be_visible()

    desk.page.evaluate(
        "() => window.__viserMutable.scene.traverse(o => {if (o.isPoints) o.visible = false})"
    )
    desk.settle(3)
    assert desk.colourful() < share / 3  # the colour came from the cloud


def test_a_missing_pixel_says_why(served: Served, seat: Seat, make_scan: MakeScan) -> None:
    scan = make_scan()
    served.services.accept_all(scan)
    reasons = next(
        f for f in scan.runs[scan.key(scan.stage("fringe_phase"))].fields if f.name == "reasons"
    )
    values = served.services.artifact(reasons.arrays["left"].hash)
    y, x = next((int(y), int(x)) for y, x in zip(*(values == 4).nonzero(), strict=True))
    desk = seat().open_scan(scan.name).select("Phase")
    desk.page.locator("label.ug-zoom").first.click()
    expect(desk.page.get_by_text("Click a pixel")).to_be_visible()
    desk.control("x [px]").fill(str(x))
    desk.control("y [px]").fill(str(y))

    expect(desk.page.locator(".ug-why")).to_have_text("Missing: residual too large")
    desk.page.locator("label.ug-link", has_text="close").click()
    expect(desk.page.get_by_text("Click a pixel")).to_have_count(0)


def test_two_browsers_on_one_scan_see_the_same(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    anna, zoe = seat("Anna").open_scan(scan.name), seat("Zoe").open_scan(scan.name)
    expect(zoe.state).to_have_text("your decision")
    anna.button("Accept").click()

    expect(zoe.page.locator(".ug-status-title")).to_contain_text("Exposures")
    zoe.page.get_by_text("Log", exact=True).click()
    expect(zoe.page.locator(".ug-log")).to_contain_text("Anna")


def test_a_stale_edit_shows_the_other_one_s(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)
    box = desk.control("Histogram smoothing")
    box.fill("9")
    expect(desk.button("Apply")).to_be_enabled()
    # Somebody edits without an event: as if the browser were a moment late.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(served.services.events, "publish", lambda _: None)
        wish = requests.EditSettings(changes={"sigma_gray": 5.0}, revision=scan.revision)
        served.services.edit(scan.id, "zones", wish, "Bo")
    desk.button("Apply").click()

    expect(desk.page.get_by_text("Bo set sigma_gray to 5.0 meanwhile")).to_be_visible()
    expect(box).to_have_value("5")
    assert scan.revision == 1


def test_a_viewer_sees_everything_and_no_controls(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan()
    run_to_gate(served, scan)
    desk = seat("Vera", Role.VIEWER)
    expect(desk.page.locator(".ug-title")).to_have_text(scan.name)
    expect(desk.sentence).to_contain_text("3 zones fitted")
    expect(desk.page.locator(".ug-figure img").first).to_be_visible()

    expect(desk.page.locator("label.ug-click")).to_have_count(0)
    expect(desk.page.locator(".multi-slider-thumb")).to_have_count(0)
    expect(
        desk.page.get_by_role("button", name=re.compile("Accept|Run|Redo|Override|Reject|Apply"))
    ).to_have_count(0)
    served.services.decide(scan.waiting().id, requests.Decide(verdict=Verdict.ACCEPT), "Bo")
    expect(desk.page.locator(".ug-status-title")).to_contain_text("Exposures")


def test_names_do_no_harm_and_no_method_is_special(
    served: Served, seat: Seat, make_scan: MakeScan
) -> None:
    scan = make_scan("odd-one", name=f"Odd {EVIL}")
    run_to_gate(served, scan)
    desk = seat().open_scan(scan.name)

    expect(desk.page.locator(".ug-step")).to_have_count(9)
    expect(desk.sentence).to_have_text(f"Done & {EVIL}")
    expect(desk.page.locator(".ug-facts")).to_contain_text(f"so & so {EVIL}")
    expect(desk.page.locator(".ug-legend")).to_contain_text(EVIL)
    expect(desk.control("Pair [mm]")).to_have_value("1, 2.5")
    assert desk.page.locator('img[src="x"]').count() == 0
    assert desk.page.title() != "1"


def test_a_new_scan_is_made_with_the_rig_s_options(served: Served, seat: Seat) -> None:
    desk = seat()
    desk.control("Name").fill("Made in a browser")
    desk.control("Noise seed").fill("7")
    expect(desk.control("Noise seed")).to_have_value("7")
    desk.button("Create and run").click()
    expect(desk.page.locator(".ug-title")).to_have_text("Made in a browser")
    served.services.finish_jobs()

    request = next(
        r for _, w, r in served.services.asked if w == "create" and r.name == "Made in a browser"
    )
    assert (request.method, request.rig, request.rig_options) == (
        "hdr-fringe",
        "simulated",
        {"seed": 7},
    )
    expect(desk.state).to_have_text("your decision")
