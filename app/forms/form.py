"""Controls for settings. They only collect: nothing is sent before the operator applies."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import viser

from app import markup
from app.forms.schema import Setting, UnreadableError, read, write
from app.numbers import quantity
from backend.contract.scans import SettingView

_DECIMALS = 7

OnEdit = Callable[[str, Any], None]
"""Called with the setting's name and the new value."""
OnError = Callable[[str, str | None], None]
"""Called with the setting's name and what is wrong with the text; None: nothing any more."""
ResetLink = Callable[[str], str]
"""Returns clickable HTML that resets a setting."""


@dataclass
class _Row:
    setting: Setting
    mark: viser.GuiHtmlHandle
    control: Any
    note: viser.GuiHtmlHandle
    view: SettingView
    error: str | None = None
    typed: list[Any] = field(default_factory=list)
    """Values typed since the last one that was applied."""


class Form:
    """One control per setting, in the container that is open when it is made.

    Parameters
    ----------
    gui
        Where controls are added.
    settings
        From `read_schema`.
    on_edit, on_error
        Told of each change, on viser's event loop: hand it on.
    reset_link
        Makes the link that puts a setting back; None leaves it out.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        settings: tuple[Setting, ...],
        *,
        on_edit: OnEdit,
        on_error: OnError,
        reset_link: ResetLink | None = None,
    ) -> None:
        self._gui, self._on_edit, self._on_error = gui, on_edit, on_error
        self._reset_link = reset_link
        self._showing = False
        self._rows = {s.name: self._row(s) for s in settings if not s.advanced}
        advanced = [s for s in settings if s.advanced]
        if advanced:
            with gui.add_folder("More settings", expand_by_default=False):
                self._rows |= {s.name: self._row(s) for s in advanced}

    def show(self, views: Mapping[str, SettingView], draft: Mapping[str, Any]) -> None:
        """Show present values, or what is typed but not applied yet."""
        for name, row in self._rows.items():
            if name in views:
                row.view = views[name]
            value = draft.get(name, row.view.value)
            if name not in draft:
                row.typed.clear()
            # What was typed here stands here already; writing it back would get between two keystrokes.
            if row.error is None and value not in row.typed:
                self._put(row, value)
            self._explain(row, drafted=name in draft)

    def values(self) -> dict[str, Any]:
        """Return what the controls show just now.

        Raises
        ------
        UnreadableError
            If a text is no value of its setting.
        """
        return {name: self._value(row) for name, row in self._rows.items()}

    def _row(self, setting: Setting) -> _Row:
        mark = self._gui.add_html(markup.marker("ug-setting"))
        control = self._control(setting)
        if setting.examples:
            words = markup.esc(", ".join(setting.examples))
            self._gui.add_html(markup.div("ug-setting-note ug-examples", f"e.g. {words}"))
        note = self._gui.add_html("", visible=False)
        row = _Row(
            setting, mark, control, note, SettingView(value=setting.default, source="default")
        )

        async def changed(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:  # an assignment of ours calls this as well
                self._edited(row)

        control.on_update(changed)
        return row

    def _control(self, setting: Setting) -> Any:
        hint = " · ".join(t for t in (setting.doc, setting.limits) if t) or None
        label, default = setting.label, setting.default
        if setting.kind == "switch" and not setting.optional:
            return self._gui.add_checkbox(label, bool(default), hint=hint)
        if setting.kind in ("choice", "switch"):
            return self._gui.add_dropdown(label, _texts(setting), hint=hint)
        if setting.typed:
            return self._gui.add_text(label, write(setting, default), hint=hint)
        whole = setting.kind == "integer"
        start = default if isinstance(default, (int, float)) else setting.low or 0
        control = self._gui.add_number(
            label,
            int(start) if whole else float(start),
            min=_bound(setting.low, whole=whole),
            max=_bound(setting.high, whole=whole),
            step=1 if whole else _arrow_step(float(start)),
            hint=hint,
        )
        # viser takes the decimals that may be typed from what stands there at first.
        control.precision = 0 if whole else _DECIMALS
        return control

    def _edited(self, row: _Row) -> None:
        try:
            value = self._value(row)
        except UnreadableError as error:
            row.error = str(error)
        else:
            row.error = None
            row.typed.append(value)
            self._on_edit(row.setting.name, value)
        self._on_error(row.setting.name, row.error)

    def _value(self, row: _Row) -> Any:
        setting, shown = row.setting, row.control.value
        if setting.kind == "switch" and not setting.optional:
            return bool(shown)
        if setting.kind in ("choice", "switch"):
            return dict(zip(_texts(setting), _values(setting), strict=True))[shown]
        if setting.typed:
            present = row.view.value
            if present is not None and shown == write(setting, present, row.view.chosen):
                # It has more digits than its text.
                return list(present) if isinstance(present, tuple) else present
            return read(setting, shown, row.view.chosen)
        return int(shown) if setting.kind == "integer" else float(shown)

    def _put(self, row: _Row, value: Any) -> None:
        setting = row.setting
        if setting.kind == "switch" and not setting.optional:
            row.control.value = bool(value)
        elif setting.kind in ("choice", "switch"):
            by_value = {str(v): t for t, v in zip(_texts(setting), _values(setting), strict=True)}
            row.control.value = by_value.get(str(value), row.control.value)
        elif setting.typed:
            # A text that already says the same stays as it was typed.
            if not self._says(row, value):
                row.control.value = write(setting, value, row.view.chosen)
        elif isinstance(value, (int, float)):
            row.control.value = value

    def _says(self, row: _Row, value: Any) -> bool:
        if value is None and row.control.value != write(row.setting, None, row.view.chosen):
            return False
        try:
            return bool(read(row.setting, row.control.value, row.view.chosen) == value)
        except UnreadableError:
            return False

    def _explain(self, row: _Row, *, drafted: bool) -> None:
        name, view = row.setting.name, row.view
        css, text = "ug-setting", ""
        if row.error is not None:
            css, text = "ug-setting ug-wrong", markup.span("ug-failure", markup.esc(row.error))
        elif drafted:
            was = "auto" if view.value is None else quantity(view.value, row.setting.unit)
            css, text = "ug-setting ug-drafted", f"changed, not applied · was {markup.esc(was)}"
        elif view.source == "edited":
            css, text = "ug-setting ug-edited", "edited"
        elif view.source in ("preset", "recipe"):
            css, text = "ug-setting", f"from the {markup.esc(view.source)}"
        if view.source == "edited" and self._reset_link is not None:
            text += " · " + self._reset_link(name)
        row.mark.content = markup.marker(css)
        row.note.content = markup.div("ug-setting-note", text)
        row.note.visible = bool(text)


def _texts(setting: Setting) -> list[str]:
    return ["auto" if v is None else _word(v) for v in _values(setting)]


def _word(value: Any) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _values(setting: Setting) -> list[Any]:
    choices: list[Any] = list(setting.choices) or [True, False]
    return [None, *choices] if setting.optional else choices


def _arrow_step(value: float) -> float:
    """Return what one click on an arrow adds: a tenth of the value's first digit."""
    return float(10.0 ** (math.floor(math.log10(abs(value))) - 1)) if value else 0.1


def _bound(limit: float | None, *, whole: bool) -> float | int | None:
    if limit is None:
        return None
    return round(limit) if whole else limit
