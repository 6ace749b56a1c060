"""Pages, pictures and texts that come with the application (folder `frontend_assets`)."""

import hashlib
import html
import importlib.resources
from functools import lru_cache
from string import Template

from backend.domain.errors import NotFoundError

PUBLIC = {
    "help.md": "text/markdown; charset=utf-8",
    "fringes.svg": "image/svg+xml",
    "import.js": "text/javascript; charset=utf-8",
    "login.js": "text/javascript; charset=utf-8",
    "logo.svg": "image/svg+xml",
    "projector.css": "text/css; charset=utf-8",
    "projector.js": "text/javascript; charset=utf-8",
    "theme.css": "text/css; charset=utf-8",
}
"""Files that anybody may fetch, with their media types; nothing in them is secret."""


@lru_cache(maxsize=64)
def asset(name: str) -> tuple[bytes, str]:
    """Return a file's bytes and their hash (as entity tag, quoted)."""
    file = importlib.resources.files("frontend_assets") / name
    try:
        content = file.read_bytes()
    except OSError as error:
        raise NotFoundError(f"There is no file {name!r} among the application's assets.") from error
    return content, f'"{hashlib.sha256(content).hexdigest()[:16]}"'


def filled(page: str, /, **values: str) -> str:
    """Fill a page's `$placeholders`; every value is escaped, so none can bring markup along."""
    template = Template(asset(page)[0].decode("utf-8"))
    return template.substitute({key: html.escape(value) for key, value in values.items()})


@lru_cache(maxsize=1)
def help_page() -> str:
    """Return the operators' help as a page."""
    from markdown_it import MarkdownIt  # only when somebody asks for help

    text = asset("help.md")[0].decode("utf-8")
    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    return asset("help.html")[0].decode("utf-8").replace("$body", body)
