"""Head of the right panel: which scan, where in it, what it says, and the decision."""

from datetime import UTC, datetime
from typing import Any

import viser

from app import markup
from app.clicks import Clicks
from app.desk import Desk
from app.look import Look
from app.numbers import duration, moment
from app.palette import STATES
from app.panels.decision import Buttons, Small, buttons
from backend.contract.scans import StageState

_SYMBOLS = {
    "done": "✓",
    "accepted": "✓",
    "failed": "✕",
    "rejected": "✕",
    "awaiting_review": "!",
    "given": "↧",
}
_MOST_IN_A_ROW = 7
_AMBER = (232, 163, 61)


class StagePanel:
    """Stepper, sentence, progress and buttons, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk = desk
        self._head = gui.add_html("")
        self._stepper = gui.add_html("")
        self._status = gui.add_html("")
        self._buttons = _ButtonRow(gui, desk) if desk.who.may_operate else None

    def draw(self, look: Look) -> None:
        """Show this state."""
        clicks = self._desk.clicks if look.may_operate else None
        self._head.content = head_html(look, self._desk, clicks)
        self._stepper.content = stepper_html(look, clicks, self._desk)
        self._status.content = status_html(look)
        if self._buttons is not None:
            self._buttons.draw(buttons(look))

    def progress(self, look: Look) -> None:
        """Show how far the job is; cheaper than `draw`."""
        self._status.content = status_html(look)


class _ButtonRow:
    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk = desk
        self._gui = gui
        gui.add_html(markup.marker("ug-primary"))
        self.primary = gui.add_button("Accept", color="green", icon=viser.Icon.CHECK)
        gui.add_html(markup.marker("ug-row3"))
        self.override = gui.add_button("Override", icon=viser.Icon.PENCIL)
        self.redo = gui.add_button("Redo", color="gray", icon=viser.Icon.REFRESH)
        self.stop = gui.add_button("Reject", color="gray", icon=viser.Icon.X)
        for button, work in (
            (self.primary, desk.do_primary), (self.override, desk.apply), (self.redo, desk.redo), (self.stop, desk.stop),
        ):  # fmt: skip
            _on_click(button, work)

    def draw(self, shown: Buttons) -> None:
        primary = shown.primary
        self.primary.label = primary.label
        self.primary.disabled = not primary.enabled
        self.primary.color = primary.colour
        icon = {
            "accept": viser.Icon.CHECK,
            "run": viser.Icon.PLAYER_PLAY,
            "export": viser.Icon.DOWNLOAD,
        }
        self.primary.icon = icon.get(primary.do)
        _show(self.override, shown.override, _AMBER if shown.override.enabled else "gray")
        _show(self.redo, shown.redo, "gray")
        _show(self.stop, shown.stop, "red" if shown.stop_cancels else "gray")
        self.stop.icon = viser.Icon.PLAYER_STOP if shown.stop_cancels else viser.Icon.X


def _show(button: viser.GuiButtonHandle, shown: Small, colour: Any) -> None:
    button.label, button.disabled, button.color, button.hint = (
        shown.label,
        not shown.enabled,
        colour,
        shown.hint,
    )


def _on_click(button: viser.GuiButtonHandle, work: Any) -> None:
    @button.on_click
    async def _(_: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        work()


def head_html(look: Look, desk: Desk, clicks: Clicks | None) -> str:
    """Return the scan's name with the way back and what can be done to the scan as a whole."""
    scan = look.scan
    colour, words = STATES.get(scan.status, STATES["pending"])
    title = scan.name or f"Scan {scan.id}"
    hint = "\n".join(t for t in (title, scan.note, f"Scan {scan.id}") if t)
    name = markup.div("ug-title", markup.esc(title), title=hint)
    method = look.method.title if look.method else scan.method
    made = f"{scan.who}, {moment(scan.created, datetime.now(UTC))}"
    facts = " · ".join(t for t in (method, scan.rig, made) if t)
    below = markup.div("ug-subtitle", markup.esc(facts), title=facts)
    state = f'<span class="ug-state" style="--c:{colour}">{markup.esc(words)}</span>'
    if clicks is None:
        return markup.div("ug-head", markup.div("ug-names", name + below) + state)
    back = clicks.label("home", desk.go_home, "‹", "ug-back", "All scans")
    undo = f"Undo: {scan.undo}" if scan.undo else "Nothing to undo"
    tools = [
        clicks.label(
            "undo", desk.undo, "↶ Undo", "ug-tool" if scan.undo else "ug-tool ug-off", undo
        ),
        clicks.label(
            "export",
            desk.export,
            "⤓ Export",
            "ug-tool",
            "Write the results to a folder, or download the cloud",
        ),
    ]
    if scan.rig:
        tools.append(
            clicks.label(
                "rig",
                lambda: desk.open_rig(scan.rig, dict(scan.rig_options)),
                "◉ Rig",
                "ug-tool",
                "Live pictures, light, focus, latency of its rig (key L)",
            )
        )
    if look.captures:
        tools.insert(
            1,
            clicks.label(
                "part-moved", desk.part_moved, "⟳ Part moved", "ug-tool", "Take all pictures again"
            ),
        )
    head = markup.div("ug-head", back + markup.div("ug-names", name + below) + state)
    return head + markup.div("ug-tools", "".join(tools))


