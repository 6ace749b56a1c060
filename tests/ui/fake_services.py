"""Services that measure nothing: what the API asks, answered out of `fake_methods`, for tests of the interface.

Tests look into the state and steer it: `go_on` holds jobs in the middle of a stage, `asked` tells who wanted what.
"""

import io
import secrets
import threading
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from backend.contract import requests
from backend.contract.descriptions import MethodList
from backend.contract.events import FrameCaptured, JobProgress, ScanChanged
from backend.contract.rigs import RigOffer, RigView
from backend.contract.scans import (
    ArtifactRef,
    AuditEntry,
    CalibrationView,
    DecisionView,
    JobView,
    PixelLevels,
    ScanState,
    ScanSummary,
)
from backend.domain.errors import (
    ConflictError,
    InvalidSettingError,
    NotFoundError,
    StaleEditError,
)
from backend.domain.shots import Progress
from backend.domain.states import JobStatus, StageStatus, Verdict
from backend.services import previews
from backend.services.array_uploads import UploadKind
from backend.services.events import EventHub
from backend.services.live_pictures import live_jpeg
from backend.services.services import Services
from tests.ui.fake_methods import METHODS, FakeStage
from tests.ui.fake_rig import OFFERS, describe, pack_points, rig_view
from tests.ui.fake_scans import Run, Scan, Store
from tests.ui.fake_scene import CAMERAS, scene

PICTURE_MS = 33.3
Array = np.ndarray[Any, Any]


