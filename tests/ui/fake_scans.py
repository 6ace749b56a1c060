"""Scans of the fake and their state in the contract's words. Nothing is measured, everything is in memory."""

import hashlib
import json
import secrets
import threading
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from backend.contract.scans import (
    ArtifactRef,
    AuditEntry,
    CheckView,
    DecisionView,
    FieldView,
    FrameRef,
    HandedView,
    JobView,
    ScanState,
    ScanSummary,
    SettingView,
    StageState,
)
from backend.domain.errors import NotFoundError
from backend.domain.states import StageStatus, Verdict
from tests.ui.fake_methods import METHODS, FakeField, FakeResult, FakeStage

Array = np.ndarray[Any, Any]

_LEVELS = ("ok", "warning", "failure")
_GATES = {"always": 0, "on_warning": 1, "on_failure": 2}
_DECIDED = {Verdict.ACCEPT: StageStatus.ACCEPTED, Verdict.REJECT: StageStatus.REJECTED}
_CHOSEN: dict[str, Any] = {"valleys_gray": [9.0, 48.0, 117.0, 238.0]}
"""What a stage chose by itself, where no shown value tells it."""


@dataclass
class Run:
    """One finished stage."""

    id: str
    stage: str
    result: FakeResult
    fields: tuple[FieldView, ...]
    decision: DecisionView | None = None


@dataclass
class Scan:
    """A scan, its edits and its runs."""

    id: str
    name: str
    note: str
    method: str
    rig: str
    rig_options: dict[str, Any]
    who: str
    created: datetime
    edits: list[dict[str, Any]] = field(default_factory=list)
    takes: dict[str, int] = field(default_factory=dict)
    runs: dict[str, Run] = field(default_factory=dict)
    """By key."""
    job: JobView | None = None
    trail: list[AuditEntry] = field(default_factory=list)
    cancelled: threading.Event = field(default_factory=threading.Event)
    homography: str | None = None
    """Where the handed-over homography comes from; None: there is none."""
    kept: dict[str, int] = field(default_factory=dict)
    """Run -> number of the calibration that it is kept as."""

    @property
    def stages(self) -> tuple[FakeStage, ...]:
        return METHODS[self.method][2]

    @property
    def revision(self) -> int:
        return len(self.edits)

    @property
    def is_running(self) -> bool:
        return self.job is not None and not self.job.status.ended

    def stage(self, name: str) -> FakeStage:
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise NotFoundError(f"Scan {self.id} has no stage {name!r}.")

    def settings(self, stage: str) -> dict[str, Any]:
        default = self.stage(stage).params().model_dump(mode="json")
        values = dict(default)
        for edit in self.open_edits():
            if edit["stage"] == stage:
                name = edit["field"]
                values[name] = default[name] if edit["reset"] else edit["new"]
        return values

    def open_edits(self) -> list[dict[str, Any]]:
        """Return the edits that aren't taken back."""
        return [e for e in self.edits if not e["undone"]]

    def key(self, stage: FakeStage) -> str:
        """Today's key: settings and takes up to this stage."""
        upto = self.stages[: self.stages.index(stage) + 1]
        return json.dumps(
            [[s.name, self.settings(s.name), self.takes.get(s.name, 1)] for s in upto]
        )

    def current(self, stage: FakeStage) -> Run | None:
        return self.runs.get(self.key(stage))

    def log(self, who: str, action: str, stage: str | None, sentence: str, **details: Any) -> None:
        entry = AuditEntry(
            sequence=len(self.trail) + 1, when=datetime.now(UTC), who=who, action=action, stage=stage, sentence=sentence, details=details
        )  # fmt: skip
        self.trail.append(entry)

    def status(self, stage: FakeStage) -> StageStatus:
        run = self.current(stage)
        if run is None:
            here = self.is_running and self.job is not None and self.job.stage == stage.name
            return StageStatus.RUNNING if here else StageStatus.PENDING
        if run.decision:
            return _DECIDED[run.decision.verdict]
        worst = max((_LEVELS.index(c["level"]) for c in run.result.checks), default=0)
        asks = worst >= _GATES[stage.review]
        return StageStatus.AWAITING_REVIEW if asks else StageStatus.DONE

    def overall(self) -> str:
        statuses = [self.status(s) for s in self.stages]
        if self.is_running:
            return "running"
        if StageStatus.AWAITING_REVIEW in statuses:
            return "awaiting_review"
        finished = {StageStatus.DONE, StageStatus.ACCEPTED}
        return "done" if set(statuses) <= finished else "idle"

    def waiting(self) -> Run:
        """Return the first result that waits for a decision."""
        stage = next(s for s in self.stages if self.status(s) is StageStatus.AWAITING_REVIEW)
        run = self.current(stage)
        assert run is not None
        return run

    def state(self) -> ScanState:
        undo = self.open_edits()[-1:]
        return ScanState(
            id=self.id, name=self.name, note=self.note, method=self.method, rig=self.rig, rig_options=self.rig_options,
            created=self.created, who=self.who, revision=self.revision, preset=None, status=self.overall(),
            stages=tuple(self._stage_state(s) for s in self.stages), job=self.job,
            undo=f"{undo[0]['field']} of {undo[0]['stage']}" if undo else None, handed=self._handed(),
        )  # fmt: skip

    def summary(self) -> ScanSummary:
        done = sum(self.status(s) in (StageStatus.DONE, StageStatus.ACCEPTED) for s in self.stages)
        points = [
            len(f.arrays[""]) for r in self.runs.values() for f in r.result.fields if f.hint["kind"] == "points"
        ]  # fmt: skip
        return ScanSummary(
            id=self.id, name=self.name, method=self.method, rig=self.rig, created=self.created, who=self.who,
            status=self.overall(), stages_done=done, stages=len(self.stages), points=points[-1] if points else None,
        )  # fmt: skip

    def _handed(self) -> tuple[HandedView, ...]:
        if self.method != "painted":
            return ()
        return (
            HandedView(
                type="TableHomography", title="Table homography", name="TableHomography", stages=("mask",), sentence=self.homography,
                calibration=1 if self.homography else None,
            ),
        )  # fmt: skip

    def _stage_state(self, stage: FakeStage) -> StageState:
        run, status = self.current(stage), self.status(stage)
        quiet = "Running" if status is StageStatus.RUNNING else "Not run yet"
        return StageState(
            name=stage.name, title=stage.title, status=status, message=run.result.sentence if run else quiet, key=self.key(stage),
            stage_run=run.id if run else None, take=self.takes.get(stage.name, 1), settings=self._setting_views(stage, run),
            checks=tuple(CheckView(**c) for c in run.result.checks) if run else (), fields=run.fields if run else (),
            can_keep=run is not None and stage.name == "levels", kept=self.kept.get(run.id) if run else None,
            decision=run.decision if run else None, duration_s=0.84 if run else None, result_hash=run.id if run else None,
        )  # fmt: skip

    def _setting_views(self, stage: FakeStage, run: Run | None) -> dict[str, SettingView]:
        edited = {e["field"]: not e["reset"] for e in self.open_edits() if e["stage"] == stage.name}
        chosen = _chosen(run.result) if run else {}
        views = {}
        for name, value in self.settings(stage.name).items():
            extra: Any = stage.params.model_fields[name].json_schema_extra
            source = "edited" if edited.get(name) else "default"
            automatic = chosen.get(extra["auto"]) if value is None and run else None
            views[name] = SettingView(value=value, source=source, chosen=automatic)
        return views


