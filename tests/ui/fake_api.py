"""A backend that measures nothing: answers in the contract's words, so that the user interface can be tried alone.

One process, one thread for the server, one per job. `FakeBackend` is the state that tests look into and steer;
`serve` puts it behind HTTP together with a small proxy to the station (`python -m app`), as the real one does.
"""

import asyncio
import contextlib
import io
import json
import os
import secrets
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any
from urllib.parse import quote

import cv2
import httpx
import numpy as np
import uvicorn
import websockets
from fastapi import FastAPI, Request, WebSocket
from fastapi.responses import Response, StreamingResponse

from backend.contract import requests as asked
from backend.contract.descriptions import MethodDescription, ShownDescription, StageDescription
from backend.contract.events import Event, FrameCaptured, JobProgress, ScanChanged
from backend.contract.problems import Problem
from backend.contract.rigs import (
    CameraView,
    PinholeView,
    PoseView,
    ProjectorView,
    RigOffer,
    RigView,
)
from backend.contract.scans import (
    ArtifactRef,
    AuditEntry,
    CheckView,
    DecisionView,
    FieldView,
    FrameRef,
    JobView,
    ScanState,
    ScanSummary,
    SettingView,
    StageState,
)
from tests.ui.fake_methods import METHODS, FakeField, FakeResult, FakeStage
from tests.ui.fake_scene import CAMERAS, scene

COLORMAPS = {
    "turbo": cv2.COLORMAP_TURBO,
    "viridis": cv2.COLORMAP_VIRIDIS,
    "twilight": cv2.COLORMAP_TWILIGHT,
    "inferno": cv2.COLORMAP_INFERNO,
}
PICTURE_MS = 33.3


class Refused(Exception):
    """Becomes a problem document."""

    def __init__(self, status: int, kind: str, sentence: str, **details: Any) -> None:
        super().__init__(sentence)
        self.problem = Problem(
            type=kind, title=kind, status=status, detail=sentence, details=details
        )


@dataclass
class Run:
    """One finished or failed stage."""

    id: str
    key: str
    result: FakeResult | None
    error: str = ""
    decision: DecisionView | None = None
    fields: tuple[FieldView, ...] = ()


@dataclass
class Scan:
    """A scan of the fake."""

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
    audit: list[AuditEntry] = field(default_factory=list)
    cancelled: threading.Event = field(default_factory=threading.Event)

    @property
    def stages(self) -> tuple[FakeStage, ...]:
        return METHODS[self.method][2]

    @property
    def revision(self) -> int:
        return len(self.edits)


