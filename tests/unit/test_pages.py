"""Projector pages: what drivers ask of them, what they answer, and in time or not."""

import json
import threading

import numpy as np
import pytest

from backend.devices.drivers import page_projector
from backend.devices.drivers.page_projector import PageOptions, PageProjector
from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceTimeout,
    GeometryError,
    RigConfigError,
)
from backend.devices.options import read_options
from backend.devices.pages import NOT_OURS, Page, PageDesk
from backend.devices.protocols import LinkState

GEOMETRY = {"width_px": 64, "height_px": 48, "ratio": 1.0, "refresh_period_ms": 16.667}


class Browser:
    """The other side of a page's connection: acknowledges at once, if it isn't told otherwise."""

    def __init__(self, desk: PageDesk, *, answers: bool = True) -> None:
        self.answers = answers
        self.code = ""
        self.geometry: dict[str, float] = GEOMETRY
        self.asked: list[int] = []
        self.loaded = 0
        self.refused = ""
        self.closed: int | None = None
        page = desk.join("projector", self)
        assert page is not None
        self.page: Page = page
        self.page.told(json.dumps({"t": "geometry", **GEOMETRY}))

    def send_text(self, text: str) -> None:
        message = json.loads(text)
        self.refused = message["text"] if message["t"] == "refuse" else self.refused
        if "id" in message:
            self.asked.append(message["id"])
            if self.answers:
                self.answer(message["id"])

    def send_bytes(self, data: bytes) -> None:
        self.loaded += 1

    def close(self, code: int, reason: str) -> None:
        self.closed = code

    def answer(self, number: int) -> None:
        kind = {"t": "error", "code": self.code} if self.code else {"t": "ack"}
        self.page.told(json.dumps({**kind, "id": number, "geometry": self.geometry}))


@pytest.fixture
def desk() -> PageDesk:
    return PageDesk()


def opened(desk: PageDesk) -> PageProjector:
    projector = PageProjector("projector", PageOptions(size=(64, 48), settle_ms=0.0), desk)
    projector.open()
    return projector


def test_a_late_answer_is_not_taken_for_the_next_drivers(desk: PageDesk) -> None:
    browser = Browser(desk, answers=False)
    first = opened(desk)
    first.load([np.zeros((48, 64), np.uint8)])
    with pytest.raises(DeviceTimeout, match="didn't draw"):
        first.show(0, timeout_s=0.01)
    first.close()
    second = opened(desk)
    second.load([np.zeros((48, 64), np.uint8)])
    browser.answer(browser.asked[0])
    with pytest.raises(DeviceTimeout, match="didn't draw"):
        second.show(0, timeout_s=0.01)


def test_a_page_shows_the_patterns_of_one_rig_at_a_time(desk: PageDesk) -> None:
    Browser(desk)
    options = PageOptions(size=(64, 48))
    first, second = (PageProjector("projector", options, desk.for_rig(rig)) for rig in "ab")
    first.open()
    with pytest.raises(
        DeviceBusy, match="page 'projector' shows the patterns of rig a; disconnect"
    ):
        second.open()
    second.close()
    first.reconnect()
    first.close()
    second.open()


def test_a_projector_that_cant_open_its_page_leaves_it_to_others(desk: PageDesk) -> None:
    Browser(desk)
    wrong, right = (
        PageProjector("projector", PageOptions(size=size), desk) for size in ((32, 32), (64, 48))
    )
    with pytest.raises(GeometryError):
        wrong.open()
    right.open()


def test_a_page_that_goes_while_it_is_taken_leaves_the_projector_closed(
    desk: PageDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = Browser(desk)
    projector = PageProjector("projector", PageOptions(size=(64, 48)), desk)

    def closed_meanwhile(timeout_s: float) -> None:
        browser.page.left()

    monkeypatch.setattr(browser.page, "wait_for_refresh", closed_meanwhile)
    with pytest.raises(DeviceDisconnected, match="was closed or reloaded"):
        projector.open()
    assert projector.state is LinkState.CLOSED
    Browser(desk)
    projector.open()
    projector.blank(0)


def test_a_lost_page_is_opened_again_and_gets_its_patterns(desk: PageDesk) -> None:
    browser = Browser(desk)
    projector = opened(desk)
    projector.load([np.zeros((48, 64), np.uint8)])
    browser.page.left()
    with pytest.raises(DeviceDisconnected, match="closed or reloaded; open it full screen again"):
        projector.show(0)
    assert projector.state is LinkState.LOST
    threading.Timer(0.05, Browser, (desk,)).start()
    projector.reconnect()
    assert projector.show(0).index == 0


def test_a_page_that_is_gone_is_noticed_before_anything_is_asked_of_it(desk: PageDesk) -> None:
    browser = Browser(desk)
    projector = opened(desk)
    browser.page.left()
    assert projector.state is LinkState.LOST


@pytest.mark.parametrize(
    ("change", "cure"),
    [
        ({"visible": False}, "bring it to the front"),
        ({"scale": 1.5}, "zoomed to 150 % by two fingers"),
        ({"width_px": 80}, "press F11"),
    ],
    ids=["hidden", "zoomed", "not full screen"],
)
def test_what_is_wrong_with_a_window_is_said_here_and_on_the_page(
    change: dict[str, float], cure: str, desk: PageDesk
) -> None:
    browser = Browser(desk)
    projector = opened(desk)
    browser.geometry = {**GEOMETRY, **change}
    with pytest.raises(GeometryError, match=cure):
        projector.blank()
    assert cure in browser.refused


def test_a_page_that_fails_is_lost(desk: PageDesk) -> None:
    browser = Browser(desk)
    projector = opened(desk)
    browser.code = "no-canvas"
    with pytest.raises(DeviceDisconnected, match=r"failed \(no-canvas\)"):
        projector.blank()
    assert projector.state is LinkState.LOST


def test_a_window_that_was_moved_is_refused_until_it_is_taken_anew(desk: PageDesk) -> None:
    browser = Browser(desk)
    projector = opened(desk)
    browser.geometry = {**GEOMETRY, "screen_x": 1920.0}
    with pytest.raises(GeometryError, match=r"moved to another place or screen \(x 1920, y 0\)"):
        projector.blank()
    assert projector.state is LinkState.LOST
    projector.reconnect()
    assert projector.blank(9).index == -1


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"t": "geometry", "width_px": 1}', '{"t": "ack"}',
             '{"t": "geometry", "width_px": 64, "height_px": 48, "ratio": NaN}'],
)  # fmt: skip
def test_what_no_page_of_ours_says_closes_it(text: str, desk: PageDesk) -> None:
    browser = Browser(desk)
    browser.page.told(text)
    assert browser.closed == NOT_OURS


