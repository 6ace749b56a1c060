"""A browser window on the projector's screen, or on the screen of a deflectometry rig, as projector.

The browser's acknowledgement after two animation frames says *submitted*, not *lit*: what the screen and its
electronics add is measured by the latency calibration and waited for here, in `settle_ms`.
"""

import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
    GeometryError,
)
from backend.devices.link import Link
from backend.devices.options import DeviceOptions, DisplaySize, read_options, takes
from backend.devices.pages import Geometry, Page, PageDesk
from backend.devices.protocols import DeviceInfo, LinkState, Presented, ProjectorCapabilities
from backend.devices.refusals import refuse_level, refuse_other_sizes, refuse_unloaded

_JOIN_S = 5.0
_GEOMETRY_S = 2.0
_REFRESH_S = 4.0
"""A page counts 90 frames."""
_ASSUMED_REFRESH_HZ = 60.0
_ALIKE = 0.01
"""Rates that differ by less are the same."""
HIDDEN = (
    "the projector page is hidden by another window or tab; bring it to the front of its monitor"
)


class MeasuredLatency(DeviceOptions):
    """What the latency calibration found, and where."""

    settle_ms: float = Field(ge=0, le=10_000)
    exposure_ms: float | None = None
    refresh_hz: float | None = None
    screen: str = ""
    """Empty: not known."""


class PageOptions(DeviceOptions):
    """How the page's screen is driven."""

    size: DisplaySize
    """Width and height of the projector in [px]: what the page shows is never scaled."""
    page: str = "projector"
    """Name in the page's address."""
    refresh_hz: float | None = Field(None, gt=0)
    """None: as the page measures it."""
    settle_ms: float | None = Field(None, ge=0, le=10_000)
    """From the acknowledgement to the light; None: as the latency calibration found it, if it was measured."""
    measured: MeasuredLatency | None = None
    """What the latency calibration found, kept beside the rig's file; holds for the screen it was measured on."""


@takes(PageOptions)
def create_projector(name: str, options: Mapping[str, Any], desk: PageDesk) -> "PageProjector":
    """Make a projector of a rig file's entry."""
    return PageProjector(name, read_options(PageOptions, name, options), desk)


