"""Projector pages: browser windows on a projector's screen, and how drivers reach them.

A page connects to the application, not the other way round. The desk brings both together: whoever serves
the page's websocket hands the connection in, the driver of the projector takes it out by the page's name.

Messages to a page are JSON texts; pixels follow as one binary message of gray bytes, row by row::

    to the page     {"t": "load", "slot": k, "w": .., "h": ..} + pixels     {"t": "show", "id": n, "slot": k}
                    {"t": "blank", "id": n, "level": v, "w": .., "h": ..}
                    {"t": "refuse", "text": why nothing is shown until that is mended}
    from the page   {"t": "geometry", ...}      {"t": "ack", "id": n, "geometry": {...}}
                    {"t": "error", "id": n, "code": "no-slot"}
"""

import copy
import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict, Field, ValidationError

SECOND_PAGE = 4009
"""Close code of a page that came second."""
_USUAL_RATES_HZ = (23.976, 24.0, 25.0, 29.97, 30.0, 48.0, 50.0, 59.94, 60.0, 72.0, 75.0, 85.0, 90.0, 100.0, 119.88, 120.0, 144.0, 165.0, 240.0)  # fmt: skip
NOT_OURS = 4008
"""Close code of a page that says what no page of ours says."""


class Geometry(BaseModel):
    """Where a page is and how it draws, in its own words."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    width_px: int
    """Device pixels of the window's content."""
    height_px: int
    ratio: float = Field(gt=0)
    """Device pixels per CSS pixel."""
    scale: float = 1.0
    """Pinch zoom."""
    visible: bool = True
    screen_x: float = 0.0
    screen_y: float = 0.0
    """Where the window stands, in CSS pixels: another place is another screen."""
    screen: str = ""
    """What the browser tells of the screen."""
    refresh_period_ms: float | None = Field(None, gt=0)
    """Of the screen, as the page sees its animation frames; None: not measured yet."""

    @property
    def place(self) -> tuple[float, float, str]:
        """What changes when the window goes to another screen."""
        return self.screen_x, self.screen_y, self.screen


def usual_rate_hz(measured_hz: float) -> float:
    """Return the usual refresh rate that a measured one is, else the measured one to 0.01 Hz.

    Measured twice, a rate differs in its last digits; what is kept for a rig must not.

    Examples
    --------
    >>> usual_rate_hz(59.9401), usual_rate_hz(59.98), usual_rate_hz(47.1234)
    (59.94, 60.0, 47.12)
    """
    nearest = min(_USUAL_RATES_HZ, key=lambda rate: abs(rate - measured_hz))
    return nearest if abs(nearest / measured_hz - 1) < 5e-4 else round(measured_hz, 2)


@runtime_checkable
class Connection(Protocol):
    """A page's websocket. Called from any thread; returns before the message is out."""

    def send_text(self, text: str) -> None:
        """Send a text message."""
        ...

    def send_bytes(self, data: bytes) -> None:
        """Send a binary message."""
        ...

    def close(self, code: int, reason: str) -> None:
        """End the connection."""
        ...


@dataclass(frozen=True)
class Reply:
    """What a page said to one request."""

    id: int
    code: str
    """Empty: done; else what went wrong."""