class FakeServices(Services):
    """Answers as the real services do, and has none of what they stand on: no database, store or runner.

    Parameters
    ----------
    tick_s
        Pause between two of the four progress reports of a stage; 0 for none.
    """

    def __init__(self, *, tick_s: float = 0.0) -> None:
        self._hub = EventHub()
        self.store = Store()
        self.all: dict[str, Scan] = {}
        self.asked: list[tuple[str, str, Any]] = []
        """(user, what, request) of everything that changes something."""
        self.go_on = threading.Event()
        self.go_on.set()
        """Cleared by a test to hold jobs in the middle of a stage."""
        self.kept: list[CalibrationView] = []
        """Calibrations, newest first."""
        self._tick_s = tick_s
        self._lock = threading.RLock()
        self._jobs: list[threading.Thread] = []

    @property
    def events(self) -> EventHub:
        return self._hub

    def close(self) -> None:
        for scan in self.all.values():
            scan.cancelled.set()
        self.go_on.set()
        self.finish_jobs()

    # ---- reading

    def methods(self) -> MethodList:
        return MethodList(methods=tuple(describe(m) for m in METHODS), broken={})

    def rigs(self) -> tuple[RigOffer, ...]:
        return OFFERS

    def rig(self, name: str, options: Mapping[str, Any]) -> RigView:
        return rig_view(dict(options))

    def scan_rig(self, scan: str) -> RigView:
        return rig_view(self.find(scan).rig_options)

    def live_frame(self, rig: str, camera: str, **wishes: Any) -> bytes | None:
        return live_jpeg(scene().white(camera, PICTURE_MS), 8, 640)

    def scan(self, scan: str) -> ScanState:
        with self._lock:
            return self.find(scan).state()

    def scans(self, limit: int = 50, offset: int = 0, text: str = "") -> tuple[ScanSummary, ...]:
        with self._lock:
            found = [s for s in reversed(self.all.values()) if text.lower() in s.name.lower()]
            return tuple(s.summary() for s in found[offset : offset + limit])

    def audit(self, scan: str) -> tuple[AuditEntry, ...]:
        return tuple(self.find(scan).trail)

    def artifact(self, hash: str) -> Array:
        return self.store.get(hash)

    def artifact_preview(self, hash: str, **wishes: Any) -> bytes:
        return previews.draw(self.store.get(hash), **wishes)

    def artifact_at(self, hash: str, x: int, y: int) -> Any:
        return previews.value_at(self.store.get(hash), x, y)

    def levels_at(
        self, scan: str, stage: str, field: str, *, camera: str, x: int, y: int
    ) -> PixelLevels:
        found = self.find(scan)
        run = found.current(found.stage(stage))
        assert run is not None
        by_name = {view.name: view for view in run.fields}
        gray = [
            self.artifact_at(f.image.hash, x, y)
            for f in by_name[field].frames
            if f.camera == camera
        ]
        slope, offset = (
            self.artifact_at(by_name[n].arrays[camera].hash, x, y) for n in ("slope", "offset")
        )
        axis = self.artifact(by_name["light"].arrays[""].hash)
        return PixelLevels(
            camera=camera, x=x, y=y, axis=tuple(axis.tolist()), gray=tuple(gray), exposure_ms=(20.0,) * len(gray), full_scale_gray=255.0,
            slope=slope, offset=offset,
        )  # fmt: skip

    def upload_array(self, data: bytes, kind: UploadKind = UploadKind.MASK) -> ArtifactRef:
        array = np.load(io.BytesIO(data), allow_pickle=False)
        self.asked.append(("", "upload", array))
        reference = self.store.put(array)
        whole = reference.model_copy(update={"hash": reference.hash * 2})  # as long as a real one
        self.store.arrays[whole.hash] = array
        return whole

    def cloud_preview(
        self,
        stage_run: str,
        field: str,
        *,
        budget: int = 300_000,
        beyond: int = 0,
        scalar: str | None = None,
    ) -> bytes:
        return pack_points(self._run(stage_run)[1].result, budget)

    def cloud_ply(self, scan: str) -> Iterator[bytes]:
        return iter([b"ply\n"])

    def find(self, scan: str) -> Scan:
        if scan not in self.all:
            raise NotFoundError(f"There is no scan {scan!r}.")
        return self.all[scan]

    def _run(self, stage_run: str) -> tuple[Scan, Run]:
        for scan in self.all.values():
            for run in scan.runs.values():
                if run.id == stage_run:
                    return scan, run
        raise NotFoundError(f"There is no stage run {stage_run!r}.")

    # ---- changing

    def create_scan(self, request: requests.CreateScan, who: str) -> ScanState:
        self.asked.append((who, "create", request))
        if request.method not in METHODS:
            raise NotFoundError(f"There is no method {request.method!r}.")
        with self._lock:
            number = f"{147 + len(self.all):04d}"
            scan = Scan(
                number, request.name, request.note, request.method, request.rig, dict(request.rig_options), who, datetime.now(UTC)
            )  # fmt: skip
            self.all[number] = scan
            scan.log(who, "created", None, f"Scan made with {request.method} on {request.rig}")
        return self._changed(scan)

    def edit(self, scan: str, stage: str, request: requests.EditSettings, who: str) -> ScanState:
        self.asked.append((who, f"edit {stage}", request))
        found = self.find(scan)
        with self._lock:
            changes = request.changes | dict.fromkeys(request.reset)
            _refuse_stale(found, stage, changes, request.revision)
            _refuse_wrong(found.stage(stage), found.settings(stage) | request.changes)
            group = secrets.token_hex(4)
            for name, new in changes.items():
                row = {
                    "stage": stage, "field": name, "old": found.settings(stage)[name], "new": new, "reset": name in request.reset,
                    "who": who, "when": datetime.now(UTC).isoformat(), "reason": request.reason, "group": group,
                    "undone": False, "revision": found.revision + 1,
                }  # fmt: skip
                found.edits.append(row)
                found.log(
                    who, "edited", stage, f"{name}: {row['old']} to {new}", reason=request.reason
                )
        return self._changed(found)

    def undo(self, scan: str, request: requests.UndoEdit, who: str) -> ScanState:
        self.asked.append((who, "undo", request))
        found = self.find(scan)
        if not found.open_edits():
            raise ConflictError("There is nothing to undo.")
        last = found.open_edits()[-1]
        for edit in found.edits:
            edit["undone"] |= edit["group"] == last["group"]
        found.log(who, "undone", last["stage"], f"Took back {last['field']}")
        return self._changed(found)

    def redo(
        self, scan: str, stage: str | None, request: requests.RedoStage, who: str
    ) -> ScanState:
        self.asked.append((who, f"redo {stage}", request))
        found = self.find(scan)
        for each in found.stages:
            if each.captures and stage in (None, each.name):
                found.takes[each.name] = found.takes.get(each.name, 1) + 1
        found.log(who, "redone", stage, f"{stage or 'all captures'} again", reason=request.reason)
        return self._changed(found)

    def decide(self, stage_run: str, request: requests.Decide, who: str) -> ScanState:
        self.asked.append((who, "decide", request))
        scan, run = self._run(stage_run)
        run.decision = DecisionView(
            verdict=request.verdict, reason=request.reason, who=who, when=datetime.now(UTC)
        )
        scan.log(
            who,
            f"{request.verdict}ed",
            run.stage,
            f"{run.stage} {request.verdict}ed",
            reason=request.reason,
        )
        if request.verdict is Verdict.ACCEPT and request.proceed:
            self._start(scan, requests.StartRun(), who)
        return self._changed(scan)

    def run(self, scan: str, request: requests.StartRun, who: str) -> ScanState:
        self.asked.append((who, "run", request))
        found = self.find(scan)
        self._start(found, request, who)
        return self._changed(found)

    def cancel(self, scan: str, who: str) -> ScanState:
        self.asked.append((who, "cancel", None))
        found = self.find(scan)
        found.cancelled.set()
        self.go_on.set()
        found.log(who, "cancelled", found.job.stage if found.job else None, "Job cancelled")
        return self._changed(found)

    def keep(self, stage_run: str, who: str) -> CalibrationView:
        self.asked.append((who, "keep", stage_run))
        scan, run = self._run(stage_run)
        number = len(self.kept) + 1
        scan.kept[run.id] = number
        view = CalibrationView(
            number=number, type="TableHomography", title="Table homography", rig=scan.rig, scan=scan.id, scan_name=scan.name,
            stage=run.stage, who=who, when=datetime.now(UTC), result_hash=run.id, facts_hash="", calibration_hash=None, newest=True,
        )  # fmt: skip
        self.kept.insert(0, view)
        self._changed(scan)
        return view

    def calibrations(self, rig: str | None = None) -> tuple[CalibrationView, ...]:
        return tuple(self.kept)

    def give(self, scan: str, type_name: str, source: requests.GivenSource, who: str) -> ScanState:
        self.asked.append((who, "give", source))
        found = self.find(scan)
        found.homography = f"Calibration {source.calibration} of the rig: ‘Plane’, Bo"
        return self._changed(found)

    def take_away(self, scan: str, type_name: str, who: str) -> ScanState:
        self.asked.append((who, "take away", type_name))
        found = self.find(scan)
        found.homography = None
        return self._changed(found)

    def export(
        self, scan: str, folder: str, frames: bool, who: str, progress: Progress | None = None
    ) -> tuple[Path, ...]:
        self.asked.append((who, "export", folder))
        return (Path(folder) / "scan.json", Path(folder) / "cloud.ply")

    def import_capture(
        self, path: str, name: str, who: str, progress: Progress | None = None
    ) -> ScanState:
        raise NotFoundError(
            f"There is no file {path}; give the path of a capture.json on the server."
        )

    def accept_all(self, scan: Scan, who: str = "Bo") -> None:
        """Run a scan to its end, accepting whatever asks."""
        if not scan.is_running:
            self._start(scan, requests.StartRun(), who)
        self.finish_jobs()
        while scan.overall() == "awaiting_review":
            self.decide(scan.waiting().id, requests.Decide(verdict=Verdict.ACCEPT), who)
            self.finish_jobs()

    def finish_jobs(self) -> None:
        """Wait until no job runs."""
        for job in list(self._jobs):
            job.join()

    # ---- jobs

    def _changed(self, scan: Scan) -> ScanState:
        with self._lock:
            self.events.publish(ScanChanged(scan=scan.id, revision=scan.revision))
            return scan.state()

    def _start(self, scan: Scan, request: requests.StartRun, who: str) -> None:
        with self._lock:
            if scan.is_running:
                raise ConflictError(f"A job is running on {scan.name}; wait for it or cancel it.")
            scan.cancelled.clear()
            scan.job = JobView(
                id=secrets.token_hex(4), status=JobStatus.RUNNING, stage=None, progress=0, text="", remaining_s=None, error=None, who=who
            )  # fmt: skip
            job = threading.Thread(target=self._work, args=(scan, request))
            self._jobs = [j for j in self._jobs if j.is_alive()] + [job]
            job.start()

    def _work(self, scan: Scan, request: requests.StartRun) -> None:
        status = JobStatus.FINISHED
        for stage in scan.stages:
            if scan.current(stage) is None and not self._make(scan, stage):
                status = JobStatus.CANCELLED
                break
            if scan.status(stage) in (StageStatus.AWAITING_REVIEW, StageStatus.REJECTED):
                status = JobStatus.AWAITING_REVIEW
                break
            if stage.name == request.until:
                break
        self._note(scan, status=status, remaining_s=None)
        self._changed(scan)

    def _make(self, scan: Scan, stage: FakeStage) -> bool:
        """Make a stage's result; False if it was cancelled."""
        self._note(scan, stage=stage.name, progress=0.0, text=f"{stage.title} starts")
        self._changed(scan)
        for part in (0.25, 0.5, 0.75, 1.0):
            scan.cancelled.wait(self._tick_s)
            if part == 0.5:
                self.go_on.wait()
            if scan.cancelled.is_set():
                return False
            self._report(scan, stage, part)
        with self._lock:
            run = self.store.run_of(stage, scan.settings(stage.name))
            scan.runs[scan.key(stage)] = run
            scan.log("station", "finished", stage.name, run.result.sentence)
        self._changed(scan)
        return True

    def _report(self, scan: Scan, stage: FakeStage, part: float) -> None:
        text = f"Frame {int(part * 72)} of 72" if stage.captures else "Working"
        self._note(scan, progress=part, text=text, remaining_s=42.0 * (1 - part))
        assert scan.job is not None
        self.events.publish(JobProgress(scan=scan.id, job=scan.job))
        for camera in CAMERAS if stage.captures else ():
            self.events.publish(
                FrameCaptured(scan=scan.id, rig=scan.rig, camera=camera, artifact="", exposure_ms=PICTURE_MS, text=text)
            )  # fmt: skip

    def _note(self, scan: Scan, **changes: Any) -> None:
        with self._lock:
            assert scan.job is not None
            scan.job = scan.job.model_copy(update=changes)


def _refuse_stale(scan: Scan, stage: str, changes: Mapping[str, Any], revision: int) -> None:
    for edit in scan.edits[revision:]:
        if edit["stage"] == stage and edit["field"] in changes:
            sentence = f"{edit['who']} set {edit['field']} to {edit['new']} meanwhile; look at it, then edit again."
            raise StaleEditError(sentence, details={"edit": edit, "revision": scan.revision})


def _refuse_wrong(stage: FakeStage, settings: Mapping[str, Any]) -> None:
    try:
        stage.params.model_validate(settings)
    except ValidationError as error:
        first = error.errors()[0]
        sentence = f"{first['loc'][0]}: {first['msg']}, got {first['input']!r}."
        raise InvalidSettingError(sentence) from None
