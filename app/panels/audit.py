"""The log: who did what, when and why. It only grows."""

from datetime import UTC, datetime
from typing import Any

import viser

from app import markup
from app.numbers import moment
from app.palette import STATES
from backend.contract.scans import AuditEntry, ScanState

_TONES = {
    "accepted": "accepted", "rejected": "rejected", "failed": "failed", "cancelled": "rejected", "edited": "awaiting_review",
    "undone": "awaiting_review", "redone": "awaiting_review", "finished": "done", "run": "running", "created": "given",
    "unverified": "failed",
}  # fmt: skip
_MOST = 200


class AuditPanel:
    """The audit trail, newest first, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._list = gui.add_html("")

    def draw(self, scan: ScanState, entries: tuple[AuditEntry, ...]) -> None:
        """Show these entries."""
        titles = {s.name: s.title for s in scan.stages}
        now = datetime.now(UTC)
        lines = [_line(e, titles, now) for e in sorted(entries, key=lambda e: -e.sequence)[:_MOST]]
        self._list.content = markup.div("ug-log", "".join(lines))


def _line(entry: AuditEntry, titles: dict[str, str], now: datetime) -> str:
    colour = STATES[_TONES.get(entry.action, "pending")][0]
    stage = titles.get(entry.stage or "", entry.stage or "")
    head = " · ".join(t for t in (moment(entry.when, now), entry.who, stage) if t)
    reason = _reason(entry.details)
    body = markup.div("ug-log-head", markup.esc(head)) + markup.div(
        "ug-log-text", markup.esc(entry.sentence)
    )
    body += markup.div("ug-log-reason", f"“{markup.esc(reason)}”") if reason else ""
    return f'<div class="ug-log-line" style="--c:{colour}">{body}</div>'


def _reason(details: dict[str, Any]) -> str:
    reason = details.get("reason")
    return str(reason) if reason else ""
