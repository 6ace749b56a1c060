"""viser's page under our content security policy."""

import re
from pathlib import Path

import pytest
import viser

from backend.api.station_page import StationPageError, policy, secured

NONCE = "n0nce_-A"


@pytest.fixture(scope="module")
def page() -> bytes:
    """Return the page of the installed viser: an update that changes it is noticed here."""
    return (Path(viser.__file__).parent / "client" / "build" / "index.html").read_bytes()


def test_every_script_of_the_page_carries_the_nonce(page: bytes) -> None:
    scripts = re.findall(rb"<script[^>]{0,40}", secured(page, NONCE).partition(b"</head>")[0])

    assert len(scripts) == 2
    assert all(b'nonce="n0nce_-A"' in script for script in scripts)


def test_the_module_that_it_loads_gets_the_nonce_too(page: bytes) -> None:
    assert b'e.type="module";e.nonce="n0nce_-A";' in secured(page, NONCE)


def test_our_repairs_run_before_viser(page: bytes) -> None:
    done = secured(page, NONCE)

    assert 0 < done.index(b"document.hasFocus=()=>true") < done.index(b" data-p")
    assert b'fetch("/api/me"' in done


def test_the_page_bears_our_name_and_icon(page: bytes) -> None:
    head = secured(page, NONCE).partition(b"</title>")[0]

    assert head.endswith(b"<title>unglare")
    assert b'href="/assets/logo.svg"' in head
    assert head.count(b"<link") == 1


@pytest.mark.parametrize(
    "page",
    [
        b"<title>Viser</title><script>plain()</script>",
        b'<script data-p="x">e.type="module";</script><script data-p="y">',
        b'<script data-p="x">e.type="module";e.type="module";',
    ],
)
def test_a_page_that_we_dont_know_is_refused(page: bytes) -> None:
    with pytest.raises(StationPageError, match="install the pinned one"):
        secured(page, NONCE)


def test_the_policy_lets_nothing_in_from_elsewhere() -> None:
    directives = dict(part.strip().split(" ", 1) for part in policy(NONCE).split(";"))

    assert directives["default-src"] == "'none'"
    assert directives["script-src"] == "'nonce-n0nce_-A' 'wasm-unsafe-eval'"
    assert "unsafe-eval" not in policy(NONCE).replace("wasm-unsafe-eval", "")
    assert not re.search(r"https?:|wss?:|\*", policy(NONCE))
