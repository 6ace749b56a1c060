"""The backend's endpoints as typed functions; the only place that knows addresses."""

import io
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from urllib.parse import quote, urlencode

import httpx
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from backend.contract.descriptions import MethodDescription, MethodList
from backend.contract.events import Event
from backend.contract.problems import Problem
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
from backend.contract.rigs import (
    DiscoverCameras,
    Discovery,
    LatencyView,
    LiveSettings,
    LiveView,
    PartView,
    RigOffer,
    RigState,
    RigView,
    StartLatency,
)
from backend.contract.scans import (
    ArtifactRef,
    AuditEntry,
    CalibrationView,
    PixelLevels,
    ScanState,
    ScanSummary,
)

Array = NDArray[Any]
T = TypeVar("T")

_METHODS = TypeAdapter(MethodList)
_RIGS: TypeAdapter[tuple[RigOffer, ...]] = TypeAdapter(tuple[RigOffer, ...])
_RIG = TypeAdapter(RigView)
_RIG_STATE = TypeAdapter(RigState)
_LIVE = TypeAdapter(LiveView)
_PART: TypeAdapter[PartView | None] = TypeAdapter(PartView | None)
_LATENCY: TypeAdapter[LatencyView | None] = TypeAdapter(LatencyView | None)
_DISCOVERY = TypeAdapter(Discovery)
_SCANS: TypeAdapter[tuple[ScanSummary, ...]] = TypeAdapter(tuple[ScanSummary, ...])
_SCAN = TypeAdapter(ScanState)
_AUDIT: TypeAdapter[tuple[AuditEntry, ...]] = TypeAdapter(tuple[AuditEntry, ...])
_PATHS: TypeAdapter[tuple[str, ...]] = TypeAdapter(tuple[str, ...])
_LEVELS = TypeAdapter(PixelLevels)
_REFERENCE = TypeAdapter(ArtifactRef)
_CALIBRATION = TypeAdapter(CalibrationView)
_CALIBRATIONS: TypeAdapter[tuple[CalibrationView, ...]] = TypeAdapter(tuple[CalibrationView, ...])
_DOCUMENT: TypeAdapter[dict[str, Any]] = TypeAdapter(dict[str, Any])

_RETRY_S = 1.0
"""Pause before the event stream is opened again."""
_SILENCE_S = 60.0
"""An event stream that is silent for longer is opened again: the server sends signs of life."""
_ALIVE_IN_MEMORY_BYTES = 256 * 2**20


