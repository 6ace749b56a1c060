"""The projector page in a real browser, driven by the real driver through the real server."""

import io
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import BrowserContext, Page, Playwright

from backend.devices.drivers.page_projector import PageOptions, PageProjector
from backend.devices.errors import (
    DeviceDisconnected,
    DeviceNotFound,
    DeviceTimeout,
    FeatureError,
    GeometryError,
)
from backend.devices.pages import PageDesk
from backend.devices.protocols import LinkState
from tests.contract.api_server import OPERATOR_TOKEN, VIEWER_TOKEN, toy_server
from tests.ui.browser import SOFTWARE_GL

pytestmark = pytest.mark.ui

SIZE = (640, 400)


@pytest.fixture(scope="module")
def desk() -> PageDesk:
    return PageDesk()


@pytest.fixture(scope="module")
def address(desk: PageDesk, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with toy_server(tmp_path_factory.mktemp("projector"), pages=desk) as served:
        yield served


Window = Callable[..., AbstractContextManager[BrowserContext]]


@pytest.fixture(scope="module")
def window(
    playwright: Playwright, chromium_program: str, tmp_path_factory: pytest.TempPathFactory
) -> Window:
    """Return what opens a browser with so many device pixels per CSS pixel: emulation would hide it from the page."""

    @contextmanager
    def open_window(ratio: float = 1.0) -> Iterator[BrowserContext]:
        css = tuple(round(pixels / ratio) for pixels in SIZE)
        browser = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"), executable_path=chromium_program, headless=True, no_viewport=True,
            args=[
                *SOFTWARE_GL, f"--force-device-scale-factor={ratio}", "--force-color-profile=srgb",
                "--hide-scrollbars", f"--window-size={css[0]},{css[1]}",
            ],
        )  # fmt: skip
        yield browser
        browser.close()

    return open_window


@pytest.fixture(scope="module")
def browser(window: Window) -> Iterator[BrowserContext]:
    with window() as opened:
        yield opened


@pytest.fixture
def page(browser: BrowserContext, address: str) -> Iterator[Page]:
    opened = show_projector(browser, address)
    yield opened
    opened.close()


def show_projector(browser: BrowserContext, address: str, token: str = OPERATOR_TOKEN) -> Page:
    page = browser.new_page()
    page.goto(f"{address}/projector?token={token}")
    return page


def true_size(desk: PageDesk) -> tuple[int, int]:
    found = desk.find("projector", 10.0)
    assert found is not None
    geometry = found.wait_for_geometry(10.0)
    assert geometry is not None
    return geometry.width_px, geometry.height_px


@contextmanager
def opened(desk: PageDesk, size: tuple[int, int] | None = None) -> Iterator[PageProjector]:
    options = PageOptions(size=size or true_size(desk), settle_ms=0.0)
    with PageProjector("projector", options, desk) as projector:
        yield projector