def stepper_html(look: Look, clicks: Clicks | None, desk: Desk) -> str:
    """Return one step per stage, in the colour of its state; a click looks at it."""
    count = len(look.scan.stages)
    per_row = count if count <= _MOST_IN_A_ROW else -(-count // 2)
    cells = []
    for i, stage in enumerate(look.scan.stages):
        colour, words = STATES.get(stage.status, STATES["pending"])
        symbol = _SYMBOLS.get(stage.status, str(i + 1))
        inner = f'<i style="--c:{colour}">{symbol}</i>' + markup.span("", markup.esc(stage.title))
        css = f"ug-step ug-is-{stage.status}"
        css += " ug-selected" if stage.name == look.stage.name else ""
        css += " ug-first" if i % per_row == 0 else ""
        title = f"{i + 1} {stage.title}: {words}. {stage.message}"
        if clicks is None:
            cells.append(markup.div(css, inner, title=title))
        else:
            cells.append(
                clicks.label(f"stage {stage.name}", _selecting(desk, stage.name), inner, css, title)
            )
    return f'<div class="ug-stepper" style="--n:{per_row}">{"".join(cells)}</div>'


def _selecting(desk: Desk, stage: str) -> Any:
    return lambda: desk.select(stage)


def status_html(look: Look) -> str:
    """Return the sentence of the stage on the screen, and the progress if it runs."""
    stage = look.stage
    colour, words = STATES.get(stage.status, STATES["pending"])
    number = [s.name for s in look.scan.stages].index(stage.name) + 1
    title = markup.div(
        "ug-status-head",
        markup.span("ug-status-title", f"{number} {markup.esc(stage.title)}")
        + f'<span class="ug-state" style="--c:{colour}">{markup.esc(words)}</span>',
    )
    description = look.description
    doc = (
        markup.div("ug-doc", markup.esc(description.doc.split("\n")[0]))
        if description and description.doc
        else ""
    )
    inner = (
        title
        + markup.div("ug-sentence", markup.esc(_sentence(look, stage)))
        + ("" if stage.stage_run else doc)
    )
    return f'<div class="ug-status" style="--c:{colour}">{inner}{_progress(look, stage)}</div>'


def _sentence(look: Look, stage: StageState) -> str:
    job = look.scan.job
    if stage.status == "running" and job is not None:
        return job.text or "Running"
    reason = stage.decision.reason if stage.decision is not None else ""
    if reason and reason not in stage.message:
        return f"{stage.message} “{reason}”"
    return stage.message


def _progress(look: Look, stage: StageState) -> str:
    job = look.scan.job
    if stage.status != "running" or job is None:
        return ""
    percent = round(100 * min(max(job.progress, 0.0), 1.0))
    left = f"{duration(job.remaining_s)} left" if job.remaining_s is not None else ""
    bar = f'<div class="ug-progress"><div style="width:{percent}%"></div></div>'
    return bar + markup.div(
        "ug-ends", markup.span("", f"{percent} %") + markup.span("", markup.esc(left))
    )
