"""The list of scans, with search and pages."""

from datetime import UTC, datetime
from typing import Any

import viser

from app import markup
from app.desk import Desk
from app.numbers import moment, number
from app.palette import STATES
from backend.contract.scans import ScanSummary

_PAGE = 8


class ScanListPanel:
    """A page of scans, newest first, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk = desk
        self._offset = 0
        self._titles: dict[str, str] = {}
        gui.add_html(markup.marker("ug-wide"))
        self._text = gui.add_text("Search", "")
        self._list = gui.add_html("")
        if not desk.who.may_operate:
            self._text.visible = False

        @self._text.on_update
        async def _(_: viser.GuiEvent[Any]) -> None:
            self._offset = 0
            self.refresh()

    def name_methods(self, titles: dict[str, str]) -> None:
        """Learn what methods are called."""
        self._titles = titles

    def refresh(self) -> None:
        """Fetch the page again."""
        self._desk.load(self._fetch, key="scan list")

    def _fetch(self) -> None:
        text = self._text.value.strip()
        scans = self._desk.api.scans(limit=_PAGE + 1, offset=self._offset, text=text)
        if not scans and self._offset:
            self._offset = max(0, self._offset - _PAGE)
            return self._fetch()
        self._list.content = self._html(scans, text)
        return None

    def _html(self, scans: tuple[ScanSummary, ...], text: str) -> str:
        if not scans:
            words = (
                f"No scan matches “{markup.esc(text)}”."
                if text
                else "No scan yet. Make the first one on the right."
            )
            return markup.div("ug-empty", words)
        now = datetime.now(UTC)
        rows = "".join(self._row(scan, now) for scan in scans[:_PAGE])
        return markup.div("ug-scans", rows) + self._pager(more=len(scans) > _PAGE)

    def _row(self, scan: ScanSummary, now: datetime) -> str:
        colour, words = STATES.get(scan.status, STATES["pending"])
        state = f'<span class="ug-state" style="--c:{colour}">{markup.esc(words)}</span>'
        head = markup.div(
            "ug-scan-head",
            markup.span("ug-name", markup.esc(scan.name or f"Scan {scan.id}")) + state,
        )
        points = (
            f"{number(scan.points)} points"
            if scan.points
            else f"stage {scan.stages_done} of {scan.stages}"
        )
        method = self._titles.get(scan.method, scan.method)
        facts = " · ".join((moment(scan.created, now), scan.who, points))
        dots = "".join(
            f'<i class="{"ug-on" if i < scan.stages_done else ""}"></i>' for i in range(scan.stages)
        )
        inner = head + markup.div("ug-scan-facts", markup.esc(facts)) + markup.div(
            "ug-scan-facts", markup.span("", markup.esc(" · ".join(t for t in (method, scan.rig) if t))) + f'<span class="ug-dots" style="--c:{colour}">{dots}</span>'
        )  # fmt: skip
        if not self._desk.who.may_operate:
            return markup.div("ug-scan", inner)
        return self._desk.clicks.label(
            f"open {scan.id}",
            lambda: self._desk.open_scan(scan.id),
            inner,
            "ug-scan",
            f"Open scan {scan.id}",
        )

    def _pager(self, *, more: bool) -> str:
        links = []
        if self._offset:
            links.append(
                self._desk.clicks.label(
                    "newer scans", lambda: self._turn(-_PAGE), "‹ newer", "ug-link"
                )
            )
        if more:
            links.append(
                self._desk.clicks.label(
                    "older scans", lambda: self._turn(_PAGE), "older ›", "ug-link"
                )
            )
        return markup.div("ug-pager", "".join(links)) if self._desk.who.may_operate else ""

    def _turn(self, by: int) -> None:
        self._offset = max(0, self._offset + by)
        self.refresh()