def patterns(width: int, height: int) -> list[np.ndarray]:
    rows, columns = np.mgrid[0:height, 0:width]
    fringe = 127.5 + 127.5 * np.cos(2 * np.pi * columns / 16)
    levels = (columns * 256 // width).astype(np.uint8)
    checker = (255 * ((rows + columns) % 2)).astype(np.uint8)
    lines = (255 * (rows % 7 == 0)).astype(np.uint8)
    return [np.round(fringe).astype(np.uint8), levels, checker, lines]


def seen(page: Page, shape: tuple[int, int]) -> np.ndarray:
    """Take a screenshot: the pattern is drawn from the top left corner on."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot(scale="device"))).convert("RGB"))
    gray = picture[: shape[0], : shape[1]]
    assert (gray == gray[..., :1]).all()
    return gray[..., 0]


@pytest.mark.parametrize("ratio", [1.0, 1.25, 2.0])
def test_every_pixel_is_drawn_exactly(
    ratio: float, desk: PageDesk, address: str, window: Window
) -> None:
    with window(ratio) as browser:
        page = show_projector(browser, address)
        with opened(desk) as projector:
            shown = patterns(*true_size(desk))
            projector.load(shown)
            for index, pattern in enumerate(shown):
                projector.show(index)
                np.testing.assert_array_equal(seen(page, pattern.shape), pattern)
            projector.blank(77)
            assert (seen(page, shown[0].shape) == 77).all()


def test_a_page_of_another_size_is_refused(page: Page, desk: PageDesk) -> None:
    width, height = true_size(desk)
    with (
        pytest.raises(GeometryError, match=f"{width}x{height}.*patterns 1280x800"),
        opened(desk, (1280, 800)),
    ):
        pass


def test_without_a_page_the_way_out_is_said() -> None:
    alone = PageProjector("projector", PageOptions(size=SIZE), PageDesk())
    with pytest.raises(DeviceNotFound, match="unglare projector"):
        alone.open()


def test_a_second_page_is_refused_and_the_first_goes_on(
    page: Page, window: Window, address: str, desk: PageDesk
) -> None:
    with opened(desk) as projector, window() as other:
        second = show_projector(other, address)
        second.get_by_text("Another page is this projector already").wait_for()
        assert projector.blank(10).index == -1


def test_viewers_have_no_projector(browser: BrowserContext, address: str, desk: PageDesk) -> None:
    stranger = show_projector(browser, address, VIEWER_TOKEN)
    stranger.get_by_text("Viewers have no projector").wait_for()
    assert desk.find("projector") is None
    stranger.close()


def test_a_reload_is_noticed_and_patterns_come_back(page: Page, desk: PageDesk) -> None:
    with opened(desk) as projector:
        shown = patterns(*true_size(desk))
        projector.load(shown)
        page.reload()
        with pytest.raises(DeviceDisconnected, match="closed or reloaded"):
            projector.show(0)
        assert projector.state is LinkState.LOST
        projector.reconnect()
        projector.show(2)
        np.testing.assert_array_equal(seen(page, shown[2].shape), shown[2])


ANSWERED_LATE = """
    const Socket = WebSocket;
    let is_first = true;
    window.WebSocket = class extends Socket {
      constructor(url) { super(is_first ? url.replace("/ws/projector", "/ws/nowhere") : url); is_first = false; }
    };
    window.fetch = () => new Promise((answer) => {
      window.answer = () => answer(new Response("", { status: 401 }));
    });
"""


def test_why_it_was_refused_is_not_written_over_patterns_that_came_since(
    browser: BrowserContext, address: str, desk: PageDesk
) -> None:
    page = browser.new_page()
    page.add_init_script(ANSWERED_LATE)
    page.goto(f"{address}/projector?token={OPERATOR_TOKEN}")
    with opened(desk) as projector:
        shown = patterns(*true_size(desk))[:1]
        projector.load(shown)
        projector.show(0)
        page.evaluate(
            "async () => { answer(); await new Promise((later) => setTimeout(later, 50)); }"
        )
        np.testing.assert_array_equal(seen(page, shown[0].shape), shown[0])
    page.close()


def test_a_frozen_page_times_out_and_works_again(page: Page, desk: PageDesk) -> None:
    with opened(desk) as projector:
        projector.blank(0)
        page.evaluate(
            "() => { setTimeout(() => { const end = Date.now() + 1500; while (Date.now() < end); }, 0) }"
        )
        projector.load(patterns(*true_size(desk))[:1])
        with pytest.raises(DeviceTimeout, match=r"didn't draw within 0\.5 s"):
            projector.show(0, timeout_s=0.5)
        assert projector.show(0, timeout_s=20.0).index == 0


def test_a_page_that_grows_in_the_middle_of_a_scan_is_refused(page: Page, desk: PageDesk) -> None:
    with opened(desk) as projector, ExitStack() as stack:
        projector.blank(0)
        page.set_viewport_size({"width": 500, "height": 300})
        stack.callback(page.set_viewport_size, {"width": SIZE[0], "height": SIZE[1]})
        page.wait_for_function("() => innerWidth === 500")
        with pytest.raises(GeometryError, match="500x300"):
            projector.blank(0)


def test_a_refused_page_says_why_in_words_that_can_be_read_from_afar(
    page: Page, desk: PageDesk
) -> None:
    width, height = true_size(desk)
    with pytest.raises(GeometryError), opened(desk, (1280, 800)):
        pass
    sentence = page.get_by_text("press F11 for full screen")
    sentence.wait_for()
    assert f"{width}x{height}" in sentence.inner_text()
    letters_px = float(sentence.evaluate("p => parseFloat(getComputedStyle(p).fontSize)"))
    assert letters_px >= height / 20
    with opened(desk) as projector:
        projector.blank(0)
        assert not sentence.is_visible()
        assert (seen(page, (height, width)) == 0).all()


def test_slots_and_levels_that_dont_exist_are_refused(page: Page, desk: PageDesk) -> None:
    with opened(desk) as projector:
        with pytest.raises(FeatureError):
            projector.show(0)
        with pytest.raises(FeatureError):
            projector.blank(256)
