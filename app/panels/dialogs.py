"""Questions that need an answer before anything happens."""

from collections.abc import Callable
from typing import Any

import viser

from app import markup
from app.client import cloud_address
from app.desk import Desk


def ask_part_moved(gui: viser.GuiApi, on_yes: Callable[[str], None]) -> None:
    """Ask whether to take all pictures again; called with the reason for the log."""
    modal = gui.add_modal("Part moved: take all pictures again?")
    with modal:
        gui.add_html(
            markup.div(
                "ug-text",
                "Every stage that captures gets a new take. What was captured stays, and undo brings it back.",
            )
        )
        reason = gui.add_text("Reason, for the log", "part moved")
        _answers(gui, modal, "Take all again", lambda: on_yes(reason.value))


def ask_export(
    gui: viser.GuiApi, desk: Desk, scan_id: str, on_yes: Callable[[str, bool], None]
) -> None:
    """Ask where to write the results; offers the cloud as a download as well."""
    modal = gui.add_modal("Export")
    with modal:
        link = markup.tag(
            "a",
            "ug-download",
            "⤓ Download the cloud (PLY)",
            href=cloud_address(scan_id),
            download=f"{scan_id}.ply",
        )
        gui.add_html(markup.div("ug-text", link))
        gui.add_html(
            markup.div(
                "ug-text",
                "Or write cloud, maps, settings, decisions and hashes into a folder of the server:",
            )
        )
        folder = gui.add_text("Folder", f"exports/{scan_id}")
        frames = gui.add_checkbox(
            "Captured frames as well",
            False,
            hint="In the import format: the scan can be computed again from them",
        )
        _answers(gui, modal, "Write", lambda: on_yes(folder.value.strip(), frames.value))


def _answers(gui: viser.GuiApi, modal: Any, yes: str, on_yes: Callable[[], None]) -> None:
    gui.add_html(markup.marker("ug-row2"))
    go = gui.add_button(yes, color="blue")
    leave = gui.add_button("Cancel", color="gray")

    @go.on_click
    async def _(_: viser.GuiEvent[Any]) -> None:
        if not modal.closed:
            on_yes()
            modal.close()

    @leave.on_click
    async def _(_: viser.GuiEvent[Any]) -> None:
        if not modal.closed:
            modal.close()
