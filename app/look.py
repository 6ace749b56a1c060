"""What one browser looks at: a frozen snapshot that the panels draw."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from backend.contract.descriptions import MethodDescription, StageDescription
from backend.contract.scans import FieldView, ScanState, StageState

Drafts = Mapping[str, Mapping[str, Any]]
"""Edits that are typed or dragged but not applied yet: stage -> setting -> value."""

FINISHED = frozenset({"done", "accepted", "given"})
ASKING = frozenset({"awaiting_review", "rejected", "failed"})
_AT_WORK = frozenset({"queued", "running"})


@dataclass(frozen=True)
class Look:
    """One scan as one browser sees it.

    Parameters
    ----------
    scan
        The scan's state, as the API told it last.
    method
        Description of the scan's method; None if the method isn't installed any more.
    pinned
        Stage that the operator chose to look at; None follows what happens.
    drafts
        Edits that are not applied yet.
    may_operate
        False for somebody who only watches.
    """

    scan: ScanState
    method: MethodDescription | None
    pinned: str | None = None
    drafts: Drafts = field(default_factory=dict)
    may_operate: bool = False

    @property
    def running(self) -> bool:
        """True while a job of this scan is queued or running."""
        return self.scan.job is not None and self.scan.job.status in _AT_WORK

    @property
    def active(self) -> StageState:
        """The stage where something happens: it runs, or asks, or comes next; else the last result."""
        stages = self.scan.stages
        if self.running and self.scan.job and (at := self.find(self.scan.job.stage)):
            return at
        for statuses in (ASKING, frozenset({"pending"})):
            for stage in stages:
                if stage.status in statuses:
                    return stage
        finished = [s for s in stages if s.status in FINISHED]
        return finished[-1] if finished else stages[0]

    @property
    def stage(self) -> StageState:
        """The stage on the screen."""
        return self.find(self.pinned) or self.active

    @property
    def description(self) -> StageDescription | None:
        """What the method says of the stage on the screen."""
        return self.describe(self.stage.name)

    @property
    def captures(self) -> bool:
        """True if a stage of this scan takes pictures: not where they were imported."""
        return any(
            s.status not in ("given", "unavailable") and (d := self.describe(s.name)) and d.captures
            for s in self.scan.stages
        )

    @property
    def first_capturing(self) -> str:
        """Name of the first stage that takes pictures; where none does, of the one on the screen."""
        stages = self.method.stages if self.method else ()
        return next((s.name for s in stages if s.captures), self.stage.name)

    @property
    def draft(self) -> Mapping[str, Any]:
        """Edits of the stage on the screen that are not applied yet."""
        return self.drafts.get(self.stage.name, {})

    def find(self, name: str | None) -> StageState | None:
        """Return the stage of this name."""
        return next((s for s in self.scan.stages if s.name == name), None)

    def describe(self, stage: str) -> StageDescription | None:
        """Return a stage's description."""
        stages = self.method.stages if self.method else ()
        return next((s for s in stages if s.name == stage), None)

    def cameras(self) -> list[str]:
        """Return the cameras in the order in which the scan's first result with pictures has them."""
        for stage in self.scan.stages:
            for view in fields_of_kind(stage, "picture", "mask", "frames"):
                names = list(view.arrays) or [f.camera for f in view.frames]
                if len(set(names)) > 1:
                    return list(dict.fromkeys(names))
        return []

    def upto_stage(self) -> tuple[StageState, ...]:
        """Return the stages up to the one on the screen, that one first, then back to the start."""
        stages = self.scan.stages
        index = stages.index(self.stage)
        return tuple(reversed(stages[: index + 1]))

    def with_draft(self, name: str, value: Any) -> "Look":
        """Note an edit; one that changes nothing against the present value is forgotten."""
        stage = self.stage
        present = stage.settings[name].value if name in stage.settings else None
        fields = {k: v for k, v in self.draft.items() if k != name}
        if _plain(value) != _plain(present):
            fields[name] = value
        return replace(self, drafts={**self.drafts, stage.name: fields})

    def without_drafts(self, stage: str) -> "Look":
        """Forget the edits of a stage."""
        return replace(self, drafts={k: v for k, v in self.drafts.items() if k != stage})

    def with_scan(self, scan: ScanState) -> "Look":
        """Look at a newer state; drafts that it already contains are forgotten."""
        drafts = {}
        for name, fields in self.drafts.items():
            stage = next((s for s in scan.stages if s.name == name), None)
            if stage is not None:
                drafts[name] = {
                    k: v
                    for k, v in fields.items()
                    if k in stage.settings and _plain(stage.settings[k].value) != _plain(v)
                }
        return replace(self, scan=scan, drafts=drafts)


def fields_of_kind(stage: StageState, *kinds: str) -> list[FieldView]:
    """Return a stage's fields that want to be looked at in one of these ways."""
    return [f for f in stage.fields if f.hint.get("kind") in kinds]


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value
