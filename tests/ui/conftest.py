"""One server with its station and one browser for all tests; a page, and scans of their own, for each."""

import contextlib
import itertools
import shutil
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

from backend.api.sessions import Role
from backend.contract.requests import CreateScan
from tests.ui.browser import PATIENCE_MS, SOFTWARE_GL, Desk
from tests.ui.fake_scans import Scan
from tests.ui.fake_services import FakeServices
from tests.ui.served import Served, serve

POINTS = 20_000
"""Software WebGL draws more of them in seconds, not in frames per second."""

Seat = Callable[..., Desk]


@pytest.fixture(scope="session")
def served() -> Iterator[Served]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UNGLARE_POINTS_BUDGET", str(POINTS))
        with serve(FakeServices()) as running:
            yield running


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    """There can be only one in a process."""
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="session")
def chromium_program() -> str:
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("chromium isn't installed: apt-get install chromium")
    return program


@pytest.fixture(scope="session")
def chromium(playwright: Playwright, chromium_program: str) -> Iterator[Browser]:
    browser = playwright.chromium.launch(
        executable_path=chromium_program, headless=True, args=SOFTWARE_GL
    )
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def first_desk(chromium: Browser, served: Served) -> Iterator[Desk]:
    """Open one page for all tests that need only one: opening takes longer than most of them."""
    with open_desk(chromium) as desk:
        yield desk.open(served.address("Anna"))


@pytest.fixture
def seat(chromium: Browser, served: Served, first_desk: Desk) -> Iterator[Seat]:
    """Return a function that gives a user a page; checks all pages at the end."""
    desks: list[Desk] = []
    with contextlib.ExitStack() as pages:

        def sit(user: str = "Anna", role: Role = Role.OPERATOR) -> Desk:
            if user == "Anna":
                desks.append(first_desk.go_home())
            else:
                desk = pages.enter_context(open_desk(chromium))
                desks.append(desk.open(served.address(user, role)))
            return desks[-1]

        yield sit
        served.services.go_on.set()
        served.services.finish_jobs()
        defects = [desk.defects() for desk in desks]
    first_desk.errors.clear()
    assert defects == [[] for _ in desks]
    assert served.messages.refused_operators() == []


@contextlib.contextmanager
def open_desk(chromium: Browser) -> Iterator[Desk]:
    """Open a window of its own."""
    context = chromium.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(PATIENCE_MS)
    try:
        yield Desk(context.new_page())
    finally:
        context.close()


_NUMBERS = itertools.count(1)


@pytest.fixture
def make_scan(served: Served) -> Callable[..., Scan]:
    """Return a function that makes a scan with a name of its own."""

    def make(method: str = "hdr-fringe", name: str = "") -> Scan:
        title = name or f"Part {next(_NUMBERS)}"
        state = served.services.create_scan(CreateScan(method=method, name=title), "Bo")
        found: Scan = served.services.find(state.id)
        return found

    return make