class FakeBackend:
    """The state behind the endpoints.

    Parameters
    ----------
    tick_s
        Pause between two of the four progress reports of a stage; 0 for none.
    """

    def __init__(self, *, tick_s: float = 0.0) -> None:
        self.tick_s = tick_s
        self.scans: dict[str, Scan] = {}
        self.artifacts: dict[str, np.ndarray[Any, Any]] = {}
        self.points: dict[tuple[str, str], FakeResult] = {}
        self.requests: list[tuple[str, str, Any]] = []
        """(user, what, body) of every request that changes something."""
        self.lock = threading.RLock()
        self.go_on = threading.Event()
        self.go_on.set()
        """Cleared by a test to hold jobs in the middle of a stage."""
        self._listeners: list[tuple[asyncio.AbstractEventLoop, asyncio.Queue[Event]]] = []
        self._jobs: list[threading.Thread] = []

    # ---- events

    def publish(self, event: Event) -> None:
        for loop, queue in list(self._listeners):
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(queue.put_nowait, event)

    @contextlib.contextmanager
    def listening(self) -> Iterator[asyncio.Queue[Event]]:
        entry = (asyncio.get_running_loop(), asyncio.Queue[Event]())
        self._listeners.append(entry)
        try:
            yield entry[1]
        finally:
            self._listeners.remove(entry)

    def changed(self, scan: Scan) -> ScanState:
        self.publish(ScanChanged(scan=scan.id, revision=scan.revision))
        return self.state(scan)

    # ---- use cases

    def create(self, request: asked.CreateScan, who: str) -> Scan:
        if request.method not in METHODS:
            raise Refused(404, "not-found", f"There is no method {request.method!r}.")
        with self.lock:
            number = f"{147 + len(self.scans):04d}"
            now = datetime.now(UTC)
            scan = Scan(
                number,
                request.name or f"Scan {number}",
                request.note,
                request.method,
                request.rig,
                dict(request.rig_options),
                who,
                now,
            )
            self.scans[number] = scan
            self.note(
                scan, who, "created", None, f"Scan made with {request.method} on {request.rig}"
            )
        self.changed(scan)
        return scan

    def edit(self, scan: Scan, stage: str, request: asked.EditSettings, who: str) -> None:
        with self.lock:
            params = self.stage(scan, stage).params
            for name in (*request.changes, *request.reset):
                self._refuse_stale(scan, stage, name, request.revision)
                if name not in params.model_fields:
                    raise Refused(422, "invalid-setting", f"Stage {stage} has no setting {name!r}.")
            settings = self.settings(scan, stage) | request.changes
            try:
                params.model_validate(settings)
            except ValueError as error:
                first = error.errors()[0]  # type: ignore[attr-defined]
                raise Refused(
                    422,
                    "invalid-setting",
                    f"{first['loc'][0]}: {first['msg']}, got {first['input']!r}.",
                ) from None
            group = secrets.token_hex(4)
            for name, new in (request.changes | dict.fromkeys(request.reset)).items():
                row = {
                    "stage": stage,
                    "field": name,
                    "old": self.settings(scan, stage)[name],
                    "new": new,
                    "reset": name in request.reset,
                    "who": who,
                    "when": datetime.now(UTC).isoformat(),
                    "reason": request.reason,
                    "group": group,
                    "undone": False,
                    "revision": scan.revision + 1,
                }
                scan.edits.append(row)
                self.note(
                    scan,
                    who,
                    "edited",
                    stage,
                    f"{name}: {row['old']} to {new}",
                    reason=request.reason,
                )
        self.changed(scan)

    def _refuse_stale(self, scan: Scan, stage: str, name: str, revision: int) -> None:
        for edit in scan.edits[revision:]:
            if (edit["stage"], edit["field"]) == (stage, name):
                sentence = f"{edit['who']} set {name} to {edit['new']} meanwhile; look at it, then edit again."
                raise Refused(409, "stale-edit", sentence, edit=edit, revision=scan.revision)

    def undo(self, scan: Scan, who: str) -> None:
        with self.lock:
            open_edits = [e for e in scan.edits if not e["undone"]]
            if not open_edits:
                raise Refused(409, "conflict", "There is nothing to undo.")
            group = open_edits[-1]["group"]
            for edit in scan.edits:
                edit["undone"] |= edit["group"] == group
            self.note(
                scan, who, "undone", open_edits[-1]["stage"], f"Took back {open_edits[-1]['field']}"
            )
        self.changed(scan)

    def redo(self, scan: Scan, stage: str, request: asked.RedoStage, who: str) -> None:
        with self.lock:
            for s in scan.stages:
                if s.captures and (request.all or s.name == stage):
                    scan.takes[s.name] = scan.takes.get(s.name, 1) + 1
            what = "all captures" if request.all else stage
            self.note(scan, who, "redone", stage, f"{what} again", reason=request.reason)
        self.changed(scan)

    def decide(self, run_id: str, request: asked.Decide, who: str) -> Scan:
        with self.lock:
            scan, run = next(
                (s, r) for s in self.scans.values() for r in s.runs.values() if r.id == run_id
            )
            run.decision = DecisionView(
                verdict=request.verdict, reason=request.reason, who=who, when=datetime.now(UTC)
            )
            stage = run.key.split(":")[0]
            self.note(
                scan,
                who,
                f"{request.verdict}ed",
                stage,
                f"{stage} {request.verdict}ed",
                reason=request.reason,
            )
        self.changed(scan)
        if request.verdict == "accept" and request.proceed:
            self.start(scan, asked.StartRun(), who)
        return scan

    def cancel(self, scan: Scan, who: str) -> None:
        scan.cancelled.set()
        self.go_on.set()
        self.note(scan, who, "cancelled", scan.job.stage if scan.job else None, "Job cancelled")

    def note(
        self, scan: Scan, who: str, action: str, stage: str | None, sentence: str, **details: Any
    ) -> None:
        entry = AuditEntry(
            sequence=len(scan.audit) + 1,
            when=datetime.now(UTC),
            who=who,
            action=action,
            stage=stage,
            sentence=sentence,
            details=details,
        )
        scan.audit.append(entry)

    # ---- jobs

    def start(self, scan: Scan, request: asked.StartRun, who: str) -> None:
        with self.lock:
            if scan.job and scan.job.status == "running":
                raise Refused(
                    409,
                    "conflict",
                    f"A job of {scan.job.who} is running; wait for it or cancel it.",
                )
            scan.cancelled.clear()
            scan.job = JobView(
                id=secrets.token_hex(4),
                status="running",
                stage=None,
                progress=0,
                text="",
                remaining_s=None,
                error=None,
                who=who,
            )
            self._jobs = [t for t in self._jobs if t.is_alive()]
            job = threading.Thread(target=self._run, args=(scan, request), daemon=True)
            self._jobs.append(job)
            job.start()

    def finish_jobs(self) -> None:
        """Wait until no job runs."""
        for job in list(self._jobs):
            job.join()

    def _run(self, scan: Scan, request: asked.StartRun) -> None:
        status = "finished"
        for stage in scan.stages:
            run = self.current(scan, stage)
            if run is None or run.result is None:
                status = self._run_stage(scan, stage)
                if status != "finished":
                    break
            if (
                self.status(scan, stage) in ("awaiting_review", "rejected")
                and not request.unattended
            ):
                status = "awaiting_review"
                break
            if stage.name == request.until:
                break
        with self.lock:
            assert scan.job is not None
            scan.job = scan.job.model_copy(update={"status": status, "remaining_s": None})
        self.changed(scan)

    def _run_stage(self, scan: Scan, stage: FakeStage) -> str:
        with self.lock:
            assert scan.job is not None
            scan.job = scan.job.model_copy(
                update={"stage": stage.name, "progress": 0.0, "text": f"{stage.title} starts"}
            )
        self.changed(scan)
        for part in (0.25, 0.5, 0.75, 1.0):
            scan.cancelled.wait(self.tick_s)
            if part == 0.5:
                self.go_on.wait()
            if scan.cancelled.is_set():
                return "cancelled"
            self._progress(scan, stage, part)
        with self.lock:
            run = Run(secrets.token_hex(6), self.key(scan, stage), None)
            run.result = stage.make(self.settings(scan, stage.name))
            run.fields = tuple(self._view(f) for f in run.result.fields)
            scan.runs[run.key] = run
            self.note(scan, "station", "finished", stage.name, run.result.sentence)
        self.changed(scan)
        return "finished"

    def _progress(self, scan: Scan, stage: FakeStage, part: float) -> None:
        with self.lock:
            assert scan.job is not None
            text = f"Frame {int(part * 72)} of 72" if stage.captures else "Working"
            scan.job = scan.job.model_copy(
                update={"progress": part, "text": text, "remaining_s": 42.0 * (1 - part)}
            )
            job = scan.job
        self.publish(JobProgress(scan=scan.id, job=job))
        if stage.captures:
            for camera in CAMERAS:
                self.publish(
                    FrameCaptured(
                        scan=scan.id,
                        rig=scan.rig,
                        camera=camera,
                        artifact="",
                        exposure_ms=PICTURE_MS,
                        text=text,
                    )
                )

    # ---- the state in the contract's words

    def stage(self, scan: Scan, name: str) -> FakeStage:
        return next(s for s in scan.stages if s.name == name)

    def settings(self, scan: Scan, stage: str) -> dict[str, Any]:
        values = self.stage(scan, stage).params().model_dump(mode="json")
        default = dict(values)
        for edit in scan.edits:
            if edit["stage"] == stage and not edit["undone"]:
                values[edit["field"]] = default[edit["field"]] if edit["reset"] else edit["new"]
        return values

    def key(self, scan: Scan, stage: FakeStage) -> str:
        """Today's key: the settings and takes up to this stage."""
        upto = scan.stages[: scan.stages.index(stage) + 1]
        parts = [[s.name, self.settings(scan, s.name), scan.takes.get(s.name, 1)] for s in upto]
        return f"{stage.name}:{json.dumps(parts, sort_keys=True)}"

    def current(self, scan: Scan, stage: FakeStage) -> Run | None:
        return scan.runs.get(self.key(scan, stage))

    def status(self, scan: Scan, stage: FakeStage) -> str:
        job, run = scan.job, self.current(scan, stage)
        if run is None and job and job.status == "running" and job.stage == stage.name:
            return "running"
        if run is None:
            return "pending"
        if run.result is None:
            return "failed"
        if run.decision:
            return f"{run.decision.verdict}ed"
        worst = max(
            (("ok", "warning", "failure").index(c["level"]) for c in run.result.checks), default=0
        )
        limit = {"always": 0, "on_warning": 1, "on_failure": 2}[stage.review]
        return "awaiting_review" if worst >= limit else "done"

    def state(self, scan: Scan) -> ScanState:
        with self.lock:
            undone = [e for e in scan.edits if not e["undone"]]
            return ScanState(
                id=scan.id, name=scan.name, note=scan.note, method=scan.method, rig=scan.rig, rig_options=scan.rig_options,
                created=scan.created, who=scan.who, revision=scan.revision, preset=None, status=self.scan_status(scan),
                stages=tuple(self._stage_state(scan, s) for s in scan.stages), job=scan.job,
                undo=f"{undone[-1]['field']} of {undone[-1]['stage']}" if undone else None,
            )  # fmt: skip

    def scan_status(self, scan: Scan) -> str:
        if scan.job and scan.job.status == "running":
            return "running"
        statuses = [self.status(scan, s) for s in scan.stages]
        if "awaiting_review" in statuses:
            return "awaiting_review"
        return "done" if all(s in ("done", "accepted") for s in statuses) else "idle"

    def summary(self, scan: Scan) -> ScanSummary:
        done = sum(self.status(scan, s) in ("done", "accepted") for s in scan.stages)
        points = [
            len(f.arrays[""])
            for r in scan.runs.values()
            if r.result
            for f in r.result.fields
            if f.hint["kind"] == "points"
        ]
        return ScanSummary(
            id=scan.id,
            name=scan.name,
            method=scan.method,
            rig=scan.rig,
            created=scan.created,
            who=scan.who,
            status=self.scan_status(scan),
            stages_done=done,
            stages=len(scan.stages),
            points=points[-1] if points else None,
        )

    def _stage_state(self, scan: Scan, stage: FakeStage) -> StageState:
        run, edited = (
            self.current(scan, stage),
            {
                e["field"]
                for e in scan.edits
                if e["stage"] == stage.name and not e["undone"] and not e["reset"]
            },
        )
        result = run.result if run else None
        chosen = {f.name: f.value for f in result.fields} if result else {}
        for f in result.fields if result else ():
            if f.hint.get("valleys"):
                chosen["valleys_gray"] = [9.0, 48.0, 117.0, 238.0]
            if f.hint.get("edits") == "exposures_ms":
                chosen["exposures_ms"] = [row["exposure_ms"] for row in f.value]
        autos = {
            n: (p.json_schema_extra or {}).get("auto") for n, p in stage.params.model_fields.items()
        }  # type: ignore[union-attr]
        settings = {
            name: SettingView(
                value=value,
                source="edited" if name in edited else "default",
                chosen=chosen.get(str(autos[name])) if value is None else None,
            )
            for name, value in self.settings(scan, stage.name).items()
        }
        status = self.status(scan, stage)
        message = (
            result.sentence
            if result
            else {"running": "Running", "failed": run.error if run else ""}.get(
                status, "Not run yet"
            )
        )
        return StageState(
            name=stage.name, title=stage.title, status=status, message=message, key=self.key(scan, stage), stage_run=run.id if run else None,
            take=scan.takes.get(stage.name, 1), settings=settings, checks=tuple(CheckView(**c) for c in (result.checks if result else ())),
            fields=run.fields if run else (), decision=run.decision if run else None, duration_s=0.84 if result else None, started=scan.created if result else None,
            result_hash=run.id if result else None,
        )  # fmt: skip

    def _view(self, field: FakeField) -> FieldView:
        frames = tuple(
            FrameRef(**{k: v for k, v in f.items() if k != "image"}, image=self._store(f["image"]))
            for f in field.frames
        )
        arrays = {camera: self._store(array) for camera, array in field.arrays.items()}
        return FieldView(
            name=field.name,
            hint=field.hint,
            per_camera=field.per_camera,
            value=field.value,
            arrays=arrays,
            frames=frames,
        )

    def _store(self, array: np.ndarray[Any, Any]) -> ArtifactRef:
        import hashlib

        name = hashlib.sha256(
            array.tobytes() + str((array.shape, array.dtype)).encode()
        ).hexdigest()[:32]
        self.artifacts[name] = array
        return ArtifactRef(hash=name, shape=array.shape, dtype=str(array.dtype))


