"""viser's page, made fit for a strict content security policy and for our login."""

import re

from backend.domain.errors import UnglareError

_LOADER = b"<script data-p"
_MODULE = b'e.type="module";'

# Two repairs run before viser does:
# - viser reconnects only while the window has the focus: never on a kiosk or inside a frame;
# - after a logout it would try again for ever without a word.
_REPAIRS = b"""document.hasFocus=()=>true;
setInterval(async()=>{try{const answer=await fetch("/api/me",{cache:"no-store"});
if(answer.status===401)location.href="/login"}catch(error){}},4000);"""


class StationPageError(UnglareError):
    """viser's page isn't the one that we know how to secure. Install the version that pyproject.toml pins."""

    status = 502


def policy(nonce: str) -> str:
    """Return the content security policy of the station's page.

    No `unsafe-eval`: viser could be told to run scripts by `RunJavascriptMessage`, and then can't.
    `connect-src 'self'`: `?websocket=` can't make the page obey a foreign server.
    """
    return (
        f"default-src 'none'; script-src 'nonce-{nonce}' 'wasm-unsafe-eval'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        "connect-src 'self' data: blob:; worker-src blob:; frame-src 'self'; "
        "frame-ancestors 'self'; base-uri 'none'; form-action 'self'"
    )


def secured(page: bytes, nonce: str) -> bytes:
    """Give viser's scripts the nonce, and put our repairs, name and icon into its page.

    Raises
    ------
    StationPageError
        If the two places where viser loads its scripts aren't there exactly once.
    """
    if page.count(_LOADER) != 1 or page.count(_MODULE) != 1:
        raise StationPageError(
            "The station's page is not that of the viser version we know; install the pinned one."
        )
    quoted = b'nonce="' + nonce.encode("ascii") + b'"'
    ours = b"<script " + quoted + b">" + _REPAIRS + b"</script>"
    page = page.replace(_LOADER, ours + b"<script " + quoted + b" data-p", 1)
    page = page.replace(_MODULE, _MODULE + b"e.nonce=" + quoted[6:] + b";", 1)
    return _with_our_face(page)


def _with_our_face(page: bytes) -> bytes:
    # Looks only: where viser writes its head differently, its own icon and title stay.
    head, mark, body = page.partition(b"</title>")
    icon = b'<link rel="icon" href="/assets/logo.svg" />'
    head = re.sub(rb'<link\s+rel="icon"\s[^>]*?/>', icon, head, count=1)
    return head.replace(b"<title>Viser", b"<title>unglare", 1) + mark + body
