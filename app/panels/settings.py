"""The settings of the stage on the screen, made from its JSON schema."""

from typing import Any

import viser

from app.desk import Desk
from app.forms.form import Form
from app.forms.schema import read_schema
from app.look import Look


class SettingsPanel:
    """A folder with one control per setting and the words for the log; only for operators."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._gui, self._desk = gui, desk
        self._place = gui.add_folder(None)
        self._folder: viser.GuiFolderHandle | None = None
        self._form: Form | None = None
        self._made_for: tuple[Any, ...] = ()

    def draw(self, look: Look) -> None:
        """Show the present values; controls are made anew only for another stage."""
        made_for = (look.scan.id, look.stage.name)
        if made_for != self._made_for:
            self._made_for = made_for
            self._make(look)
        if self._form is not None:
            self._form.show(look.stage.settings, look.draft)

    def _make(self, look: Look) -> None:
        old, self._folder, self._form = self._folder, None, None
        self._desk.forget_draft_errors()
        settings = read_schema(look.description.settings) if look.description else ()
        if settings:
            with self._place:
                self._folder = self._gui.add_folder("Settings")
            with self._folder:
                self._form = Form(
                    self._gui, settings,
                    on_edit=self._desk.set_draft, on_error=self._desk.set_draft_error, reset_link=self._reset_link,
                )  # fmt: skip
                self._add_reason()
        if old is not None:
            old.remove()

    def _add_reason(self) -> None:
        reason = self._gui.add_text("Reason, for the log", "")

        @reason.on_update
        async def _(_: viser.GuiEvent[Any]) -> None:
            self._desk.set_reason(reason.value)

    def _reset_link(self, name: str) -> str:
        return self._desk.clicks.label(
            f"reset {name}",
            lambda: self._desk.reset(name),
            "↺ reset",
            "ug-link",
            "Back to the automatic or default value",
        )