def _chosen(result: FakeResult) -> dict[str, Any]:
    chosen = dict(_CHOSEN) | {f.name: f.value for f in result.fields if f.value is not None}
    for shown in result.fields:
        edits = shown.hint.get("edits")
        if edits and isinstance(shown.value, list):
            chosen[edits] = [row["exposure_ms"] for row in shown.value]
    return chosen


class Store:
    """Arrays under their content hash."""

    def __init__(self) -> None:
        self.arrays: dict[str, Array] = {}

    def put(self, array: Array) -> ArtifactRef:
        digest = hashlib.sha256(array.tobytes() + str((array.shape, array.dtype)).encode())
        name = digest.hexdigest()[:32]
        self.arrays[name] = array
        return ArtifactRef(hash=name, shape=array.shape, dtype=str(array.dtype))

    def get(self, name: str) -> Array:
        if name not in self.arrays:
            raise NotFoundError(f"There is no array {name}.")
        return self.arrays[name]

    def run_of(self, stage: FakeStage, settings: dict[str, Any]) -> Run:
        """Make a stage's result and store its arrays."""
        result = stage.make(settings)
        views = tuple(self._view(shown) for shown in result.fields)
        return Run(secrets.token_hex(6), stage.name, result, views)

    def _view(self, shown: FakeField) -> FieldView:
        frames = tuple(
            FrameRef(**{k: v for k, v in f.items() if k != "image"}, image=self.put(f["image"]))
            for f in shown.frames
        )
        arrays = {camera: self.put(array) for camera, array in shown.arrays.items()}
        return FieldView(
            name=shown.name, hint=shown.hint, per_camera=shown.per_camera, value=shown.value, arrays=arrays, frames=frames
        )  # fmt: skip
