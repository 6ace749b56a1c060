"""Making a scan: method, rig and its options, preset, name; or importing a captured folder."""

from datetime import datetime
from typing import Any

import viser

from app import markup
from app.client import UPLOAD_PAGE
from app.desk import Desk
from app.forms.form import Form
from app.forms.schema import Setting, UnreadableError, read_schema
from backend.contract.descriptions import MethodDescription
from backend.contract.requests import CreateScan, ImportCapture
from backend.contract.rigs import RigOffer

_NO_PRESET = "none"
_FREE = Setting(
    "options",
    "Options",
    "document",
    "What this rig takes, as JSON; it doesn't say what.",
    default={},
)


class NewScanPanel:
    """The start page's forms, in the container that is open when it is made; only for operators."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._gui, self._desk = gui, desk
        self._methods: dict[str, MethodDescription] = {}
        self._rigs: dict[str, RigOffer] = {}
        self._options: Form | None = None
        self._options_folder: viser.GuiFolderHandle | None = None
        self._errors: dict[str, str] = {}
        self._defaults: dict[str, Any] = {}
        self._made_for = ""
        gui.add_html(markup.div("ug-heading", "New scan"))
        self._method = gui.add_dropdown("Method", ["–"])
        self._doc = gui.add_html("")
        self._rig = gui.add_dropdown("Rig", ["–"])
        self._problem = gui.add_html("", visible=False)
        self._set_up = gui.add_html("")
        self._preset: Any = gui.add_dropdown("Preset", [_NO_PRESET], visible=False)
        self._name: Any = gui.add_text("Name", "")
        self._note: Any = gui.add_text("Note", "")
        self._options_place = gui.add_folder(None)
        gui.add_html(markup.marker("ug-primary"))
        self._create = gui.add_button("Create and run", color="green", icon=viser.Icon.PLAYER_PLAY)
        self._prepare = gui.add_button("Create without running", color="gray", icon=viser.Icon.PLUS)
        self._add_import()
        self._listen()

    def fill(self, methods: tuple[MethodDescription, ...], rigs: tuple[RigOffer, ...]) -> None:
        """Learn what there is to choose from."""
        # Methods that can take pictures come first: the others only work on imported ones.
        ordered = sorted(methods, key=lambda m: not any(s.captures for s in m.stages))
        self._methods = {_unique(m.title, m.name, [n.title for n in methods]): m for m in ordered}
        self._rigs = {_unique(r.title, r.name, [n.title for n in rigs]): r for r in rigs}
        _set_options(self._method, list(self._methods) or ["–"])
        _set_options(self._rig, list(self._rigs) or ["–"])
        self._show_method()
        self._show_rig()

    def options(self) -> dict[str, Any]:
        """Return the rig's options that differ from their defaults.

        Raises
        ------
        UnreadableError
            If a text is no value of its option.
        """
        values = self._options.values() if self._options else {}
        if set(values) == {_FREE.name}:
            return dict(values[_FREE.name])
        return {n: v for n, v in values.items() if v != self._defaults.get(n)}

    def _listen(self) -> None:
        @self._method.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._desk.act(self._show_method)

        @self._rig.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._desk.act(self._show_rig)

        @self._create.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            self._desk.act(lambda: self._make(run=True))

        @self._prepare.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            self._desk.act(lambda: self._make(run=False))

    def _show_method(self) -> None:
        method = self._methods.get(self._method.value)
        self._doc.content = (
            markup.div("ug-text ug-doc", markup.esc(method.doc.split("\n")[0])) if method else ""
        )
        presets = list(method.presets) if method else []
        _set_options(self._preset, [_NO_PRESET, *presets])
        self._preset.visible = bool(presets)
        if method is not None:
            self._choose_rig(method.name)

    def _choose_rig(self, method: str) -> None:
        """Leave a rig that isn't made for the method for one that is."""
        fits = [title for title, rig in self._rigs.items() if _suits(rig, method)]
        if fits and self._rig.value not in fits:
            menu: Any = self._rig
            menu.value = fits[0]
            self._show_rig()

    def _show_rig(self) -> None:
        rig = self._rigs.get(self._rig.value)
        error = rig.error if rig else None
        self._problem.content = markup.div("ug-why", markup.esc(error)) if error else ""
        self._problem.visible = bool(error)
        self._create.disabled = self._prepare.disabled = bool(error)
        self._set_up.content = self._set_up_link() if rig else ""
        if rig is None or rig.name == self._made_for:
            return
        self._made_for = rig.name
        if self._options_folder is not None:
            self._options_folder.remove()
        self._options, self._options_folder, self._errors = None, None, {}
        settings = read_schema(rig.options_schema) or (_FREE,)
        self._defaults = {s.name: _as_list(s.default) for s in settings}
        with self._options_place:
            self._options_folder = self._gui.add_folder("Rig options")
        with self._options_folder:
            self._options = Form(
                self._gui, settings, on_edit=lambda *_: None, on_error=self._remember
            )
        self._desk.show_rig()

    def chosen_rig(self) -> tuple[str, dict[str, Any]] | None:
        """Return the rig and its options, None if it can't be used as it stands."""
        rig = self._rigs.get(self._rig.value)
        if rig is None or rig.error:
            return None
        try:
            return rig.name, self.options()
        except UnreadableError:
            return None

    def options_of(self, rig: str) -> dict[str, Any] | None:
        """Return the options chosen for a rig; None if another one is chosen."""
        chosen = self.chosen_rig()
        return chosen[1] if chosen is not None and chosen[0] == rig else None

    def _set_up_link(self) -> str:
        words = "set up this rig: live pictures, light, focus, latency ›"
        link = self._desk.clicks.label(
            "set up rig",
            self._open_rig,
            words,
            "ug-link ug-set-up",
            "The rig without a scan (key L)",
        )
        return markup.div("ug-text", link)

    def _open_rig(self) -> None:
        rig = self._rigs.get(self._rig.value)
        if rig is not None:
            self._desk.open_rig(rig.name, None)

    def _remember(self, name: str, error: str | None) -> None:
        self._errors = {k: v for k, v in self._errors.items() if k != name} | (
            {name: error} if error else {}
        )

    def _make(self, *, run: bool) -> None:
        method, rig = self._methods.get(self._method.value), self._rigs.get(self._rig.value)
        if method is None or rig is None:
            return
        if self._errors:
            self._desk.notify("Rig options", next(iter(self._errors.values())), colour="red")
            return
        preset = self._preset.value
        request = CreateScan(
            method=method.name, rig=rig.name, rig_options=self.options(), name=self._name.value.strip() or _name_of_now(), note=self._note.value.strip(),
            preset=None if preset == _NO_PRESET else preset,
        )  # fmt: skip
        self._desk.create(request, run=run)
        self._name.value = self._note.value = ""

    def _add_import(self) -> None:
        with self._gui.add_folder("Import a capture", expand_by_default=False):
            path = self._gui.add_text(
                "File", "", hint="Path of a capture.json that the server can read"
            )
            name = self._gui.add_text("Name", "")
            button = self._gui.add_button("Import", color="gray", icon=viser.Icon.FOLDER_OPEN)
            self._gui.add_html(markup.div("ug-text", _upload_link()))

        @button.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            request = ImportCapture(path=path.value.strip(), name=name.value.strip())
            self._desk.act(lambda: self._desk.import_capture(request))


def _upload_link() -> str:
    words = "or upload a zip file from this computer …"
    return markup.tag("a", "ug-link ug-upload", words, href=UPLOAD_PAGE, target="_blank")


def _name_of_now() -> str:
    now = datetime.now().astimezone()
    return f"Scan {now.day} {now:%b, %H:%M}"


def _as_list(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _unique(title: str, name: str, titles: list[str]) -> str:
    return title if titles.count(title) == 1 else f"{title} ({name})"


def _suits(rig: RigOffer, method: str) -> bool:
    """Tell whether a rig says that it is made for a method, or says nothing."""
    made_for, not_for = (rig.options_schema.get(k, ()) for k in ("methods", "not_for_methods"))
    return (not made_for or method in made_for) and method not in not_for


def _set_options(menu: Any, options: list[str]) -> None:
    present = menu.value
    menu.options = tuple(options)
    menu.value = present if present in options else options[0]
