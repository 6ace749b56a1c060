"""Captured folders: from a path of the server, or as an upload."""

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import HTMLResponse, Response

from backend.api.access import Who
from backend.api.assets import filled
from backend.api.context import Context, Uses, context_of
from backend.api.form_file import FormFile
from backend.api.headers import FRAMED_BY_US
from backend.api.uploads import save, too_large, unpack, upload_folder
from backend.contract.requests import ImportCapture
from backend.contract.scans import ScanState

UPLOAD_PATH = "/api/imports/upload"
_LONGEST_NAME = 200
_ZIP = {"schema": {"type": "string", "format": "binary"}}
_FORM = {
    "schema": {
        "type": "object",
        "properties": {"file": _ZIP["schema"], "name": {"type": "string"}},
        "required": ["file"],
    }
}

router = APIRouter(tags=["imports"])


@router.post("/imports", status_code=201)
def import_capture(request: ImportCapture, services: Uses, who: Who) -> ScanState:
    """Import a captured folder that the server can read."""
    return services.import_capture(request.path, request.name, who.user)


@router.post(
    "/imports/upload",
    status_code=201,
    response_model=ScanState,
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "The folder with its capture.json, as a zip file.",
            "content": {"application/zip": _ZIP, "multipart/form-data": _FORM},
        }
    },
)
async def upload_capture(
    request: Request, who: Who, name: Annotated[str, Query(max_length=_LONGEST_NAME)] = ""
) -> ScanState | Response:
    """Import a captured folder that comes as a zip file: as the body itself, or as the file of a form."""
    context = context_of(request)
    # Some room for what a form has around the file; the file itself is counted while it comes.
    if int(request.headers.get("content-length", "0")) > context.upload_limit_bytes + 2**16:
        raise too_large(context.upload_limit_bytes)
    state = await _imported(request, context, name, who.user)
    if "text/html" not in request.headers.get("accept", ""):
        return state
    page = filled("imported.html", name=state.name or state.id)
    return HTMLResponse(page, 201, headers=FRAMED_BY_US)


async def _imported(request: Request, context: Context, name: str, who: str) -> ScanState:
    limit_bytes = context.upload_limit_bytes
    content_type = request.headers.get("content-type", "")
    body: AsyncIterator[bytes] = request.stream()
    fields: dict[str, str] = {}
    if content_type.startswith("multipart/form-data"):
        form = FormFile(body, content_type)
        body, fields = form.pieces(), form.fields
    # Half an upload leaves nothing behind: neither file nor scan.
    with upload_folder(context.data_folder / "uploads") as folder:
        archive, unpacked = folder / "capture.zip", folder / "capture"
        await save(body, archive, limit_bytes)
        unpacked.mkdir()
        capture = await run_in_threadpool(unpack, archive, unpacked, limit_bytes)
        archive.unlink()
        name = (name or fields.get("name", "")).strip()[:_LONGEST_NAME]
        return await run_in_threadpool(context.services.import_capture, str(capture), name, who)
