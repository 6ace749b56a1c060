"""What the operator can do next: pure functions from what is on the screen to the big buttons."""

from dataclasses import dataclass
from typing import Literal

from app.look import ASKING, FINISHED, Look
from backend.contract.scans import StageState

Do = Literal["accept", "run", "select", "follow", "export", "nothing"]
Colour = Literal["green", "blue", "gray"]


@dataclass(frozen=True)
class Primary:
    """The large button."""

    label: str
    do: Do
    colour: Colour = "green"
    stage: str = ""
    """Which stage to select, for `select`."""

    @property
    def enabled(self) -> bool:
        """False for a button that only says why there is nothing to do."""
        return self.do != "nothing"


@dataclass(frozen=True)
class Small:
    """One of the three small buttons."""

    label: str
    enabled: bool
    hint: str


@dataclass(frozen=True)
class Buttons:
    """The large button and the three small ones."""

    primary: Primary
    override: Small
    redo: Small
    stop: Small
    stop_cancels: bool
    """True: the third one cancels the running job; False: it rejects the result."""


def buttons(look: Look) -> Buttons:
    """Return what the buttons say and whether they can be pressed."""
    stage, drafts = look.stage, len(look.draft)
    captures = bool(look.description and look.description.captures)
    reviewable = stage.stage_run is not None and stage.status in (
        "awaiting_review",
        "done",
        "accepted",
    )
    changes = "Apply" if drafts == 1 else f"Apply {drafts}"
    return Buttons(
        primary=_primary(look),
        override=Small(
            changes if drafts else "Override", bool(drafts) and not look.running,
            "Apply what was dragged or typed, and run this stage again" if drafts
            else "Drag a border or type a value below, then apply it here",
        ),
        redo=Small(
            "Redo", captures and stage.stage_run is not None and not look.running,
            "Take the pictures of this stage again" if captures
            else "This stage takes no pictures: with the same settings it gives the same result",
        ),
        stop=Small("Cancel", True, "Stop the job; finished stages and frames are kept") if look.running
        else Small("Reject", reviewable, "Refuse this result; then change a setting or redo"),
        stop_cancels=look.running,
    )  # fmt: skip


def _primary(look: Look) -> Primary:
    stage, active = look.stage, look.active
    if look.running:
        if active.name != stage.name:
            return Primary(f"Show {active.title}, running", "follow", "blue")
        return Primary("Running …", "nothing", "gray")
    if stage.status == "awaiting_review":
        return Primary("Accept result" if _is_last(look, stage) else "Accept", "accept")
    if stage.status == "rejected":
        return Primary("Accept after all", "accept", "gray")
    if stage.status == "failed":
        return Primary("Run again", "run", "blue")
    if stage.status == "unavailable":
        return Primary("Not available", "nothing", "gray")
    return _onwards(look, stage)


def _onwards(look: Look, stage: StageState) -> Primary:
    """Return the button for a stage that doesn't ask: on to whatever keeps the scan from going on."""
    asking = next((s for s in look.scan.stages if s.status in ASKING), None)
    if asking is not None:
        return Primary(f"Go to {asking.title}", "select", "blue", asking.name)
    pending = next((s for s in look.scan.stages if s.status == "pending"), None)
    if pending is None:
        if stage.status == "done" and _is_last(look, stage):
            return Primary("Accept result", "accept")
        return Primary("Export …", "export", "blue")
    if stage.status == "done" and _comes_before(look, stage, pending):
        return Primary("Accept and continue", "accept")
    started = any(s.status in FINISHED and s.status != "given" for s in look.scan.stages)
    return Primary("Continue" if started else "Run", "run")


def _is_last(look: Look, stage: StageState) -> bool:
    usable = [s for s in look.scan.stages if s.status != "unavailable"]
    return bool(usable) and usable[-1].name == stage.name


def _comes_before(look: Look, stage: StageState, other: StageState) -> bool:
    names = [s.name for s in look.scan.stages]
    return names.index(stage.name) + 1 == names.index(other.name)
