"""What one browser looks at, and what has to be redrawn when something changes.

Four threads work for a browser. *Acts* owns the state: it calls the API for whatever the operator does and draws
what follows from the answer. *Loads* fetches arrays, pictures and clouds. *Rigs* waits for rigs to open, which may take
long. *Events* listens to the server. viser's own threads only put work into the queues, so they never wait.
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from app import markup, theme
from app.clicks import Clicks
from app.client import ApiClient, ApiError
from app.failures import words_of
from app.keys import Key, add_keys
from app.look import Look
from app.panels.audit import AuditPanel
from app.panels.cloud import CloudPanel
from app.panels.decision import buttons
from app.panels.dialogs import ask_export, ask_part_moved
from app.panels.handed import HandedPanel, ask_calibration
from app.panels.inspect import Inspector
from app.panels.new_scan import NewScanPanel
from app.panels.pictures import Choice, PicturesPanel, is_live
from app.panels.review import ReviewPanel
from app.panels.rig import RigPanel
from app.panels.rig_desk import RigDeskPanel
from app.panels.scan_list import ScanListPanel
from app.panels.settings import SettingsPanel
from app.panels.stage import StagePanel
from app.space import Space
from app.station import Introduction
from app.views.mask import crisp
from app.views.picture import Figure
from app.views.pixel import decoded, decoded_url, pixel_of
from app.worker import Work, Worker
from backend.contract.descriptions import MethodDescription
from backend.contract.events import Event, FrameCaptured, JobProgress, RigChanged, ScanChanged
from backend.contract.requests import (
    CreateScan,
    Decide,
    EditSettings,
    ExportScan,
    GivenSource,
    ImportCapture,
    RedoStage,
    StartRun,
    UndoEdit,
)
from backend.contract.rigs import RigView
from backend.contract.scans import ScanState

_WIDE_PX = 1500
"""A canvas at least so wide on arrival gets wide panels."""
_LARGE_PX = 2000
_NOTE_S = 8.0


class Session:
    """One connected browser.

    Parameters
    ----------
    client
        viser's handle of the browser.
    api
        Calls the API on behalf of the user who sits there.
    who
        That user.
    points_budget
        Most points of a cloud that are shown before the operator asks for more.
    """

    def __init__(
        self, client: viser.ClientHandle, api: ApiClient, who: Introduction, *, points_budget: int
    ) -> None:
        self.api, self.who = api, who
        self._client, self._gui = client, client.gui
        self._points_budget = points_budget
        self._look: Look | None = None
        self._methods: dict[str, MethodDescription] = {}
        self._draft_errors: dict[str, str] = {}
        self._reason = ""
        self._showing_by_itself = False
        self._left_by_hand = ""
        """Scan whose enlarged picture the operator closed: it doesn't come back by itself."""
        self._ends: list[Callable[[], None]] = []
        self._stopping = threading.Event()
        self._acts = Worker(f"acts {client.client_id}", self._report)
        self._loads = Worker(f"loads {client.client_id}", self._report)
        self._rigs = Worker(f"rigs {client.client_id}", self._report)
        self._events = threading.Thread(
            target=self._listen, name=f"events {client.client_id}", daemon=True
        )
        self._acts.submit(self._build)

    def close(self) -> None:
        """End the session's threads; the browser is gone."""
        self._stopping.set()
        self._acts.close()
        self._loads.close()
        self._rigs.close()
        for end in self._ends:
            end()
        self.api.close()

    # ---- what panels ask for (see app/desk.py)

    @property
    def look(self) -> Look | None:
        """What is looked at just now; None on the start page."""
        return self._look

    def act(self, work: Work, *, key: str | None = None) -> None:
        """Do something short, on the thread that owns the state."""
        self._acts.submit(work, key=key)

    def load(self, work: Work, *, key: str | None = None) -> None:
        """Fetch something long, on another thread."""
        self._loads.submit(work, key=key)

    def notify(self, title: str, body: str, *, colour: str = "blue") -> None:
        """Show a note that goes away by itself."""
        self._client.add_notification(title, body, auto_close_seconds=_NOTE_S, color=colour)  # type: ignore[call-overload]  # viser lists its colours, ours are some of them

    def open_scan(self, scan_id: str) -> None:
        """Show a scan."""
        self.act(lambda: self._open(self.api.scan(scan_id)))

    def go_home(self) -> None:
        """Show the list of scans."""
        self.act(self._go_home)

    def select(self, stage: str | None) -> None:
        """Look at a stage; None follows what happens."""
        self.act(lambda: self._change(lambda look: _pinned(look, stage)))

    def set_draft(self, name: str, value: Any) -> None:
        """Note an edit of the stage on the screen, not applied yet."""
        self.act(lambda: self._set_draft(name, value), key=f"draft {name}")

    def set_draft_error(self, name: str, error: str | None) -> None:
        """Note that what was typed for a setting can't be read."""
        others = {k: v for k, v in self._draft_errors.items() if k != name}
        self._draft_errors = others | ({name: error} if error else {})
        self.act(self._draw_controls, key="controls")

    def forget_draft_errors(self) -> None:
        """Forget what couldn't be read: the controls that said it are gone."""
        self._draft_errors = {}

    def set_reason(self, reason: str) -> None:
        """Keep the words that go into the log with the next edit or decision."""
        self._reason = reason

    def do_primary(self) -> None:
        """Do what the large button says."""
        self.act(self._do_primary)

    def apply(self) -> None:
        """Apply the edits of the stage on the screen and run it."""
        self.act(self._apply)

    def reset(self, name: str) -> None:
        """Put a setting back and run the stage."""
        self.act(lambda: self._edit({}, (name,)))

    def redo(self) -> None:
        """Take the pictures of the stage on the screen again."""
        self.act(self._redo)

    def stop(self) -> None:
        """Cancel the running job, or reject the result on the screen."""
        self.act(self._stop)

    def undo(self) -> None:
        """Take back the last edit."""
        self.act(self._undo)

    def part_moved(self) -> None:
        """Ask whether to take all pictures again."""

        def redo(reason: str) -> None:
            self.act(lambda: self._redo_all(reason))

        self.act(lambda: ask_part_moved(self._gui, redo))

    def export(self) -> None:
        """Ask where to write the results."""
        self.act(self._ask_export)

    def keep(self) -> None:
        """Keep the result on the screen for its rig."""
        self.act(self._keep)

    def take_away(self, type_name: str) -> None:
        """Take a handed-over result from the scan."""
        self.act(lambda: self._take_away(type_name))

    def choose_calibration(self, type_name: str) -> None:
        """Ask which result to hand to the scan."""
        self.act(lambda: self._ask_calibration(type_name))

    def create(self, request: CreateScan, *, run: bool) -> None:
        """Make a scan, open it, and run it if asked to."""
        self.act(lambda: self._patiently("Opening the rig", lambda: self._create(request, run=run)))

    def import_capture(self, request: ImportCapture) -> None:
        """Import a captured folder and open the scan."""
        self.act(
            lambda: self._patiently(
                "Importing", lambda: self._open(self.api.import_capture(request))
            )
        )

    def show_rig(self) -> None:
        """Show the rig that is chosen on the start page."""
        self._rigs.submit(self._show_rig, key="rig")

    def open_rig(self, rig: str, options: dict[str, Any] | None) -> None:
        """Show a rig without a scan."""
        self.act(lambda: self._open_rig(rig, options))

    def inspect(self, camera: str) -> None:
        """Show a camera's picture large."""
        self.load(lambda: self._inspect(camera), key="inspect")

    def leave_inspection(self) -> None:
        """Show the scene again; on a rig's page, put the magnifier away."""
        self._rig_desk.leave_part()
        self._left_by_hand = self._look.scan.id if self._look is not None else ""
        self.load(self._leave_inspection, key="inspect")

    # ---- building

    def _build(self) -> None:
        gui, client = self._gui, self._client
        wide = client.camera.image_width > _WIDE_PX
        gui.set_panel_label(f"unglare · {self.who.user}" if self.who.user else "unglare")
        self._style = gui.add_html(theme.STYLE, order=1e7)
        self.clicks = Clicks(gui)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(440 if wide else 384)
        self._home = gui.add_folder(None, order=1, visible=False)
        self._scan = gui.add_folder(None, order=2, visible=False)
        self._rig_controls = gui.add_folder(None, order=3, visible=False)
        self._list_panel = gui.add_panel()
        self._list_panel.dock_left()
        self._list_panel.set_width(400 if wide else 300)
        with self._list_panel.add_tab("Scans", viser.Icon.LIST_DETAILS):
            self._scans = ScanListPanel(gui, self)
        self._build_scan_panels(wide=wide)
        self._rig_panel = gui.add_panel(visible=False)
        self._rig_panel.dock_left()
        self._rig_panel.set_width(400 if wide else 300)
        self._space = Space(client)
        self._rig = RigPanel(self._space, self)
        self._cloud = CloudPanel(client, self._space, self, budget=self._points_budget)
        self._inspector = Inspector(client, self._space, self)
        self._rig_desk = RigDeskPanel(
            client, self._space, self, main=self._rig_controls, left=self._rig_panel
        )
        self._ends.append(self._rig_desk.end)
        self._new_scan: NewScanPanel | None = None
        with self._home:
            if self.who.may_operate:
                self._new_scan = NewScanPanel(gui, self)
            else:
                words = "You watch. As soon as a scan is worked on, it appears here."
                gui.add_html(markup.div("ug-empty", words))
        if self.who.may_operate:
            self._add_commands()
            self._listen_to_clicks()
        self._methods = {m.name: m for m in self.api.methods()}
        self._scans.name_methods({m.name: m.title for m in self._methods.values()})
        self._go_home()
        self._events.start()

    def _build_scan_panels(self, *, wide: bool) -> None:
        gui = self._gui
        self._scan_panel = gui.add_panel(visible=False)
        self._scan_panel.dock_left()
        self._scan_panel.set_width(400 if wide else 268)
        with self._scan_panel.add_tab("Pictures", viser.Icon.PHOTO):
            self._pictures = PicturesPanel(gui, self)
        with self._scan_panel.add_tab("Log", viser.Icon.HISTORY):
            self._audit = AuditPanel(gui)
        with self._scan:
            self._stage = StagePanel(gui, self)
            self._handed = HandedPanel(gui, self)
            self._review = ReviewPanel(gui, self)
            self._settings = SettingsPanel(gui, self) if self.who.may_operate else None

    def _add_commands(self) -> None:
        keys: list[Key] = [
            ("Accept, run, or whatever the large button says", "F", None, self.do_primary),
            ("Apply changed settings", "O", None, self.apply),
            ("Take the pictures of this stage again", "R", None, self.redo),
            ("Undo the last edit", "Z", "cmd/ctrl", self.undo),
            ("Close the enlarged picture", "X", None, self.leave_inspection),
            ("Follow the running stage", "G", None, lambda: self.select(None)),
            ("All scans", "H", None, self.go_home),
            ("Rig without a scan: live pictures, light, focus", "L", None, self._show_present_rig),
        ]
        add_keys(self._gui, keys)

    def _listen_to_clicks(self) -> None:
        @self._client.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            origin, direction = event.ray_origin, event.ray_direction
            self.load(lambda: self._clicked(origin, direction), key="click")

    # ---- pages

    def _go_home(self) -> None:
        self._look = None
        if self.who.may_operate is False and self._follow_newest():
            return
        self._rig_desk.close()
        with self._client.atomic():
            self._scan.visible = self._scan_panel.visible = False
            self._home.visible = self._list_panel.visible = True
        self._scans.refresh()
        self.load(self._clear_scene)
        if self._new_scan is not None:
            self._new_scan.fill(tuple(self._methods.values()), self.api.rigs())
            self.show_rig()

    def _clear_scene(self) -> None:
        self._inspector.close()
        self._cloud.forget()
        self._rig.show(None, "")

    def _follow_newest(self) -> bool:
        """Show a viewer the newest scan: a viewer has no controls to choose one."""
        newest = self.api.scans(limit=1)
        if newest:
            self._open(self.api.scan(newest[0].id))
        return bool(newest)

    def _open(self, scan: ScanState) -> None:
        is_other = self._look is None or self._look.scan.id != scan.id
        method = self._methods.get(scan.method)
        self._rig_desk.close()
        if is_other:
            self.load(self._clear_scene)
        self._look = Look(scan, method, may_operate=self.who.may_operate)
        self._draw()
        with self._client.atomic():
            self._home.visible = self._list_panel.visible = False
            self._scan.visible = self._scan_panel.visible = True

    def _open_rig(self, rig: str, options: dict[str, Any] | None) -> None:
        if options is None and self._new_scan is not None:
            options = self._new_scan.options_of(rig)
        self._look = None
        with self._client.atomic():
            self._home.visible = self._list_panel.visible = False
            self._scan.visible = self._scan_panel.visible = False
        self._clear_scene()
        self._rig_desk.open(rig, self.api.rigs(), options)

    def _show_present_rig(self) -> None:
        """Show the rig of the scan on the screen, or the one that is chosen on the start page."""
        look, chosen = self._look, self._new_scan.chosen_rig() if self._new_scan else None
        if look is not None and look.scan.rig:
            self.open_rig(look.scan.rig, dict(look.scan.rig_options))
        elif look is None and chosen is not None:
            self.open_rig(*chosen)

    def _patiently(self, words: str, work: Work) -> None:
        """Do what may take long, with a note that says so."""
        note = self._client.add_notification(
            words, "This may take a moment.", loading=True, with_close_button=False
        )
        try:
            work()
        finally:
            note.remove()

    def _create(self, request: CreateScan, *, run: bool) -> None:
        scan = self.api.create(request)
        self._open(scan)
        if run:
            self._take(self.api.run(scan.id, StartRun()))

    # ---- changes

    def _change(self, change: Callable[[Look], Look]) -> None:
        if self._look is not None:
            self._look = change(self._look)
            self._draw()

    def _take(self, scan: ScanState, *, follow: bool = False) -> None:
        """Draw a newer state of the scan on the screen."""
        look = self._look
        if look is None or look.scan.id != scan.id:
            return
        look = look.with_scan(scan)
        self._look = _pinned(look, None) if follow else look
        self._draw()

    def _do_primary(self) -> None:
        look = self._look
        if look is None or not look.may_operate:
            return
        primary = buttons(look).primary
        if primary.do == "accept" and look.stage.stage_run:
            request = _decision("accept", self._take_reason(), proceed=True)
            self._take(self.api.decide(look.stage.stage_run, request), follow=True)
        elif primary.do == "run":
            self._take(self.api.run(look.scan.id, StartRun()), follow=True)
        elif primary.do == "select":
            self._change(lambda old: _pinned(old, primary.stage))
        elif primary.do == "follow":
            self._change(lambda old: _pinned(old, None))
        elif primary.do == "export":
            self._ask_export()

    def _set_draft(self, name: str, value: Any) -> None:
        if self._look is not None and self._look.may_operate:
            self._look = self._look.with_draft(name, value)
            self._draw_controls()
            look = self._look
            self.load(lambda: self._review.show_draft(look), key="draft")

    def _apply(self) -> None:
        look = self._look
        if look is None:
            return
        if self._draft_errors:
            name, error = next(iter(self._draft_errors.items()))
            self.notify(name, f"{error}.", colour="red")
        elif look.draft and look.may_operate:
            self._edit(dict(look.draft), ())

    def _edit(self, changes: dict[str, Any], reset: tuple[str, ...]) -> None:
        look = self._look
        if look is None or not look.may_operate:
            return
        stage, was_run = look.stage.name, look.stage.status != "pending"
        request = EditSettings(
            changes=changes, reset=reset, reason=self._take_reason(), revision=look.scan.revision
        )
        try:
            scan = self.api.edit(look.scan.id, stage, request)
        except ApiError as error:
            if error.problem.type.endswith("stale-edit"):
                self._show_stale(error, look)
                return
            raise
        self._look = _pinned(look.without_drafts(stage), stage)
        if was_run and not look.running:
            scan = self.api.run(scan.id, StartRun(until=stage))
        self._take(scan)

    def _show_stale(self, error: ApiError, look: Look) -> None:
        """Show the other operator's edit in place of ours, in the words of the server."""
        self.notify("Somebody else was faster", error.problem.detail, colour="orange")
        self._look = look.without_drafts(look.stage.name)
        self._take(self.api.scan(look.scan.id))

    def _redo(self) -> None:
        look = self._look
        if look is None or not buttons(look).redo.enabled:
            return
        stage = look.stage.name
        request = RedoStage(reason=self._take_reason(), revision=look.scan.revision)
        scan = self.api.redo(look.scan.id, stage, request)
        self._look = _pinned(look, stage)
        self._take(self.api.run(scan.id, StartRun(until=stage)))

    def _redo_all(self, reason: str) -> None:
        look = self._look
        if look is None:
            return
        request = RedoStage(all=True, reason=reason, revision=look.scan.revision)
        scan = self.api.redo(look.scan.id, look.first_capturing, request)
        self._take(self.api.run(scan.id, StartRun()), follow=True)

    def _stop(self) -> None:
        look = self._look
        if look is None:
            return
        if look.running:
            self._take(self.api.cancel(look.scan.id))
        elif look.stage.stage_run:
            request = _decision("reject", self._take_reason(), proceed=False)
            self._take(self.api.decide(look.stage.stage_run, request))

    def _undo(self) -> None:
        look = self._look
        if look is not None and look.scan.undo and look.may_operate:
            self._take(self.api.undo(look.scan.id, UndoEdit(revision=look.scan.revision)))

    def _keep(self) -> None:
        look = self._look
        if look is None or not look.may_operate or not look.stage.stage_run:
            return
        kept = self.api.keep(look.stage.stage_run)
        self.notify(
            f"Calibration {kept.number}",
            f"{kept.title}: later scans with this rig get it.",
            colour="green",
        )
        self._take(self.api.scan(look.scan.id))

    def _take_away(self, type_name: str) -> None:
        look = self._look
        if look is not None and look.may_operate:
            self._take(self.api.take_away(look.scan.id, type_name))

    def _ask_calibration(self, type_name: str) -> None:
        look = self._look
        if look is None or not look.may_operate:
            return
        kept = self.api.calibrations(look.scan.rig) if look.scan.rig else ()
        offered = [c for c in kept if c.type == type_name and c.withdrawn is None]
        title = next((h.title for h in look.scan.handed if h.type == type_name), type_name)

        def give(source: GivenSource) -> None:
            self.act(lambda: self._take(self.api.give(look.scan.id, type_name, source)))

        ask_calibration(self._gui, title, offered, give)

    def _ask_export(self) -> None:
        look = self._look
        if look is None:
            return
        scan_id = look.scan.id

        def export(folder: str, frames: bool) -> None:
            self.act(lambda: self._export(scan_id, folder, frames=frames))

        ask_export(self._gui, self, scan_id, export)

    def _export(self, scan_id: str, folder: str, *, frames: bool) -> None:
        request = ExportScan(folder=folder, frames=frames)
        self._patiently("Exporting", lambda: self._write(scan_id, request))

    def _write(self, scan_id: str, request: ExportScan) -> None:
        folder, written = request.folder, self.api.export(scan_id, request)
        self.notify(
            "Exported",
            f"{len(written)} files in {folder}" if written else f"Written to {folder}",
            colour="green",
        )

    def _take_reason(self) -> str:
        reason, self._reason = self._reason.strip(), ""
        return reason

    # ---- drawing

    def _draw(self) -> None:
        look = self._look
        if look is None:
            return
        self._stage.draw(look)
        self._handed.draw(look)
        if self._settings is not None:
            self._settings.draw(look)
        self.load(lambda: self._draw_loaded(look), key="draw")
        self.load(lambda: self._audit.draw(look.scan, self.api.audit(look.scan.id)), key="audit")

    def _draw_controls(self) -> None:
        look = self._look
        if look is not None:
            self._stage.draw(look)
            if self._settings is not None:
                self._settings.draw(look)

    def _draw_loaded(self, look: Look) -> None:
        if self._look is None or self._look.scan.id != look.scan.id:
            return
        self._rig.draw(look)  # first: it says how the scene lies
        self._review.draw(look)
        self._cloud.draw(look)
        self._pictures.draw(look)
        self._rig.draw_pictures(look)
        if is_live(look) and self._rig.rig is not None:
            for camera in self._rig.rig.cameras:
                self._show_live(look.scan.rig, camera.name)
        self._draw_inspection(look)

    def _draw_inspection(self, look: Look) -> None:
        """Keep an enlarged picture up to date; where there is neither rig nor cloud, show one by itself."""
        is_bare = not (self._rig.has_place or self._cloud.is_shown)
        if self._inspector.is_open:
            if self._showing_by_itself and not is_bare:
                self._leave_inspection()
            else:
                self._cloud.set_panel_visible(False)
                self._refresh_inspection(look)
        elif is_bare and not is_live(look) and self._left_by_hand != look.scan.id:
            found = self._pictures.figures()
            if found is not None and found[1]:
                self._inspect(found[1][0].camera)
                self._showing_by_itself = True

    def _show_rig(self) -> None:
        chosen = self._new_scan.chosen_rig() if self._new_scan is not None else None
        if self._look is not None or self._rig_desk.is_open or chosen is None:
            return
        name, options = chosen
        # Half-typed options: what is wrong is said when it counts.
        with contextlib.suppress(ApiError):
            rig = self.api.rig(name, options)
            self.load(lambda: self._draw_rig(rig), key="rig")

    def _draw_rig(self, rig: RigView) -> None:
        if self._look is None and not self._rig_desk.is_open:
            self._rig.show(rig, "")

    def _inspect(self, camera: str) -> None:
        look, self._showing_by_itself = self._look, False
        if look is None:
            return
        found = self._figure_of(camera)
        if found is not None:
            self._cloud.set_panel_visible(False)
            choice, figure = found
            self._inspector.show(choice, figure, self._picture_of(figure.source), look)

    def _figure_of(self, camera: str | None) -> tuple[Choice, Figure] | None:
        found = self._pictures.figures()
        if found is None:
            return None
        choice, figures = found
        figure = next((f for f in figures if f.camera == camera), None)
        return (choice, figure) if figure is not None else None

    def _refresh_inspection(self, look: Look) -> None:
        shown = self._inspector.figure
        found = self._figure_of(shown.camera if shown else None)
        if found is None:
            # While its stage runs again the picture stays: the next one is on its way.
            if not (look.running or look.stage.status in ("pending", "running")):
                self._leave_inspection()
        elif found[1] != self._inspector.figure:
            choice, figure = found
            self._inspector.show(choice, figure, self._picture_of(figure.source), look)

    def _picture_of(self, source: str) -> Any:
        is_inside = source.startswith("data:")
        picture = decoded_url(source) if is_inside else decoded(self.api.picture(source))
        return crisp(picture, _LARGE_PX)

    def _leave_inspection(self) -> None:
        self._inspector.close()
        self._cloud.set_panel_visible(True)

    def _clicked(self, origin: Any, direction: Any) -> None:
        look = self._look
        if self._rig_desk.is_open:
            self._rig_desk.click(origin, direction)
        if look is None:
            return
        if self._inspector.is_open:
            self._inspector.click(look, origin, direction)
            return
        picked = self._cloud.pick(origin, direction)
        if picked is not None:
            pixel = pixel_of(self._rig.rig, picked.point_mm) if self._rig.rig else None
            self._inspector.show_point(look, picked.facts, pixel)

    # ---- events

    def _listen(self) -> None:
        try:
            for event in self.api.events(self._stopping):
                if self._stopping.is_set():
                    return
                self._hear(event)
        except ApiError as error:
            self._report(error)

    def _hear(self, event: Event | None) -> None:
        look = self._look
        if event is None or isinstance(event, ScanChanged):
            self.act(
                lambda: self._scan_changed(event.scan if event else None),
                key=f"changed {event.scan if event else ''}",
            )
        elif isinstance(event, JobProgress):
            if look is not None and event.scan == look.scan.id:
                self.act(lambda: self._progressed(event), key="progress")
        elif isinstance(event, FrameCaptured):
            if look is not None and event.scan == look.scan.id:
                self.load(
                    lambda: self._show_live(event.rig, event.camera), key=f"live {event.camera}"
                )
        elif isinstance(event, RigChanged):
            if not self.who.may_operate:
                self.act(lambda: self._follow_rig(event.rig), key=f"rig {event.rig}")
            elif look is None:
                self._rig_changed(event.rig)

    def _rig_changed(self, rig: str) -> None:
        if self._rig_desk.is_open:
            self._rig_desk.changed(rig)
        else:
            self.show_rig()

    def _follow_rig(self, rig: str) -> None:
        """Show a viewer the rig that somebody sets up: a viewer has no controls to choose it."""
        if self._look is not None and self._look.running:
            return
        live = self.api.live(rig)
        if self._rig_desk.rig == rig:
            self._rig_desk.changed(rig)
            if not live.running:
                self._go_home()
        elif live.running and live.owner is None:
            self._open_rig(rig, {})

    def _scan_changed(self, scan_id: str | None) -> None:
        look = self._look
        if look is None:
            self._scans.refresh()
            if not self.who.may_operate:
                self._go_home()
        elif scan_id in (None, look.scan.id):
            self._take(self.api.scan(look.scan.id))
        elif not self.who.may_operate:
            self._open(self.api.scan(str(scan_id)))

    def _progressed(self, event: JobProgress) -> None:
        look = self._look
        if look is None or event.scan != look.scan.id:
            return
        is_other_stage = look.scan.job is None or look.scan.job.stage != event.job.stage
        if is_other_stage or look.scan.job is None or look.scan.job.status != event.job.status:
            self._take(self.api.scan(look.scan.id))
            return
        self._look = look.with_scan(look.scan.model_copy(update={"job": event.job}))
        self._stage.progress(self._look)

    def _show_live(self, rig: str, camera: str) -> None:
        """Show the newest picture of a camera in its frustum and, while a stage captures, in the panel."""
        look = self._look
        jpeg = self.api.camera_picture(rig, camera) if look is not None else None
        if look is None or jpeg is None or look.scan.rig != rig:
            return
        self._rig.show_live(camera, jpeg)
        if is_live(look):
            self._pictures.show_live(camera, jpeg, order=self._rig.order_of(camera))

    # ---- errors

    def _report(self, error: Exception) -> None:
        if self._stopping.is_set():
            return
        self.notify(*words_of(error), colour="red")


def _pinned(look: Look, stage: str | None) -> Look:
    """Look at a stage; the active one is followed, not pinned."""
    return replace(look, pinned=None if stage == look.active.name else stage)


def _decision(verdict: str, reason: str, *, proceed: bool) -> Decide:
    return Decide.model_validate({"verdict": verdict, "reason": reason, "proceed": proceed})