def describe(name: str) -> MethodDescription:
    title, doc, stages = METHODS[name]
    described = tuple(
        StageDescription(
            name=s.name, title=s.title, doc=s.doc, version=1, review=s.review, captures=s.captures, inputs=(), output="Result",
            settings=s.params.model_json_schema(),
            shown=tuple(ShownDescription(name=f.name, per_camera=f.per_camera, hint=f.hint) for f in s.make(s.params().model_dump(mode="json")).fields),
        )
        for s in stages
    )  # fmt: skip
    return MethodDescription(
        name=name, title=title, doc=doc, stages=described, given=("RigFacts",), presets={"fast": {}}
    )


def rig_view(options: dict[str, Any]) -> RigView:
    s = scene()
    K = tuple(map(tuple, s.intrinsics()))
    model = PinholeView(width_px=s.width_px, height_px=s.height_px, K=K, distortion=(0.0,) * 5)
    R, t = s.right_from_left()
    identity = PoseView(R=((1, 0, 0), (0, 1, 0), (0, 0, 1)), t_mm=(0, 0, 0))
    poses = {"left": identity, "right": PoseView(R=tuple(map(tuple, R)), t_mm=tuple(t))}
    cameras = tuple(
        CameraView(
            name=c,
            width_px=s.width_px,
            height_px=s.height_px,
            bit_depth=8,
            exposure_min_ms=0.1,
            exposure_max_ms=1000,
            model=model,
            camera_from_world=poses[c],
        )
        for c in CAMERAS
    )
    half = s.toe_in_rad / 2
    c, sn = np.cos(half), np.sin(half)
    projector_R = np.array([[c, 0, sn], [0, 1, 0], [-sn, 0, c]])
    centre = 90.0 * np.array([np.cos(half), 0, np.sin(half)]) + np.array([0, -40.0, 0])
    pose = PoseView(R=tuple(map(tuple, projector_R)), t_mm=tuple(-projector_R @ centre))
    K_p = ((1.75 * 1280, 0.0, 639.5), (0.0, 1.75 * 1280, 399.5), (0.0, 0.0, 1.0))
    projector = ProjectorView(
        width_px=1280,
        height_px=800,
        frame_period_ms=8.3333,
        model=PinholeView(width_px=1280, height_px=800, K=K_p, distortion=(0.0,) * 5),
        projector_from_world=pose,
    )
    return RigView(
        name="simulated",
        title="Simulated rig",
        options=options,
        reference="left",
        cameras=cameras,
        projector=projector,
    )


