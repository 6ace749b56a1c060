"""Methods, scans, runs and decisions; every change answers with the scan's whole state."""

import itertools
from typing import Annotated

from fastapi import APIRouter, Path, Query
from starlette.responses import Response, StreamingResponse

from backend.api.access import Who
from backend.api.binary import binary
from backend.api.context import Uses
from backend.contract.descriptions import MethodList
from backend.contract.requests import (
    CreateScan,
    Decide,
    EditSettings,
    ExportScan,
    RedoStage,
    StartRun,
    UndoEdit,
)
from backend.contract.scans import AuditEntry, ScanState, ScanSummary

router = APIRouter(tags=["scans"])

ScanId = Annotated[str, Path(min_length=1, max_length=64, description="Id of the scan.")]
StageName = Annotated[str, Path(min_length=1, max_length=100, description="Name of the stage.")]


@router.get("/methods")
def methods(services: Uses) -> MethodList:
    """List the measuring methods with their stages, settings and shown fields."""
    return services.methods()


@router.get("/scans")
def list_scans(
    services: Uses,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    offset: Annotated[int, Query(ge=0)] = 0,
    text: Annotated[str, Query(max_length=200, description="Part of a name or note.")] = "",
) -> tuple[ScanSummary, ...]:
    """List scans, the newest first."""
    return services.scans(limit, offset, text)


@router.post("/scans", status_code=201)
def create_scan(request: CreateScan, services: Uses, who: Who) -> ScanState:
    """Make a scan; nothing runs yet."""
    return services.create_scan(request, who.user)


@router.get("/scans/{scan}")
def scan_state(scan: ScanId, services: Uses) -> ScanState:
    """Tell everything about a scan but its arrays."""
    return services.scan(scan)


@router.patch("/scans/{scan}/settings/{stage}")
def edit_settings(
    scan: ScanId, stage: StageName, request: EditSettings, services: Uses, who: Who
) -> ScanState:
    """Change settings of a stage; 409 with the other edit if somebody was faster."""
    return services.edit(scan, stage, request, who.user)


@router.post("/scans/{scan}/undo")
def undo_edit(scan: ScanId, request: UndoEdit, services: Uses, who: Who) -> ScanState:
    """Take back the last edit; its old result is current again without computing."""
    return services.undo(scan, request, who.user)


@router.post("/scans/{scan}/redo/{stage}")
def redo_stage(
    scan: ScanId, stage: StageName, request: RedoStage, services: Uses, who: Who
) -> ScanState:
    """Take the pictures of one stage anew, or with `all` those of every stage: the part moved."""
    return services.redo(scan, None if request.all else stage, request, who.user)


@router.post("/scans/{scan}/runs", status_code=202)
def start_run(scan: ScanId, request: StartRun, services: Uses, who: Who) -> ScanState:
    """Run what isn't current; progress comes as events."""
    return services.run(scan, request, who.user)


@router.delete("/scans/{scan}/runs")
def cancel_run(scan: ScanId, services: Uses, who: Who) -> ScanState:
    """Cancel the running job; finished stages and captured frames are kept."""
    return services.cancel(scan, who.user)


@router.get("/scans/{scan}/audit")
def audit_trail(scan: ScanId, services: Uses) -> tuple[AuditEntry, ...]:
    """Tell who did what, when and why."""
    return services.audit(scan)


@router.post("/stage-runs/{stage_run}/decision")
def decide(
    stage_run: Annotated[str, Path(min_length=1, max_length=64)],
    request: Decide,
    services: Uses,
    who: Who,
) -> ScanState:
    """Accept or reject the result of a stage."""
    return services.decide(stage_run, request, who.user)


@router.post("/scans/{scan}/export")
def export_scan(scan: ScanId, request: ExportScan, services: Uses, who: Who) -> tuple[str, ...]:
    """Write results into a folder of the server; answers with the files written."""
    paths = services.export(scan, request.folder, request.frames, who.user)
    return tuple(str(path) for path in paths)


@router.get("/scans/{scan}/cloud.ply", response_class=Response, responses=binary("model/ply"))
def cloud_file(scan: ScanId, services: Uses) -> Response:
    """Return the scan's points as a PLY file (binary, mm)."""
    parts = services.cloud_ply(scan)
    # The first piece now: what hinders it becomes an answer, not half a file.
    whole = itertools.chain([next(parts)], parts)
    headers = {"Content-Disposition": f'attachment; filename="{scan}.ply"'}
    return StreamingResponse(
        (bytes(part) for part in whole), media_type="model/ply", headers=headers
    )
