"""Arrays of results: whole, as pictures, at one pixel, as points. A hash never changes its meaning: cache for ever."""

import hashlib
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse

from backend.api.binary import binary
from backend.api.context import Uses, context_of
from backend.api.errors import TooLargeError
from backend.api.npy import npy_chunks, npy_size_bytes
from backend.contract.base import Message
from backend.contract.scans import ArtifactRef, PixelLevels
from backend.services.array_uploads import LARGEST_UPLOAD_BYTES, UploadKind

UPLOAD_PATH = "/api/artifacts"
_FILE = {"type": "string", "format": "binary"}

router = APIRouter(tags=["artifacts"])

Hash = Annotated[str, Path(pattern="^[0-9a-f]{16,128}$", description="Content hash of the array.")]
FOR_EVER = "private, max-age=31536000, immutable"
A_DAY = "private, max-age=86400"
"""For pictures of arrays: the next version may draw them better."""


class PixelValue(Message):
    """What an array says at one place."""

    value: Any
    """A number, a list for several channels, None where nothing is valid."""


@router.post(
    "/artifacts",
    status_code=201,
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "A .npy file, or a gray picture of 8 or 16 bit.",
            "content": {
                "application/octet-stream": {"schema": _FILE},
                "image/png": {"schema": _FILE},
            },
        }
    },
)
async def upload_array(
    request: Request,
    services: Uses,
    kind: Annotated[
        UploadKind,
        Query(
            description="mask: float32 from 0 to 1, full scale of a picture is 1; array: as it is."
        ),
    ] = UploadKind.MASK,
) -> ArtifactRef:
    """Keep an array that a setting can name by its hash, e.g. a painted mask."""
    data = await _body(request, LARGEST_UPLOAD_BYTES)
    return await run_in_threadpool(services.upload_array, data, kind)


@router.get("/artifacts/{hash}", response_class=Response, responses=binary("application/x-npy"))
def artifact(hash: Hash, request: Request, services: Uses) -> Response:
    """Return an array as a `.npy` file."""
    headers = {"ETag": f'"{hash}"', "Cache-Control": FOR_EVER}
    if seen_before(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    array = services.artifact(hash)
    headers["Content-Length"] = str(npy_size_bytes(array))
    headers["Content-Disposition"] = f'attachment; filename="{hash[:16]}.npy"'
    return StreamingResponse(npy_chunks(array), media_type="application/x-npy", headers=headers)


@router.get("/artifacts/{hash}/preview", response_class=Response, responses=binary("image/png"))
def artifact_preview(
    hash: Hash,
    request: Request,
    services: Uses,
    max_px: Annotated[int, Query(ge=16, le=8192, description="Longest side.")] = 1280,
    colormap: Annotated[str, Query(max_length=30)] = "gray",
    low: Annotated[
        float | None,
        Query(allow_inf_nan=False, description="Value of the first colour; none: chosen."),
    ] = None,
    high: Annotated[float | None, Query(allow_inf_nan=False)] = None,
    kind: Literal["picture", "mask"] = "picture",
    format: Literal["png", "jpeg"] = "png",
) -> Response:
    """Return an array as a picture made for the screen."""
    tag = _tag(f"{context_of(request).version} {hash} {request.url.query}")
    headers = {"ETag": tag, "Cache-Control": A_DAY}
    if seen_before(request, tag):
        return Response(status_code=304, headers=headers)
    picture = services.artifact_preview(
        hash, max_px=max_px, colormap=colormap, low=low, high=high, kind=kind, format=format
    )
    return Response(picture, media_type=f"image/{format}", headers=headers)


@router.get("/artifacts/{hash}/at")
def artifact_at(
    hash: Hash,
    services: Uses,
    x: Annotated[int, Query(ge=0, description="Column.")],
    y: Annotated[int, Query(ge=0, description="Row.")],
) -> PixelValue:
    """Tell the value of one pixel."""
    return PixelValue(value=services.artifact_at(hash, x, y))


@router.get("/scans/{scan}/stages/{stage}/fields/{field}/at")
def levels_at(
    scan: Annotated[str, Path(min_length=1, max_length=64)],
    stage: Annotated[str, Path(min_length=1, max_length=100)],
    field: Annotated[str, Path(min_length=1, max_length=100)],
    services: Uses,
    camera: Annotated[str, Query(max_length=100)],
    x: Annotated[int, Query(ge=0, description="Column.")],
    y: Annotated[int, Query(ge=0, description="Row.")],
) -> PixelLevels:
    """Tell the gray levels of all frames of a camera at one pixel."""
    return services.levels_at(scan, stage, field, camera=camera, x=x, y=y)


@router.get(
    "/stage-runs/{stage_run}/fields/{field}/points",
    response_class=Response,
    responses=binary("application/octet-stream"),
)
def points(
    stage_run: Annotated[str, Path(min_length=1, max_length=64)],
    field: Annotated[str, Path(min_length=1, max_length=100)],
    services: Uses,
    budget: Annotated[int, Query(ge=1000, le=20_000_000, description="Most points.")] = 300_000,
    beyond: Annotated[
        int, Query(ge=0, le=20_000_000, description="Leave out what this budget brings.")
    ] = 0,
    scalar: Annotated[
        str | None, Query(max_length=100, description="Only this scalar; none: all.")
    ] = None,
) -> Response:
    """Return a cloud thinned to the budget; a larger budget brings the same points and more between them.

    uint32 length of the header (little endian), header as JSON `{n, total, scalars: {name: {unit,
    title, low, high}}}`, float32 xyz (n, 3), uint8 rgb (n, 3) if it has colour, float32 (n) per scalar.
    """
    cloud = services.cloud_preview(stage_run, field, budget=budget, beyond=beyond, scalar=scalar)
    return Response(cloud, media_type="application/octet-stream", headers={"Cache-Control": A_DAY})


def seen_before(request: Request, tag: str) -> bool:
    """Tell whether the client holds this version already."""
    return tag in {t.strip() for t in request.headers.get("if-none-match", "").split(",")}


async def _body(request: Request, limit_bytes: int) -> bytes:
    """Read a body, counting what arrives."""
    if int(request.headers.get("content-length", "0")) > limit_bytes:
        raise _too_large(limit_bytes)
    pieces = bytearray()
    async for piece in request.stream():
        pieces += piece
        if len(pieces) > limit_bytes:
            raise _too_large(limit_bytes)
    return bytes(pieces)


def _too_large(limit_bytes: int) -> TooLargeError:
    return TooLargeError(
        f"The upload is larger than {limit_bytes // 2**20} MiB: a mask has the projector's size, save it as that."
    )


def _tag(text: str) -> str:
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'
