"""Work at a rig: its check, and the latency calibration of its projector with its curve."""

from typing import Any

import viser

from app import markup
from app.desk import Desk
from app.panels.rig_devices import Page
from app.views.settling import SettlingChart
from backend.contract.rigs import RigLink, RigState, RigWork, StartLatency, WorkStatus


class RigWorkPanel:
    """Buttons, progress and results, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, page: Page) -> None:
        self._desk, self._page = desk, page
        self._asked_for: tuple[Any, ...] = ()
        self._buttons: list[viser.GuiButtonHandle] = []
        if desk.who.may_operate:
            self._add_buttons(gui)
        self._progress = gui.add_html("")
        self._chart = SettlingChart(gui)

    def show(self, state: RigState) -> None:
        """Show what runs, or what came of it."""
        runs = state.work is not None and state.work.status is WorkStatus.RUNNING
        for button in self._buttons:
            button.disabled = runs or state.owner is not None or state.link is not RigLink.OPEN
        content = self._work_html(state.work) if state.work else ""
        if self._progress.content != content:
            self._progress.content = content
        asked_for = (state.name, state.work.status if state.work else None, state.settle_measured)
        if asked_for != self._asked_for:
            self._asked_for = asked_for
            name = state.name
            self._desk.load(lambda: self._chart.show(self._desk.api.latency(name)), key="latency")

    def _add_buttons(self, gui: viser.GuiApi) -> None:
        gui.add_html(markup.marker("ug-row2"))
        check = gui.add_button(
            "Check", color="gray", icon=viser.Icon.CHECKLIST, hint="A white and a black frame of each camera, and what looks wrong"
        )  # fmt: skip
        latency = gui.add_button(
            "Latency", color="gray", icon=viser.Icon.HOURGLASS, hint="Measure how long after its acknowledgement the projector shows a pattern"
        )  # fmt: skip
        self._buttons = [check, latency]
        api = self._desk.api

        @check.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            if (rig := self._page.rig) is not None:
                self._page.do(lambda: api.check_rig(rig))

        @latency.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            if (rig := self._page.rig) is not None:
                self._page.do(lambda: api.start_latency(rig, StartLatency()))

    def _work_html(self, work: RigWork) -> str:
        title = work.kind[:1].upper() + work.kind[1:]
        if work.status is WorkStatus.RUNNING:
            return markup.div("ug-work", self._running(title, work))
        if work.status is WorkStatus.FAILED:
            return markup.div("ug-why", markup.esc(f"{title}: {work.error}"))
        if work.status is WorkStatus.CANCELLED:
            return markup.div("ug-text ug-doc", markup.esc(f"{title}: cancelled."))
        return check_html(work) if work.lines else ""

    def _running(self, title: str, work: RigWork) -> str:
        percent = round(100 * work.progress)
        cancel = ""
        if self._desk.who.may_operate:
            cancel = self._desk.clicks.label(
                "cancel work", self._cancel, "cancel", "ug-link", f"End the {work.kind}"
            )
        head = markup.div("ug-live-head", markup.span("ug-name", markup.esc(title)) + cancel)
        bar = f'<div class="ug-progress"><div style="width:{percent}%"></div></div>'
        ends = markup.div(
            "ug-ends", markup.span("", markup.esc(work.text)) + markup.span("", f"{percent} %")
        )
        return head + bar + ends

    def _cancel(self) -> None:
        if (rig := self._page.rig) is not None:
            self._page.do(lambda: self._desk.api.cancel_work(rig))


def check_html(work: RigWork) -> str:
    """Say what a check found."""
    findings = "".join(_finding("warning", "!", text) for text in work.problems)
    if not work.problems:
        findings = _finding("ok", "✓", "The check found nothing wrong.")
    lines = "".join(markup.div("ug-note", markup.esc(line)) for line in work.lines)
    return markup.div("ug-findings", findings + lines)


def _finding(level: str, sign: str, text: str) -> str:
    colour = "#3fae6a" if level == "ok" else "#e8a33d"
    mark = f'<i style="--c:{colour}">{sign}</i>'
    return markup.div(
        f"ug-finding ug-is-{level}", mark + markup.span("ug-sentence", markup.esc(text))
    )
