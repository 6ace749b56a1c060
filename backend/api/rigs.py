"""Rigs: which there are, what one sees, the newest picture of a camera."""

from typing import Annotated, Any

from fastapi import APIRouter, Body, Path
from starlette.responses import Response

from backend.api.binary import binary
from backend.api.context import Uses
from backend.api.scans import ScanId
from backend.contract.rigs import RigCheck, RigOffer, RigView

router = APIRouter(tags=["rigs"])

RigName = Annotated[str, Path(min_length=1, max_length=200)]
RigOptions = Annotated[dict[str, Any], Body(description="What the rig's factory takes.")]


@router.get("/rigs")
def rigs(services: Uses) -> tuple[RigOffer, ...]:
    """List the rigs that a scan can be made with, and why others can't."""
    return services.rigs()


@router.post("/rigs/{rig}/view")
def view_rig(rig: RigName, services: Uses, options: RigOptions = {}) -> RigView:  # noqa: B006  FastAPI copies it
    """Tell the devices of a rig with these options; opens it."""
    return services.rig(rig, options)


@router.post("/rigs/{rig}/check")
def check_rig(rig: RigName, services: Uses, options: RigOptions = {}) -> RigCheck:  # noqa: B006  FastAPI copies it
    """Try a rig: open it, take a picture, say what was found."""
    return services.check_rig(rig, options)


@router.get(
    "/rigs/{rig}/cameras/{camera}/preview", response_class=Response, responses=binary("image/jpeg")
)
def camera_preview(
    rig: RigName, camera: Annotated[str, Path(max_length=100)], services: Uses
) -> Response:
    """Return the newest picture of a camera; 204 while there is none."""
    picture = services.live_frame(rig, camera)
    return (
        Response(status_code=204) if picture is None else Response(picture, media_type="image/jpeg")
    )


@router.get("/scans/{scan}/rig", tags=["scans"])
def scan_rig(scan: ScanId, services: Uses) -> RigView:
    """Tell the rig that a scan was made with, from what the scan carries."""
    return services.scan_rig(scan)