class ApiError(Exception):
    """The API refused; `problem.detail` is the one sentence for the operator."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


@dataclass(frozen=True)
class ScalarOfPoints:
    """A quantity that points can be coloured by."""

    name: str
    title: str
    unit: str
    low: float
    high: float
    values: Array


@dataclass(frozen=True)
class PointsPreview:
    """Points of a cloud, thinned to what was asked for."""

    total: int
    """Number of points of the whole cloud."""
    points_mm: Array
    colour: Array | None
    """n x 3 uint8, if the cloud has a colour."""
    scalars: tuple[ScalarOfPoints, ...]

    def with_more(self, more: "PointsPreview") -> "PointsPreview":
        """Return both together; what the ends of the colours mean stays."""
        if not len(more.points_mm):
            return self
        colour = None
        if self.colour is not None and more.colour is not None:
            colour = np.concatenate([self.colour, more.colour])
        scalars = tuple(
            replace(mine, values=np.concatenate([mine.values, other.values]))
            for mine, other in zip(self.scalars, more.scalars, strict=True)
        )
        points_mm = np.concatenate([self.points_mm, more.points_mm])
        return PointsPreview(self.total, points_mm, colour, scalars)


class ApiClient:
    """Calls the API on behalf of one user.

    Parameters
    ----------
    base_url
        Where the backend listens on loopback, without `/api`.
    token
        The session's token that the proxy handed over.
    """

    def __init__(self, base_url: str, token: str, *, timeout_s: float = 300.0) -> None:
        self._http = httpx.Client(
            base_url=base_url,
            headers={"Authorization": f"Bearer {token}"},
            timeout=httpx.Timeout(timeout_s, connect=5.0),
            trust_env=False,
        )
        self._arrays = _ArrayMemory(_ALIVE_IN_MEMORY_BYTES)

    def close(self) -> None:
        """Give up all connections."""
        self._http.close()

    # ---- methods and rigs

    def methods(self) -> tuple[MethodDescription, ...]:
        """Return all measuring methods."""
        return self._get("/api/methods", _METHODS).methods

    def rigs(self) -> tuple[RigOffer, ...]:
        """Return the rigs that a scan can be made with."""
        return self._get("/api/rigs", _RIGS)

    def rig(self, name: str, options: dict[str, Any]) -> RigView:
        """Open a rig with these options and describe it."""
        return self._send("POST", f"/api/rigs/{quote(name)}/view", options, _RIG)

    def rig_of(self, scan_id: str) -> RigView:
        """Describe the rig of a scan."""
        return self._get(f"/api/scans/{quote(scan_id)}/rig", _RIG)

    def camera_picture(
        self, rig: str, camera: str, *, max_px: int = 960, marks: bool = False
    ) -> bytes | None:
        """Return the newest picture of a camera as JPEG, None if there is none; `marks` colour what is too bright or dark."""
        query = {"max_px": max_px, "marks": marks}
        return self._picture(f"/api/rigs/{quote(rig)}/cameras/{quote(camera)}/preview", query)

    def camera_part(
        self, rig: str, camera: str, x: int, y: int, *, size_px: int, marks: bool
    ) -> bytes | None:
        """Return a square part of the newest picture of a camera, pixel by pixel; None if there is none."""
        query = {"x": x, "y": y, "part_px": size_px, "marks": marks}
        return self._picture(f"/api/rigs/{quote(rig)}/cameras/{quote(camera)}/preview", query)

    def part_numbers(
        self, rig: str, camera: str, x: int, y: int, *, size_px: int
    ) -> PartView | None:
        """Tell how bright and how sharp a square part of the newest picture is; None if there is none."""
        query = {"x": x, "y": y, "part_px": size_px}
        return self._get(f"/api/rigs/{quote(rig)}/cameras/{quote(camera)}/part", _PART, query)

    # ---- a rig without a scan

    def rig_state(self, rig: str) -> RigState:
        """Tell how a rig is doing."""
        return self._get(f"/api/rigs/{quote(rig)}/state", _RIG_STATE)

    def connect(self, rig: str, options: dict[str, Any]) -> RigState:
        """Have a rig opened; the state tells when it is."""
        return self._send("POST", f"/api/rigs/{quote(rig)}/connect", options, _RIG_STATE)

    def disconnect(self, rig: str) -> RigState:
        """Have its devices closed."""
        return self._send("POST", f"/api/rigs/{quote(rig)}/disconnect", None, _RIG_STATE)

    def reconnect(self, rig: str) -> RigState:
        """Have it closed and opened again."""
        return self._send("POST", f"/api/rigs/{quote(rig)}/reconnect", None, _RIG_STATE)

    def live(self, rig: str) -> LiveView:
        """Tell what the newest pictures of a rig say."""
        return self._get(f"/api/rigs/{quote(rig)}/live", _LIVE)

    def watch(self, rig: str) -> LiveView:
        """Have live pictures taken for the next seconds; tell what the newest ones say."""
        return self._send("POST", f"/api/rigs/{quote(rig)}/live", None, _LIVE)

    def set_live(self, rig: str, settings: LiveSettings) -> LiveView:
        """Set how live pictures are taken; the answer has the settings in force."""
        return self._send("PUT", f"/api/rigs/{quote(rig)}/live", settings, _LIVE)

    def end_live(self, rig: str) -> LiveView:
        """End live pictures now."""
        return self._send("DELETE", f"/api/rigs/{quote(rig)}/live", None, _LIVE)

    def check_rig(self, rig: str) -> RigState:
        """Begin to check a rig."""
        return self._send("POST", f"/api/rigs/{quote(rig)}/check", None, _RIG_STATE)

    def start_latency(self, rig: str, request: StartLatency) -> RigState:
        """Begin to measure the latency of a rig's projector."""
        return self._send("POST", f"/api/rigs/{quote(rig)}/latency", request, _RIG_STATE)

    def latency(self, rig: str) -> LatencyView | None:
        """Return the latency measured last or kept for a rig."""
        return self._get(f"/api/rigs/{quote(rig)}/latency", _LATENCY)

    def cancel_work(self, rig: str) -> RigState:
        """Have the check or latency calibration ended that runs."""
        return self._send("DELETE", f"/api/rigs/{quote(rig)}/work", None, _RIG_STATE)

    def discover(self, request: DiscoverCameras) -> Discovery:
        """Ask addresses for cameras, or search."""
        return self._send("POST", "/api/rigs/discover", request, _DISCOVERY)

    # ---- scans

    def scans(self, *, limit: int, offset: int = 0, text: str = "") -> tuple[ScanSummary, ...]:
        """Return a page of the scan list, newest first."""
        query = {"limit": limit, "offset": offset, "text": text}
        return self._get("/api/scans", _SCANS, query)

    def scan(self, scan_id: str) -> ScanState:
        """Return the whole state of a scan."""
        return self._get(f"/api/scans/{quote(scan_id)}", _SCAN)

    def create(self, request: CreateScan) -> ScanState:
        """Make a new scan."""
        return self._send("POST", "/api/scans", request, _SCAN)

    def edit(self, scan_id: str, stage: str, request: EditSettings) -> ScanState:
        """Change settings of a stage."""
        path = f"/api/scans/{quote(scan_id)}/settings/{quote(stage)}"
        return self._send("PATCH", path, request, _SCAN)

    def undo(self, scan_id: str, request: UndoEdit) -> ScanState:
        """Take back the last edit."""
        return self._send("POST", f"/api/scans/{quote(scan_id)}/undo", request, _SCAN)

    def redo(self, scan_id: str, stage: str, request: RedoStage) -> ScanState:
        """Take the pictures of a stage (or of all) again."""
        path = f"/api/scans/{quote(scan_id)}/redo/{quote(stage)}"
        return self._send("POST", path, request, _SCAN)

    def run(self, scan_id: str, request: StartRun) -> ScanState:
        """Run what isn't current."""
        return self._send("POST", f"/api/scans/{quote(scan_id)}/runs", request, _SCAN)

    def cancel(self, scan_id: str) -> ScanState:
        """Cancel the running job."""
        return self._send("DELETE", f"/api/scans/{quote(scan_id)}/runs", None, _SCAN)

    def decide(self, stage_run: str, request: Decide) -> ScanState:
        """Accept or reject a result."""
        path = f"/api/stage-runs/{quote(stage_run)}/decision"
        return self._send("POST", path, request, _SCAN)

    def audit(self, scan_id: str) -> tuple[AuditEntry, ...]:
        """Return who did what and when."""
        return self._get(f"/api/scans/{quote(scan_id)}/audit", _AUDIT)

    def keep(self, stage_run: str) -> CalibrationView:
        """Keep a result for its rig."""
        path = f"/api/stage-runs/{quote(stage_run)}/calibration"
        return self._send("POST", path, None, _CALIBRATION)

    def calibrations(self, rig: str) -> tuple[CalibrationView, ...]:
        """Return what was ever kept for a rig, newest first."""
        return self._get(f"/api/rigs/{quote(rig)}/calibrations", _CALIBRATIONS)

    def give(self, scan_id: str, type_name: str, source: GivenSource) -> ScanState:
        """Hand a result to a scan."""
        path = f"/api/scans/{quote(scan_id)}/given/{quote(type_name)}"
        return self._send("PUT", path, source, _SCAN)

    def take_away(self, scan_id: str, type_name: str) -> ScanState:
        """Take a handed-over result away."""
        path = f"/api/scans/{quote(scan_id)}/given/{quote(type_name)}"
        return self._send("DELETE", path, None, _SCAN)

    def export(self, scan_id: str, request: ExportScan) -> tuple[str, ...]:
        """Write the results into a folder of the server; return what was written."""
        path = f"/api/scans/{quote(scan_id)}/export"
        return self._send("POST", path, request, _PATHS)

    def import_capture(self, request: ImportCapture) -> ScanState:
        """Import a captured folder."""
        return self._send("POST", "/api/imports", request, _SCAN)

    # ---- arrays

    def array(self, artifact: str) -> Array:
        """Return an array of the store, from memory if it was fetched lately."""
        known = self._arrays.get(artifact)
        if known is None:
            answer = _checked(self._http.get(f"/api/artifacts/{quote(artifact)}"))
            known = np.load(io.BytesIO(answer.content), allow_pickle=False)
            self._arrays.put(artifact, known)
        return known

    def value_at(self, artifact: str, x: int, y: int) -> Any:
        """Return one pixel of a map."""
        query = {"x": x, "y": y}
        return self._get(f"/api/artifacts/{quote(artifact)}/at", _DOCUMENT, query).get("value")

    def levels_at(
        self, scan_id: str, stage: str, field: str, *, camera: str, x: int, y: int
    ) -> PixelLevels:
        """Return the gray levels of one pixel in all frames of a camera."""
        path = f"/api/scans/{quote(scan_id)}/stages/{quote(stage)}/fields/{quote(field)}/at"
        return self._get(path, _LEVELS, {"camera": camera, "x": x, "y": y})

    def upload_mask(self, factors: Array) -> ArtifactRef:
        """Keep a painted mask, float32 in [0, 1] or NaN, so that a setting can name it."""
        file = io.BytesIO()
        np.save(file, factors)
        answer = self._http.post("/api/artifacts", content=file.getvalue())
        return _REFERENCE.validate_json(_checked(answer).content)

    def points(self, stage_run: str, field: str, *, budget: int, beyond: int = 0) -> PointsPreview:
        """Return a cloud with all its scalars, thinned to at most `budget` points, without those `beyond` brings."""
        path = f"/api/stage-runs/{quote(stage_run)}/fields/{quote(field)}/points"
        query = {"budget": budget, "beyond": beyond}
        return unpack_points(_checked(self._http.get(path, params=query)).content)

    def picture(self, address: str) -> bytes:
        """Return the bytes of a picture whose address this module gave out."""
        return _checked(self._http.get(address)).content

    # ---- events

    def events(self, stop: threading.Event) -> Iterator[Event | None]:
        """Yield what happens, for ever; None each time the stream was opened (again), so look anew."""
        while not stop.is_set():
            try:
                timeout = httpx.Timeout(_SILENCE_S, connect=5.0)
                with self._http.stream("GET", "/api/events", timeout=timeout) as answer:
                    if answer.status_code != HTTP_OK:
                        answer.read()
                        _checked(answer)
                    yield None
                    yield from _parsed(answer.iter_lines())
            except (httpx.TransportError, httpx.StreamError, RuntimeError):
                pass  # the server restarts, or this client was closed: try again or stop
            stop.wait(_RETRY_S)

    # ---- plumbing

    def _picture(self, path: str, query: dict[str, Any]) -> bytes | None:
        answer = self._http.get(path, params=query)
        return None if answer.status_code in (204, 404) else _checked(answer).content

    def _get(self, path: str, kind: TypeAdapter[T], query: dict[str, Any] | None = None) -> T:
        return kind.validate_json(_checked(self._http.get(path, params=query)).content)

    def _send(self, verb: str, path: str, message: Any, kind: TypeAdapter[T]) -> T:
        content = None if message is None else TypeAdapter(type(message)).dump_json(message)
        headers = {"Content-Type": "application/json"}
        answer = self._http.request(verb, path, content=content, headers=headers)
        return kind.validate_json(_checked(answer).content)