OPTIONS_SCHEMA = {
    "type": "object",
    "properties": {
        "scene": {"title": "Scene", "enum": ["high-contrast", "metal", "workpieces", "sphere"], "default": "high-contrast"},
        "width_px": {"title": "Width", "type": "integer", "minimum": 320, "maximum": 2592, "default": 1280, "unit": "px"},
        "height_px": {"title": "Height", "type": "integer", "minimum": 240, "maximum": 1944, "default": 960, "unit": "px"},
        "seed": {"title": "Noise seed", "type": "integer", "default": 1},
    },
}  # fmt: skip


def preview(array: np.ndarray[Any, Any], query: Any) -> bytes:
    """Draw a map as the real endpoint does."""
    data = array.astype(np.float32)
    low = float(query["low"]) if "low" in query else float(np.nanpercentile(data, 1))
    high = float(query["high"]) if "high" in query else float(np.nanpercentile(data, 99))
    scaled = np.clip((data - low) / max(high - low, 1e-9), 0, 1)
    missing = ~np.isfinite(scaled)
    gray = (255 * np.nan_to_num(scaled)).astype(np.uint8)
    colormap = query.get("colormap", "gray")
    picture = (
        cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
        if colormap == "gray"
        else cv2.applyColorMap(gray, COLORMAPS[colormap])
    )
    picture[missing] = (32, 28, 26)
    shrink = int(query.get("max_px", 1280)) / max(array.shape)
    if shrink < 1:
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg" if query.get("format") == "jpeg" else ".png", picture)[1].tobytes()