@pytest.mark.parametrize("options", [{"refresh_hz": -60}, {"settle_ms": -1}, {"refresh_hz": 0}])
def test_rates_and_times_that_cant_be_are_refused(options: dict[str, float]) -> None:
    name, value = next(iter(options.items()))
    with pytest.raises(RigConfigError, match=f"option {name} can't be {value}"):
        read_options(PageOptions, "projector", {"size": "64x48", **options})


# ---------------------------------------------------------------- refresh rate and latency


def opened_with(
    desk: PageDesk, period_ms: float | None = 16.667, **options: object
) -> PageProjector:
    browser = Browser(desk)
    browser.page.told(json.dumps({"t": "geometry", **GEOMETRY, "refresh_period_ms": period_ms}))
    projector = PageProjector(
        "projector", read_options(PageOptions, "projector", {"size": "64x48", **options}), desk
    )
    projector.open()
    return projector


@pytest.mark.parametrize(
    ("period_ms", "hz"),
    [
        (16.6667, 60.0),
        (16.683, 59.94),
        (16.71, 59.84),
        (13.332, 75.0),
        (6.9443, 144.0),
        (20.9, 47.85),
    ],
)
def test_the_rate_is_the_one_the_page_measured(desk: PageDesk, period_ms: float, hz: float) -> None:
    projector = opened_with(desk, period_ms)
    assert projector.capabilities.refresh_hz == hz
    assert projector.remarks == ()


def test_what_the_file_says_counts_but_a_wrong_rate_is_told(desk: PageDesk) -> None:
    projector = opened_with(desk, 16.667, refresh_hz=75.0)
    assert projector.capabilities.refresh_hz == 75.0
    assert projector.remarks == (
        "The projector page draws 60 times a second, the rig's file says 75 Hz: correct refresh_hz or leave it out, or"
        " exposures don't fit the screen's frames.",
    )
    projector.close()
    assert opened_with(PageDesk(), 16.683, refresh_hz=60.0).remarks == (), "0.1 % is nothing"


def test_a_page_that_cant_measure_is_told(desk: PageDesk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_projector, "_REFRESH_S", 0.01)
    projector = opened_with(desk, None)
    assert projector.capabilities.refresh_hz == 60.0
    assert "couldn't measure" in projector.remarks[0]


LATENCY = {"settle_ms": 84.0, "exposure_ms": 16.667, "refresh_hz": 60.0, "screen": " at 0,0"}


@pytest.mark.parametrize(
    ("change", "remark"),
    [
        ({}, None),
        ({"screen": ""}, None),
        ({"refresh_hz": None}, None),
        ({"screen": "1280x800 at 1280,0"}, "on another screen"),
        ({"refresh_hz": 75.0}, "at 75 Hz, now the screen has 60 Hz"),
    ],
)
def test_a_latency_holds_for_its_screen_and_rate(
    desk: PageDesk, change: dict[str, object], remark: str | None
) -> None:
    projector = opened_with(desk, measured={**LATENCY, **change})
    if remark is None:
        assert (projector.settle_ms, projector.settle_exposure_ms) == (84.0, 16.667)
        assert projector.remarks == ()
    else:
        assert (projector.settle_ms, projector.settle_exposure_ms) == (None, None)
        assert remark in projector.remarks[0]
        assert "measure it again" in projector.remarks[0]


def test_a_settle_time_in_the_file_counts_more(desk: PageDesk) -> None:
    projector = opened_with(desk, settle_ms=0.0, measured={**LATENCY, "screen": "elsewhere"})
    assert projector.settle_ms == 0.0
    assert projector.remarks == ()
