"""What panels may ask of the session that they belong to. Every method returns at once."""

from typing import Any, Protocol

from app.clicks import Clicks
from app.client import ApiClient
from app.look import Look
from app.station import Introduction
from app.worker import Work
from backend.contract.requests import CreateScan, ImportCapture


class Desk(Protocol):
    """One operator's desk: the browser's controls call it, its workers do the work."""

    api: ApiClient
    who: Introduction
    clicks: Clicks

    @property
    def look(self) -> Look | None:
        """What is looked at just now; None on the start page."""

    def act(self, work: Work, *, key: str | None = None) -> None:
        """Do something short, on the thread that owns the state; errors reach the operator."""

    def load(self, work: Work, *, key: str | None = None) -> None:
        """Fetch something long, on another thread."""

    def notify(self, title: str, body: str, *, colour: str = "blue") -> None:
        """Show a note that goes away by itself."""

    def open_scan(self, scan_id: str) -> None:
        """Show a scan."""

    def go_home(self) -> None:
        """Show the list of scans."""

    def select(self, stage: str | None) -> None:
        """Look at a stage; None follows what happens."""

    def set_draft(self, name: str, value: Any) -> None:
        """Note an edit of the stage on the screen, not applied yet."""

    def set_draft_error(self, name: str, error: str | None) -> None:
        """Note that what was typed for a setting can't be read; None: it can."""

    def forget_draft_errors(self) -> None:
        """Forget what couldn't be read: the controls that said it are gone."""

    def set_reason(self, reason: str) -> None:
        """Keep the words that go into the log with the next edit or decision."""

    def do_primary(self) -> None:
        """Do what the large button says."""

    def apply(self) -> None:
        """Apply the edits of the stage on the screen and run it."""

    def reset(self, name: str) -> None:
        """Put a setting back to its recipe, preset or default value and run."""

    def redo(self) -> None:
        """Take the pictures of the stage on the screen again."""

    def stop(self) -> None:
        """Cancel the running job, or reject the result on the screen."""

    def undo(self) -> None:
        """Take back the last edit."""

    def part_moved(self) -> None:
        """Ask whether to take all pictures again."""

    def export(self) -> None:
        """Ask where to write the results."""

    def keep(self) -> None:
        """Keep the result on the screen for its rig."""

    def take_away(self, type_name: str) -> None:
        """Take a handed-over result from the scan."""

    def choose_calibration(self, type_name: str) -> None:
        """Ask which result to hand to the scan."""

    def inspect(self, camera: str) -> None:
        """Show a camera's picture large, and answer questions about pixels."""

    def show_rig(self) -> None:
        """Show the rig that is chosen on the start page."""

    def open_rig(self, rig: str, options: dict[str, Any] | None) -> None:
        """Show a rig without a scan; None: with the options that the start page has for it."""

    def create(self, request: CreateScan, *, run: bool) -> None:
        """Make a scan, open it, and run it if asked to."""

    def import_capture(self, request: ImportCapture) -> None:
        """Import a captured folder and open the scan."""

    def leave_inspection(self) -> None:
        """Show the scene again."""