def pack_points(result: FakeResult, budget: int) -> bytes:
    by_name = {f.name: f for f in result.fields}
    points = next(f for f in result.fields if f.hint["kind"] == "points")
    xyz = points.arrays[""]
    step = max(1, -(-len(xyz) // budget))
    scalars = {n: by_name[n].arrays[""][::step] for n in points.hint["scalars"]}
    facts = {
        n: {
            "unit": by_name[n].hint["unit"],
            "title": by_name[n].hint["title"],
            "low": float(np.percentile(v, 1)),
            "high": float(np.percentile(v, 99)),
        }
        for n, v in scalars.items()
    }
    header = json.dumps({"n": len(xyz[::step]), "total": len(xyz), "scalars": facts}).encode()
    parts = [
        len(header).to_bytes(4, "little"),
        header,
        xyz[::step].astype("<f4").tobytes(),
        by_name["colour"].arrays[""][::step].tobytes(),
    ]
    return b"".join(parts + [v.astype("<f4").tobytes() for v in scalars.values()])


# ---- HTTP


@dataclass
class Login:
    user: str
    role: str


def make_app(backend: FakeBackend, station: "Station") -> FastAPI:
    """The endpoints of the real backend that the user interface calls, and the proxy to the station."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    logins: dict[str, Login] = {}

    def who(request: Request | WebSocket) -> Login:
        header = request.headers.get("authorization", "")
        token = header.removeprefix("Bearer ") if header else request.cookies.get("fake", "")
        if token not in logins:
            raise Refused(401, "not-logged-in", "Nobody is logged in.")
        return logins[token]

    async def operator(request: Request) -> str:
        login = who(request)
        body = await request.body()
        backend.requests.append(
            (login.user, f"{request.method} {request.url.path}", json.loads(body) if body else None)
        )
        if login.role != "operator":
            raise Refused(403, "refused", f"{login.user} may look but not change anything.")
        return login.user

    def scan_of(scan_id: str) -> Scan:
        if scan_id not in backend.scans:
            raise Refused(404, "not-found", f"There is no scan {scan_id}.")
        return backend.scans[scan_id]

    @app.exception_handler(Refused)
    async def refused(_: Request, error: Refused) -> Response:
        return Response(
            error.problem.model_dump_json(),
            error.problem.status,
            media_type="application/problem+json",
        )

    @app.get("/login")
    def login(role: str = "operator", user: str = "Anna") -> Response:
        token = secrets.token_hex(8)
        logins[token] = Login(user, role)
        answer = Response(status_code=303, headers={"Location": "/station/"})
        answer.set_cookie("fake", token)
        return answer

    @app.get("/api/me")
    def me(request: Request) -> Any:
        login = who(request)
        return {"user": login.user, "role": login.role}

    @app.get("/api/methods")
    def methods(request: Request) -> Any:
        who(request)
        return {"methods": [describe(m).model_dump(mode="json") for m in METHODS], "broken": {}}

    @app.get("/api/rigs")
    def rigs(request: Request) -> Any:
        who(request)
        return [RigOffer(name="simulated", title="Simulated rig", doc="Ray-cast scenes.", options_schema=OPTIONS_SCHEMA).model_dump(),
                RigOffer(name="broken", title="Broken rig", doc="", options_schema={}, error="No module named 'vendor_sdk'.").model_dump()]  # fmt: skip

    @app.post("/api/rigs/{name}/view")
    async def view(name: str, request: Request) -> Any:
        who(request)
        return rig_view(await request.json()).model_dump()

    @app.get("/api/rigs/{name}/cameras/{camera}/preview")
    def live(name: str, camera: str, request: Request) -> Response:
        who(request)
        return Response(
            preview(
                scene().white(camera, PICTURE_MS),
                {"format": "jpeg", "max_px": 640, "low": 0, "high": 255},
            ),
            media_type="image/jpeg",
        )

    @app.get("/api/scans")
    def scans(request: Request, limit: int = 50, offset: int = 0, text: str = "") -> Any:
        who(request)
        found = [
            s
            for s in reversed(backend.scans.values())
            if text.lower() in f"{s.name} {s.id} {s.method}".lower()
        ]
        return [backend.summary(s).model_dump(mode="json") for s in found[offset : offset + limit]]

    @app.post("/api/scans")
    async def create(request: Request) -> Any:
        user = await operator(request)
        scan = backend.create(asked.CreateScan.model_validate_json(await request.body()), user)
        return backend.state(scan).model_dump(mode="json")

    @app.get("/api/scans/{scan_id}")
    def scan(scan_id: str, request: Request) -> Any:
        who(request)
        return backend.state(scan_of(scan_id)).model_dump(mode="json")

    @app.get("/api/scans/{scan_id}/rig")
    def rig_of(scan_id: str, request: Request) -> Any:
        who(request)
        return rig_view(scan_of(scan_id).rig_options).model_dump()

    @app.patch("/api/scans/{scan_id}/settings/{stage}")
    async def edit(scan_id: str, stage: str, request: Request) -> Any:
        user = await operator(request)
        backend.edit(
            scan_of(scan_id),
            stage,
            asked.EditSettings.model_validate_json(await request.body()),
            user,
        )
        return backend.state(scan_of(scan_id)).model_dump(mode="json")

    @app.post("/api/scans/{scan_id}/undo")
    async def undo(scan_id: str, request: Request) -> Any:
        backend.undo(scan_of(scan_id), await operator(request))
        return backend.state(scan_of(scan_id)).model_dump(mode="json")

    @app.post("/api/scans/{scan_id}/redo/{stage}")
    async def redo(scan_id: str, stage: str, request: Request) -> Any:
        user = await operator(request)
        backend.redo(
            scan_of(scan_id), stage, asked.RedoStage.model_validate_json(await request.body()), user
        )
        return backend.state(scan_of(scan_id)).model_dump(mode="json")

    @app.post("/api/scans/{scan_id}/runs", status_code=202)
    async def run(scan_id: str, request: Request) -> Any:
        user = await operator(request)
        backend.start(
            scan_of(scan_id), asked.StartRun.model_validate_json(await request.body()), user
        )
        return backend.state(scan_of(scan_id)).model_dump(mode="json")

    @app.delete("/api/scans/{scan_id}/runs")
    async def cancel(scan_id: str, request: Request) -> Any:
        backend.cancel(scan_of(scan_id), await operator(request))
        return backend.state(scan_of(scan_id)).model_dump(mode="json")

    @app.get("/api/scans/{scan_id}/audit")
    def audit(scan_id: str, request: Request) -> Any:
        who(request)
        return [e.model_dump(mode="json") for e in scan_of(scan_id).audit]

    @app.post("/api/scans/{scan_id}/export")
    async def export(scan_id: str, request: Request) -> Any:
        user = await operator(request)
        wish = asked.ExportScan.model_validate_json(await request.body())
        backend.note(scan_of(scan_id), user, "exported", None, f"Exported to {wish.folder}")
        return [f"{wish.folder}/scan.json", f"{wish.folder}/cloud.ply"]

    @app.post("/api/imports")
    async def imports(request: Request) -> Any:
        await operator(request)
        wish = asked.ImportCapture.model_validate_json(await request.body())
        raise Refused(
            404,
            "not-found",
            f"There is no file {wish.path}; give the path of a capture.json that the server can read.",
        )

    @app.post("/api/stage-runs/{run_id}/decision")
    async def decide(run_id: str, request: Request) -> Any:
        user = await operator(request)
        scan = backend.decide(run_id, asked.Decide.model_validate_json(await request.body()), user)
        return backend.state(scan).model_dump(mode="json")

    @app.get("/api/artifacts/{name}")
    def artifact(name: str, request: Request) -> Response:
        who(request)
        body = io.BytesIO()
        np.save(body, backend.artifacts[name])
        return Response(body.getvalue(), media_type="application/octet-stream")

    @app.get("/api/artifacts/{name}/preview")
    def artifact_preview(name: str, request: Request) -> Response:
        who(request)
        kind = request.query_params.get("format", "png")
        return Response(
            preview(backend.artifacts[name], request.query_params),
            media_type=f"image/{kind}",
            headers={"Cache-Control": "max-age=31536000, immutable"},
        )

    @app.get("/api/artifacts/{name}/at")
    def artifact_at(name: str, x: int, y: int, request: Request) -> Any:
        who(request)
        value = backend.artifacts[name][y, x].item()
        return {"value": None if isinstance(value, float) and not np.isfinite(value) else value}

    @app.get("/api/stage-runs/{run_id}/fields/{field_name}/points")
    def points(run_id: str, field_name: str, request: Request, budget: int = 300_000) -> Response:
        who(request)
        result = next(
            r.result for s in backend.scans.values() for r in s.runs.values() if r.id == run_id
        )
        assert result is not None
        return Response(pack_points(result, budget), media_type="application/octet-stream")

    @app.get("/api/events")
    async def events(request: Request) -> Response:
        who(request)

        async def stream() -> AsyncIterator[str]:
            with backend.listening() as queue:
                yield ": hello\n\n"
                while True:
                    try:
                        event = await asyncio.wait_for(queue.get(), 5.0)
                        yield f"event: {event.kind}\ndata: {event.model_dump_json()}\n\n"
                    except TimeoutError:
                        yield ": still here\n\n"

        return StreamingResponse(stream(), media_type="text/event-stream")

    @app.get("/station/{path:path}")
    async def page(path: str, request: Request) -> Response:
        who(request)
        async with httpx.AsyncClient(trust_env=False) as http:
            answer = await http.get(
                f"http://127.0.0.1:{station.port}/{path}",
                headers={"X-Station-Secret": station.secret, "Accept-Encoding": "identity"},
            )
        return Response(
            answer.content, answer.status_code, media_type=answer.headers["content-type"]
        )

    @app.websocket("/station")
    async def tunnel(browser: WebSocket) -> None:
        login = who(browser)
        headers = {
            "X-Station-Secret": station.secret,
            "X-Station-User": quote(login.user),
            "X-Station-Role": login.role,
            "X-Station-Token": browser.cookies["fake"],
        }
        async with websockets.connect(
            f"ws://127.0.0.1:{station.port}/",
            subprotocols=browser.scope["subprotocols"],
            compression=None,
            max_size=None,
            proxy=None,
            additional_headers=headers,
        ) as up:
            await browser.accept(subprotocol=up.subprotocol)

            async def down() -> None:
                async for message in up:
                    await browser.send_bytes(message)  # type: ignore[arg-type]

            async def upward() -> None:
                while (event := await browser.receive())["type"] != "websocket.disconnect":
                    if event.get("bytes") is not None:
                        station.seen(event["bytes"])
                        await up.send(event["bytes"])

            tasks = [asyncio.create_task(down()), asyncio.create_task(upward())]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    return app


@dataclass
class Station:
    """The child process `python -m app`."""

    secret: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    port: int = 0
    process: subprocess.Popen[str] | None = None
    messages: list[bytes] = field(default_factory=list)
    """Everything that browsers sent."""

    def start(self, api_url: str, **environment: str) -> None:
        env = (
            os.environ
            | {"UNGLARE_STATION_SECRET": self.secret, "UNGLARE_API_URL": api_url}
            | environment
        )
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=env,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the station died during its start"
        self.port = json.loads(line)["port"]

    def seen(self, message: bytes) -> None:
        self.messages.append(message)

    def stop(self) -> None:
        assert (
            self.process is not None
            and self.process.stdin is not None
            and self.process.stdout is not None
        )
        self.process.stdin.close()
        try:
            self.process.wait(10)
        finally:
            self.process.kill()
            self.process.stdout.close()


@dataclass(frozen=True)
class Served:
    """A running fake with its station."""

    url: str
    backend: FakeBackend
    station: Station


@contextlib.contextmanager
def serve(backend: FakeBackend, *, port: int = 0, **environment: str) -> Iterator[Served]:
    """Serve the fake and its station until the block ends."""
    station = Station()
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", port))
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        config = uvicorn.Config(
            make_app(backend, station),
            log_level="warning",
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            ws="websockets-sansio",
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        station.start(url, **environment)
        try:
            yield Served(url, backend, station)
        finally:
            station.stop()
            server.should_exit = True
            thread.join(10)


def fill(backend: FakeBackend) -> None:
    """Make a few scans as an operator would find them in the morning."""
    for days, name in (
        (3, "Bracket, black anodised"),
        (2, "Turbine blade 7"),
        (1, "Bust and book"),
    ):
        scan = backend.create(asked.CreateScan(method="hdr-fringe", name=name), "Bo")
        scan.created -= timedelta(days=days, minutes=37 * days)


if __name__ == "__main__":
    demo = FakeBackend(tick_s=float(os.environ.get("FAKE_TICK_S", "0.2")))
    fill(demo)
    with serve(demo, port=int(os.environ.get("FAKE_PORT", "8099"))) as served:
        print(served.url + "/login", flush=True)
        threading.Event().wait()