class PageProjector(Link):
    """A `Projector` in a browser."""

    def __init__(self, name: str, options: PageOptions, desk: PageDesk) -> None:
        super().__init__(
            name,
            DeviceInfo(
                "", "browser page", driver="page", address=f"/projector?name={options.page}"
            ),
        )
        self._options = options
        self._desk = desk
        self._page: Page | None = None
        self._place: tuple[float, float, str] | None = None
        self._patterns: list[UInt8[np.ndarray, "h w"]] = []
        self._stop = threading.Event()
        self._join_s = _JOIN_S
        self._refresh_hz = options.refresh_hz or _ASSUMED_REFRESH_HZ
        self._remarks: tuple[str, ...] = ()
        self.settle_ms = options.settle_ms
        self.settle_exposure_ms: float | None = None
        if options.settle_ms is None and options.measured is not None:
            self._let_settle(options.measured)

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return ProjectorCapabilities(size=self._options.size, refresh_hz=self._refresh_hz)

    @property
    def state(self) -> LinkState:
        """Where it is in its life: lost as soon as its page is gone."""
        page = self._page
        is_gone = self._state is LinkState.READY and page is not None and page.gone
        return LinkState.LOST if is_gone else self._state  # whoever asks for a pattern is told why

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is doubtful about page and screen; empty: nothing."""
        return self._remarks

    @property
    def screen(self) -> str:
        """What changes when the window goes to another screen; empty before `open`."""
        return (
            ""
            if self._place is None
            else f"{self._place[2]} at {self._place[0]:g},{self._place[1]:g}"
        )

    def open(self) -> None:
        """Take the page that is open at the projector's address."""
        if self._state in (LinkState.READY, LinkState.ARMED):
            return
        self._stop.clear()
        other = self._desk.hold(self._options.page, self)
        if other is not None:
            raise DeviceBusy(
                self.name,
                f"projector page {self._options.page!r} shows the patterns of rig {other}; disconnect that rig, or give"
                " this one a page of its own (`page: NAME` in its file)",
            )
        try:
            self._take_page()
        except DeviceError:
            self.close()  # the page may have gone after it was taken
            raise

    def _take_page(self) -> None:
        page = self._desk.find(self._options.page, self._join_s)
        if page is None:
            raise DeviceNotFound(
                self.name,
                f"no projector page is open; open {self._info.address} full screen on the projector's monitor,"
                " or run `unglare projector`",
            )
        geometry = page.wait_for_geometry(_GEOMETRY_S)
        if geometry is None:
            raise DeviceTimeout(
                self.name, "the projector page doesn't say how large it is; reload it"
            )
        self._refuse_scaled(geometry)
        self._page, self._place = page, geometry.place
        self._state = LinkState.READY
        self._remarks = (*self._look_at_refresh(page), *self._look_at_latency())
        self._send_patterns()

    def _look_at_refresh(self, page: Page) -> Iterator[str]:
        """Take the screen's rate as the page measured it, unless the rig's file says one."""
        said_hz = self._options.refresh_hz
        found_hz = page.wait_for_refresh(_REFRESH_S if said_hz is None else 0.0)
        self._refresh_hz = said_hz or found_hz or _ASSUMED_REFRESH_HZ
        if found_hz is None and said_hz is None:
            yield (
                f"The projector page couldn't measure its screen's refresh rate, {_ASSUMED_REFRESH_HZ:g} Hz is assumed:"
                " reload it on the projector's monitor, or give refresh_hz in the rig's file."
            )
        elif found_hz is not None and abs(found_hz / self._refresh_hz - 1) > _ALIKE:
            yield (
                f"The projector page draws {found_hz:g} times a second, the rig's file says {said_hz:g} Hz: correct"
                " refresh_hz or leave it out, or exposures don't fit the screen's frames."
            )

    def _look_at_latency(self) -> Iterator[str]:
        """Use the measured latency on the screen and in the mode that it was measured in, and nowhere else."""
        known = self._options.measured
        if self._options.settle_ms is not None or known is None:
            return
        self.settle_ms = self.settle_exposure_ms = None
        if known.screen and known.screen != self.screen:
            what = f"on another screen ({known.screen}, now {self.screen})"
        elif known.refresh_hz and abs(known.refresh_hz / self._refresh_hz - 1) > _ALIKE:
            what = f"at {known.refresh_hz:g} Hz, now the screen has {self._refresh_hz:g} Hz"
        else:
            self._let_settle(known)
            return
        yield f"The projector's latency was measured {what}: measure it again (`unglare rigs latency`)."

    def _let_settle(self, known: MeasuredLatency) -> None:
        self.settle_ms, self.settle_exposure_ms = known.settle_ms, known.exposure_ms

    def close(self) -> None:
        """Let the page go; it stays open."""
        self._stop.set()
        self._page = None
        self._desk.let_go(self._options.page, self)
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Take the page again once it is back; patterns are loaded again."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self.close()
            self._join_s = min(_JOIN_S, max(0.0, deadline_s - time.monotonic()))
            try:
                self.open()
                return
            except (DeviceNotFound, DeviceTimeout, DeviceDisconnected) as error:
                if time.monotonic() > deadline_s:
                    raise self._lose_page(
                        f"the projector page didn't come back within {timeout_s:g} s"
                    ) from error
            finally:
                self._join_s = _JOIN_S

    def load(self, patterns: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        """Send patterns to the page, so that showing them needs no network."""
        self._need_link()
        refuse_other_sizes(self.name, patterns, self._options.size)
        self._patterns = [np.ascontiguousarray(pattern).copy() for pattern in patterns]
        self._send_patterns()

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        """Show a loaded pattern; returns after the page's acknowledgement and the settle time."""
        self._need_link()
        refuse_unloaded(self.name, index, len(self._patterns))
        return self._asked({"t": "show", "slot": index}, index, timeout_s)

    def blank(self, level: int = 0) -> Presented:
        """Show the whole field at one code."""
        self._need_link()
        refuse_level(self.name, level)
        width, height = self._options.size
        return self._asked({"t": "blank", "level": level, "w": width, "h": height}, -1, 2.0)

    def _send_patterns(self) -> None:
        page, (width, height) = self._connected(), self._options.size
        for slot, pattern in enumerate(self._patterns):
            page.send({"t": "load", "slot": slot, "w": width, "h": height}, pattern.tobytes())

    def _asked(self, message: dict[str, object], index: int, timeout_s: float) -> Presented:
        page = self._connected()
        reply = page.wait_for_reply(page.ask(message), timeout_s)
        if reply is None:
            raise self._silent(page, timeout_s)
        if reply.code:
            raise self._refused(reply.code)
        self._refuse_moved(page)
        self._stop.wait((self.settle_ms or 0.0) / 1000.0)
        return Presented(index, time.monotonic(), None, confirmed=self.settle_ms is not None)

    def _connected(self) -> Page:
        if self._page is None or self._page.gone:
            raise self._lose_page("the projector page was closed or reloaded")
        return self._page

    def _silent(self, page: Page, timeout_s: float) -> DeviceError:
        if page.gone:
            return self._lose_page("the projector page was closed or reloaded")
        if page.geometry is not None and not page.geometry.visible:
            return GeometryError(self.name, HIDDEN)
        return DeviceTimeout(
            self.name, f"the projector page didn't draw within {timeout_s:g} s; is it frozen?"
        )

    def _refused(self, code: str) -> DeviceError:
        if code == "no-slot":  # a page that was reloaded has forgotten its patterns
            return self._lose_page("the projector page has lost its patterns")
        return self._lose_page(f"the projector page failed ({code})")

    def _lose_page(self, why: str) -> DeviceDisconnected:
        return self._lose(why, cure="open it full screen again, then reconnect")

    def _refuse_moved(self, page: Page) -> None:
        geometry = page.geometry
        if geometry is None:
            return
        self._refuse_scaled(geometry)
        if geometry.place != self._place:
            self._state = LinkState.LOST
            raise self._told_page(
                GeometryError(
                    self.name,
                    f"the window moved to another place or screen ({_where(geometry)}); put it back and reconnect",
                )
            )

    def _refuse_scaled(self, geometry: Geometry) -> None:
        """Refuse unless every pattern pixel is one device pixel: within the rounding of a fractional ratio."""
        width, height = self._options.size
        slack = max(1, math.ceil(geometry.ratio))
        exact = 0 <= geometry.width_px - width < slack and 0 <= geometry.height_px - height < slack
        if not geometry.visible:
            problem = HIDDEN
        elif not exact:
            problem = (
                f"the page has {geometry.width_px}x{geometry.height_px} device pixels at ratio {geometry.ratio:g}, the"
                f" patterns {width}x{height}; press F11 for full screen on the projector's monitor, and let that monitor"
                f" run at {width}x{height} with a scale of 100 %"
            )
        elif geometry.scale != 1.0:
            problem = f"the page is zoomed to {100 * geometry.scale:.0f} % by two fingers; zoom back to 100 %, or reload it"
        else:
            return
        raise self._told_page(GeometryError(self.name, problem))

    def _told_page(self, error: GeometryError) -> GeometryError:
        """Let whoever stands at the projector read it, too."""
        page = self._page or self._desk.find(self._options.page)
        if page is not None:
            page.send({"t": "refuse", "text": error.sentence})
        return error


def _where(geometry: Geometry) -> str:
    screen = f", {geometry.screen}" if geometry.screen else ""
    return f"x {geometry.screen_x:g}, y {geometry.screen_y:g}{screen}"
