"""Captured folders: from a path of the server, or as an upload."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from backend.api.access import Who
from backend.api.context import Uses, context_of
from backend.api.uploads import save, too_large, unpack, upload_folder
from backend.contract.requests import ImportCapture
from backend.contract.scans import ScanState

UPLOAD_PATH = "/api/imports/upload"

router = APIRouter(tags=["imports"])


@router.post("/imports", status_code=201)
def import_capture(request: ImportCapture, services: Uses, who: Who) -> ScanState:
    """Import a captured folder that the server can read."""
    return services.import_capture(request.path, request.name, who.user)


@router.post(
    "/imports/upload",
    status_code=201,
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "The folder with its capture.json, as a zip file.",
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def upload_capture(
    request: Request, who: Who, name: Annotated[str, Query(max_length=200)] = ""
) -> ScanState:
    """Import a captured folder that comes as a zip file (the body itself, no form)."""
    context = context_of(request)
    limit_bytes = context.upload_limit_bytes
    if int(request.headers.get("content-length", "0")) > limit_bytes:
        raise too_large(limit_bytes)
    with upload_folder(context.data_folder / "uploads") as folder:
        archive, unpacked = folder / "capture.zip", folder / "capture"
        await save(request.stream(), archive, limit_bytes)
        unpacked.mkdir()
        capture = await run_in_threadpool(unpack, archive, unpacked, limit_bytes)
        archive.unlink()
        return await run_in_threadpool(
            context.services.import_capture, str(capture), name, who.user
        )