class Page:
    """One connected page: requests out, replies in. Threads may wait for it."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._changed = threading.Condition()
        self._geometry: Geometry | None = None
        self._asked = 0
        self._replies: dict[int, Reply] = {}
        self._gone = False

    @property
    def geometry(self) -> Geometry | None:
        """The newest geometry that it told."""
        return self._geometry

    @property
    def gone(self) -> bool:
        """Whether it was closed."""
        return self._gone

    def send(self, message: Mapping[str, Any], pixels: bytes | None = None) -> None:
        """Send a request, and the pixels that belong to it."""
        self._connection.send_text(json.dumps(message))
        if pixels is not None:
            self._connection.send_bytes(pixels)

    def ask(self, message: Mapping[str, Any]) -> int:
        """Send a request that is answered, and return its number.

        The page counts, not whoever asks: a page outlives its drivers, and a late answer to one driver
        must not pass for an answer to the next.
        """
        with self._changed:
            self._asked += 1
            number = self._asked
        self.send({**message, "id": number})
        return number

    def wait_for_geometry(self, timeout_s: float) -> Geometry | None:
        """Wait until the page has told where it is."""
        with self._changed:
            self._changed.wait_for(lambda: self._geometry or self._gone, timeout_s)
            return self._geometry

    def wait_for_refresh(self, timeout_s: float) -> float | None:
        """Wait until the page has measured its screen's refresh rate, in [Hz]; None if it hasn't."""
        with self._changed:
            self._changed.wait_for(lambda: self._refresh_hz() or self._gone, timeout_s)
            return self._refresh_hz()

    def _refresh_hz(self) -> float | None:
        period_ms = self._geometry.refresh_period_ms if self._geometry else None
        return None if period_ms is None else usual_rate_hz(1000.0 / period_ms)

    def wait_for_reply(self, request_id: int, timeout_s: float) -> Reply | None:
        """Wait for the answer to a request; None if none came, or the page is gone."""
        with self._changed:
            self._changed.wait_for(lambda: request_id in self._replies or self._gone, timeout_s)
            reply = self._replies.get(request_id)
            # Answers to earlier requests came too late for whoever waited.
            self._replies = {n: r for n, r in self._replies.items() if n > request_id}
            return reply

    def told(self, text: str) -> None:
        """Take what the page says; what isn't ours closes it."""
        try:
            message = json.loads(text)
            self._note(message["t"], message)
        except (ValueError, KeyError, TypeError, ValidationError):
            self._connection.close(NOT_OURS, "this isn't the projector page's language")

    def left(self) -> None:
        """Note that the connection has ended."""
        with self._changed:
            self._gone = True
            self._changed.notify_all()

    def _note(self, kind: str, message: Mapping[str, Any]) -> None:
        told = message.get("geometry") if kind != "geometry" else message
        geometry = Geometry.model_validate(told) if told else None
        with self._changed:
            self._geometry = geometry or self._geometry
            if kind in ("ack", "error"):
                code = "" if kind == "ack" else str(message.get("code", "unknown"))
                self._replies[int(message["id"])] = Reply(int(message["id"]), code)
            self._changed.notify_all()


class PageDesk:
    """The pages of one application, by name; one page a name, and one projector a page."""

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}
        self._changed = threading.Condition()
        self._holders: dict[str, tuple[object, str]] = {}
        self._rig = ""

    def for_rig(self, rig: str) -> "PageDesk":
        """Return the same desk, as one rig's projector uses it."""
        desk = copy.copy(self)
        desk._rig = rig  # noqa: SLF001  our own copy
        return desk

    def hold(self, name: str, projector: object) -> str | None:
        """Take the page of a name for one projector; returns the rig that has it if another one does."""
        with self._changed:
            holder, rig = self._holders.setdefault(name, (projector, self._rig))
            return None if holder is projector else rig

    def let_go(self, name: str, projector: object) -> None:
        """Give a page back; does nothing where the projector hasn't got it."""
        with self._changed:
            if self._holders.get(name, (None, ""))[0] is projector:
                del self._holders[name]

    def join(self, name: str, connection: Connection) -> Page | None:
        """Take a page in; None if there is one of this name already, which keeps working."""
        with self._changed:
            present = self._pages.get(name)
            if present is not None and not present.gone:
                return None
            page = self._pages[name] = Page(connection)
            self._changed.notify_all()
            return page

    def find(self, name: str, timeout_s: float = 0.0) -> Page | None:
        """Return the page of a name, waiting for it if need be."""
        with self._changed:
            self._changed.wait_for(lambda: self._present(name), timeout_s)
            return self._present(name)

    def _present(self, name: str) -> Page | None:
        page = self._pages.get(name)
        return None if page is None or page.gone else page