HTTP_OK = 200
HTTP_FIRST_ERROR = 400


def picture_address(
    artifact: str,
    *,
    max_px: int,
    colormap: str = "gray",
    low: float | None = None,
    high: float | None = None,
    encoding: str = "jpeg",
) -> str:
    """Return the address of a map drawn as a picture; the browser fetches it with its own cookie."""
    query: dict[str, Any] = {"max_px": max_px, "colormap": colormap, "kind": "picture"}
    query |= {"format": encoding}
    query |= {k: f"{v:.9g}" for k, v in {"low": low, "high": high}.items() if v is not None}
    return f"/api/artifacts/{quote(artifact)}/preview?{urlencode(query)}"


def cloud_address(scan_id: str) -> str:
    """Return the address of a scan's cloud as PLY."""
    return f"/api/scans/{quote(scan_id)}/cloud.ply"


UPLOAD_PAGE = "/import"
"""The backend's own page that uploads a captured folder."""


def unpack_points(body: bytes) -> PointsPreview:
    """Read the cloud format: length and JSON header, xyz float32, rgb uint8 if there is one, float32 per scalar.

    Raises
    ------
    ValueError
        If the body is shorter or longer than its header says.
    """
    length = int.from_bytes(body[:4], "little")
    header = json.loads(body[4 : 4 + length])
    n, described = int(header["n"]), header.get("scalars", {})
    rest = memoryview(body)[4 + length :]
    plain = n * (12 + 4 * len(described))
    if len(rest) not in (plain, plain + 3 * n):
        raise ValueError(f"the cloud has {len(rest)} bytes where {plain} or {plain + 3 * n} belong")
    has_colour = n > 0 and len(rest) == plain + 3 * n
    points = np.frombuffer(rest[: 12 * n], "<f4").reshape(n, 3)
    at = 12 * n
    colour = None
    if has_colour:
        colour = np.frombuffer(rest[at : at + 3 * n], np.uint8).reshape(n, 3)
        at += 3 * n
    scalars = []
    for name, facts in described.items():
        values = np.frombuffer(rest[at : at + 4 * n], "<f4")
        at += 4 * n
        scalars.append(_scalar(name, facts, values))
    return PointsPreview(int(header.get("total", n)), points, colour, tuple(scalars))


