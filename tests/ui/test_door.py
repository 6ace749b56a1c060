"""Through the door with a real browser: login, the station under its strict policy, logout."""

import contextlib
import re
import threading
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, expect

from backend.api.server import public_socket, server_for
from backend.main import build_application
from backend.settings import load_settings
from tests.contract.api_server import OPERATOR_TOKEN, VIEWER_TOKEN, toy_house

pytestmark = pytest.mark.ui

PATIENCE_MS = 60_000


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Run the whole application on a free port: the station's process too."""
    folder = tmp_path_factory.mktemp("data")
    settings = load_settings(
        data_folder=folder, token=OPERATOR_TOKEN, viewer_token=VIEWER_TOKEN, port=0
    )
    listening = public_socket("127.0.0.1", 0)
    port = listening.getsockname()[1]
    with toy_house(folder) as house:
        server = server_for(build_application(settings, house.services, port=port))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            server.should_exit = True
            thread.join(timeout=60)
            assert not thread.is_alive()


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    with contextlib.closing(
        chromium.new_context(viewport={"width": 1280, "height": 800})
    ) as context:
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        yield page


def connected(page: Page) -> None:
    """Wait until the station's page shows itself: its canvas is there and its socket has brought panels."""
    page.wait_for_selector("canvas", timeout=PATIENCE_MS)
    page.wait_for_selector(".mantine-Paper-root, .mantine-Tabs-root", timeout=PATIENCE_MS)


def test_name_and_token_lead_to_the_station(page: Page, address: str) -> None:
    refused: list[str] = []

    def note(message: ConsoleMessage) -> None:
        if "Content Security Policy" in message.text:
            refused.append(message.text)

    page.on("console", note)
    page.goto(address)
    expect(page).to_have_url(f"{address}/login")
    page.fill("#name", "Ada")
    page.fill("#token", "not the token")
    page.click("button")
    expect(page.get_by_role("alert")).to_contain_text("The token is wrong")
    page.fill("#token", OPERATOR_TOKEN)
    page.click("button")
    connected(page)

    assert page.title() == "unglare"
    assert refused == []


def test_the_link_of_the_terminal_leaves_no_token_in_the_address(page: Page, address: str) -> None:
    page.goto(f"{address}/?token={OPERATOR_TOKEN}")
    connected(page)

    assert OPERATOR_TOKEN not in page.url
    assert OPERATOR_TOKEN not in page.evaluate("document.referrer")


def test_no_script_reads_the_cookie_or_runs_what_it_is_told(page: Page, address: str) -> None:
    refused: list[str] = []
    page.on("console", lambda m: refused.append(m.text) if m.type == "error" else None)
    page.goto(f"{address}/?token={VIEWER_TOKEN}")
    connected(page)

    assert page.evaluate("document.cookie") == ""
    page.evaluate(
        "document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=window.hit=1>')"
    )
    page.evaluate(
        "document.head.append(Object.assign(document.createElement('script'), {text: 'window.hit=1'}))"
    )
    opened = page.evaluate(
        """() => new Promise(done => {
            try {
                const socket = new WebSocket("ws://localhost:9/");
                socket.onerror = () => done("refused"); socket.onopen = () => done("open");
            } catch (error) { done("refused"); }
        })"""
    )

    assert opened == "refused"
    assert page.evaluate("window.hit") is None
    assert any("connect-src" in text for text in refused)


def test_a_foreign_socket_in_the_address_is_dropped(page: Page, address: str) -> None:
    page.goto(f"{address}/?token={VIEWER_TOKEN}")
    connected(page)

    page.goto(f"{address}/station/?websocket=ws://localhost:9/")
    connected(page)

    assert "localhost:9" not in page.url


def test_logout_closes_every_page_of_the_session(page: Page, address: str) -> None:
    page.goto(f"{address}/?token={OPERATOR_TOKEN}")
    connected(page)
    other = page.context.new_page()
    other.goto(f"{address}/logout")
    other.click("button")
    expect(other).to_have_url(re.compile("/login$"))

    page.wait_for_url(f"{address}/login", timeout=PATIENCE_MS)


def test_who_is_logged_in_and_comes_from_elsewhere_goes_on(page: Page, address: str) -> None:
    page.goto(f"{address}/?token={OPERATOR_TOKEN}")
    connected(page)

    page.goto("data:text/html,<a href='" + address + "/'>station</a>")
    page.click(
        "a"
    )  # a strict cookie isn't sent along: the login page notices that there is a session

    connected(page)
