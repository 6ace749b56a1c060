"""Pictures that an operator paints on, picks a point in, or asks for a pixel's response; results kept for the rig."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, expect

from backend.contract.requests import StartRun
from tests.ui.browser import PATIENCE_MS, Desk
from tests.ui.conftest import Seat
from tests.ui.fake_scans import Scan
from tests.ui.served import Served

pytestmark = [pytest.mark.ui, pytest.mark.timeout(400)]
MakeScan = Callable[..., Scan]


@pytest.fixture(scope="module", autouse=True)
def patience() -> None:
    expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture
def scan(served: Served, make_scan: MakeScan) -> Scan:
    made = make_scan("painted")
    served.services.run(made.id, StartRun(), "Bo")
    served.services.finish_jobs()
    return made


def wishes(served: Served, what: str) -> list[Any]:
    return [request for _, asked, request in served.services.asked if asked == what]


def show(desk: Desk, picture: str) -> None:
    """Choose a picture of the stage: the page may still show what was looked at last."""
    desk.page.get_by_role("combobox", name="Show").click()
    desk.page.get_by_role("option", name=picture).click()


def inspect(desk: Desk) -> Locator:
    """Enlarge the first picture; returns the canvas."""
    close = desk.page.locator(".mantine-Notification-closeButton")
    while close.count():
        close.first.click()
        close.first.wait_for(state="detached")
    desk.page.locator("label.ug-link", has_text="inspect").first.click()
    expect(desk.page.get_by_text("✕ close")).to_be_visible()
    desk.settle(3)
    return desk.page.locator("canvas[data-engine]")


def place(canvas: Locator, x: float, y: float) -> tuple[float, float]:
    """Return a point of the page, from shares of the canvas."""
    box = canvas.bounding_box()
    assert box is not None
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def test_a_stroke_becomes_a_mask_that_the_setting_names(
    served: Served, seat: Seat, scan: Scan
) -> None:
    desk = seat().open_scan(scan.name)
    show(desk, "Intensity mask")
    canvas = inspect(desk)
    mouse = desk.page.mouse
    mouse.move(*place(canvas, 0.4, 0.25))
    mouse.down()
    mouse.move(*place(canvas, 0.6, 0.25), steps=8)
    mouse.up()
    expect(desk.page.get_by_text("1 not applied")).to_be_visible()
    desk.page.get_by_role("button", name="Apply", exact=True).last.click()
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("edited")

    painted = wishes(served, "upload")[-1]
    (edit,) = [e for e in wishes(served, "edit mask") if "paint" in e.changes]
    assert painted.shape == (200, 320)
    assert 0.02 < np.mean(~np.isnan(painted)) < 0.5
    assert np.nanmax(painted) == np.nanmin(painted) == pytest.approx(0.3)
    assert len(edit.changes["paint"]) == 64


def test_a_point_of_a_search_map_is_proposed_and_applied(
    served: Served, seat: Seat, scan: Scan
) -> None:
    desk = seat().open_scan(scan.name)
    show(desk, "U over darkest")
    canvas = inspect(desk)
    desk.page.mouse.click(*place(canvas, 0.15, 0.42))
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("changed, not applied")
    desk.button("Apply").click()
    expect(desk.page.locator(".ug-setting-note")).to_contain_text("edited")

    (edit,) = [e for e in wishes(served, "edit mask") if "interval_gray" in e.changes]
    low, high = edit.changes["interval_gray"]
    assert high > low + 20, "refused cells can't be chosen"


def test_a_pixel_shows_its_response_and_the_result_is_kept(
    served: Served, seat: Seat, scan: Scan
) -> None:
    desk = seat().open_scan(scan.name).select("Response")
    canvas = inspect(desk)
    desk.page.mouse.click(*place(canvas, 0.5, 0.25))
    expect(desk.page.get_by_text("slope 1.")).to_be_visible()
    expect(desk.page.locator(".uplot").filter(visible=True)).to_have_count(1)
    desk.page.locator("label.ug-link", has_text="Keep for this rig").click()
    expect(desk.page.locator(".ug-handed")).to_contain_text("given to new scans")

    assert wishes(served, "keep")


def test_a_handed_over_result_is_chosen_and_taken_away(
    served: Served, seat: Seat, scan: Scan
) -> None:
    scan.homography = "Calibration 3 of the rig: 'Plane', Bo"
    desk = seat().open_scan(scan.name)
    line = desk.page.locator(".ug-handed", has_text="Table homography")
    expect(line).to_contain_text("Calibration 3 of the rig")
    line.locator("label", has_text="remove").click()
    expect(line).to_contain_text("none handed over")

    assert wishes(served, "take away")[-1] == "TableHomography"