def _scalar(name: str, facts: dict[str, Any], values: Array) -> ScalarOfPoints:
    finite = values[np.isfinite(values)]
    low, high = facts.get("low"), facts.get("high")
    if low is None or high is None:
        low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    return ScalarOfPoints(
        name, facts.get("title") or name, facts.get("unit") or "", float(low), float(high), values
    )


def _checked(answer: httpx.Response) -> httpx.Response:
    if answer.status_code < HTTP_FIRST_ERROR:
        return answer
    try:
        problem = Problem.model_validate_json(answer.content)
    except ValidationError:
        sentence = f"The server answered {answer.status_code} to {answer.request.url.path}."
        problem = Problem(
            type="about:blank", title="Error", status=answer.status_code, detail=sentence
        )
    raise ApiError(problem)


_EVENT: TypeAdapter[Event] = TypeAdapter(Event)


def _parsed(lines: Iterator[str]) -> Iterator[Event]:
    """Read server-sent events: `data:` lines up to an empty line; comments are signs of life."""
    data: list[str] = []
    for line in lines:
        if line.startswith("data:"):
            data.append(line[5:].strip())
        elif not line and data:
            document, data = "\n".join(data), []
            try:
                yield _EVENT.validate_json(document)
            except ValidationError:
                continue  # an event of a newer server: nothing that we show


class _ArrayMemory:
    """The arrays fetched last, up to so many bytes."""

    def __init__(self, capacity_bytes: int) -> None:
        self._capacity = capacity_bytes
        self._arrays: dict[str, Array] = {}
        self._lock = threading.Lock()

    def get(self, key: str) -> Array | None:
        with self._lock:
            array = self._arrays.pop(key, None)
            if array is not None:
                self._arrays[key] = array
            return array

    def put(self, key: str, array: Array) -> None:
        with self._lock:
            self._arrays[key] = array
            while len(self._arrays) > 1 and self._size() > self._capacity:
                self._arrays.pop(next(iter(self._arrays)))

    def _size(self) -> int:
        return sum(a.nbytes for a in self._arrays.values())
