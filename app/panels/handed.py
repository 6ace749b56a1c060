"""Results that were handed to the scan, and keeping one for the rig."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from app import markup
from app.desk import Desk
from app.look import Look
from backend.contract.requests import GivenSource
from backend.contract.scans import CalibrationView, HandedView


class HandedPanel:
    """A line per result that the stage on the screen gets from outside, and one to keep its own."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk = desk
        self._lines = gui.add_html("", visible=False)

    def draw(self, look: Look) -> None:
        """Show this state."""
        lines = [
            self._handed(look, view) for view in look.scan.handed if look.stage.name in view.stages
        ]
        lines += self._keeping(look)
        self._lines.content = "".join(lines)
        self._lines.visible = bool(lines)

    def _handed(self, look: Look, view: HandedView) -> str:
        text = view.sentence or "none handed over"
        if view.sentence is not None and view.name == look.stage.name:
            text = "in place of this stage"  # whose sentence says where it comes from
        links = ""
        if look.may_operate:
            label = self._desk.clicks.label
            choose = partial(self._desk.choose_calibration, view.type)
            links = label(f"choose {view.type}", choose, "choose", "ug-link", "Take another one")
            if view.sentence is not None:
                away = partial(self._desk.take_away, view.type)
                links += label(f"take away {view.type}", away, "✕ remove", "ug-link", "Do without")
        return _line(view.title, text, links, known=view.sentence is not None)

    def _keeping(self, look: Look) -> list[str]:
        stage = look.stage
        if stage.kept is not None:
            return [
                _line(
                    "Kept for this rig",
                    f"calibration {stage.kept}, given to new scans",
                    "",
                    known=True,
                )
            ]
        if not (stage.can_keep and look.may_operate) or look.running:
            return []
        keep = self._desk.clicks.label(
            "keep", self._desk.keep, "☆ Keep for this rig", "ug-link", "Later scans with this rig get this result"
        )  # fmt: skip
        return [markup.div("ug-handed", keep)]


def ask_calibration(
    gui: viser.GuiApi,
    title: str,
    offered: Sequence[CalibrationView],
    on_choice: Callable[[GivenSource], None],
) -> None:
    """Ask for a calibration of the rig, or for a scan whose result is taken."""
    modal = gui.add_modal(f"Which {title.lower()}?")
    titles = {
        f"{c.number}: {c.scan_name or c.scan}, {c.who}, {c.when:%d %b %Y %H:%M}": c.number
        for c in offered
    }
    with modal:
        menu: Any = None
        if titles:
            menu = gui.add_dropdown("Calibration", tuple(titles))
            take = gui.add_button("Take it", color="blue")
            _on_click(take, modal, lambda: on_choice(GivenSource(calibration=titles[menu.value])))
        else:
            gui.add_html(markup.div("ug-text", "Nothing of this kind was kept for this rig."))
        scan = gui.add_text("Id of a scan", "", hint="Its result is taken, whatever its rig")
        other = gui.add_button("Take that scan's", color="gray")
        _on_click(other, modal, lambda: on_choice(GivenSource(scan=scan.value.strip())))


def _on_click(button: viser.GuiButtonHandle, modal: Any, work: Callable[[], None]) -> None:
    @button.on_click
    async def _(_: viser.GuiEvent[Any]) -> None:
        if not modal.closed:
            work()
            modal.close()


def _line(title: str, text: str, links: str, *, known: bool) -> str:
    css = "ug-handed ug-on" if known else "ug-handed"
    words = markup.span("ug-name", markup.esc(title)) + markup.span("ug-value", markup.esc(text))
    return markup.div(css, words + markup.span("ug-links", links), title=f"{title}: {text}")
