"""Rigs: which there are, what one sees; one without a scan: its devices, live pictures, latency.

What touches a device is answered at once with the state, which tells later what came of it.
"""

from typing import Annotated, Any

from fastapi import APIRouter, Body, Path, Query
from starlette.responses import Response

from backend.api.access import Who
from backend.api.binary import binary
from backend.api.context import Uses
from backend.api.scans import ScanId
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
from backend.services.live_pictures import LIVE_PX, Crop

router = APIRouter(tags=["rigs"])

RigName = Annotated[str, Path(min_length=1, max_length=200)]
RigOptions = Annotated[dict[str, Any], Body(description="What the rig's factory takes.")]


@router.get("/rigs")
def rigs(services: Uses) -> tuple[RigOffer, ...]:
    """List the rigs that a scan can be made with, and why others can't."""
    return services.rigs()


@router.post("/rigs/{rig}/view")
def view_rig(rig: RigName, services: Uses, options: RigOptions = {}) -> RigView:  # noqa: B006  FastAPI copies it
    """Tell sizes, ranges and calibration of a rig as a scan with these options would have them.

    Answers at once where they are known. Else the rig is opened for that, which may take as long as its devices take:
    409 if somebody captures with other options, or if four others wait for it already.
    """
    return services.rig(rig, options)


@router.get(
    "/rigs/{rig}/cameras/{camera}/preview", response_class=Response, responses=binary("image/jpeg")
)
def camera_preview(
    rig: RigName,
    camera: Annotated[str, Path(max_length=100)],
    services: Uses,
    max_px: Annotated[int, Query(ge=16, le=8192, description="Longest side.")] = LIVE_PX,
    marks: Annotated[
        bool, Query(description="Draw saturated pixels red and those at 0 blue.")
    ] = False,
    x: Annotated[int | None, Query(ge=0, description="Column of the middle of a part.")] = None,
    y: Annotated[int | None, Query(ge=0, description="Its row.")] = None,
    part_px: Annotated[int, Query(ge=16, le=1024, description="Its width and height.")] = 160,
) -> Response:
    """Return the newest picture of a camera, or a part of it pixel by pixel; 204 while there is none.

    Asks the camera for nothing: `POST /api/rigs/{rig}/live` does.
    """
    crop = None if x is None or y is None else Crop(x, y, part_px)
    picture = services.live_frame(rig, camera, max_px=max_px, marks=marks, crop=crop)
    return (
        Response(status_code=204) if picture is None else Response(picture, media_type="image/jpeg")
    )


@router.get("/rigs/{rig}/cameras/{camera}/part")
def camera_part(
    rig: RigName,
    camera: Annotated[str, Path(max_length=100)],
    services: Uses,
    x: Annotated[int, Query(ge=0, description="Column of the middle of the part.")],
    y: Annotated[int, Query(ge=0, description="Its row.")],
    part_px: Annotated[int, Query(ge=16, le=1024, description="Its width and height.")] = 160,
) -> PartView | None:
    """Tell brightness and sharpness of a part of the newest picture of a camera; null while there is none."""
    return services.live_part(rig, camera, Crop(x, y, part_px))


# ---- a rig without a scan


@router.get("/rigs/{rig}/state")
def rig_state(rig: RigName, services: Uses) -> RigState:
    """Tell how a rig is doing: its devices, who has it, what runs at it."""
    return services.rig_desk.state(rig)


@router.post("/rigs/{rig}/connect", status_code=202)
def connect_rig(rig: RigName, services: Uses, options: RigOptions = {}) -> RigState:  # noqa: B006  FastAPI copies it
    """Have a rig opened in the background; one that is open stays as it is, whatever its options.

    404 where no rig has this name; `link` and `failure` of the rig's state tell the rest.
    """
    return services.rig_desk.connect(rig, options)


@router.post("/rigs/{rig}/disconnect", status_code=202)
def disconnect_rig(rig: RigName, services: Uses) -> RigState:
    """Have the devices of a rig closed in the background, so that another program can use them."""
    return services.rig_desk.disconnect(rig)


@router.post("/rigs/{rig}/reconnect", status_code=202)
def reconnect_rig(rig: RigName, services: Uses) -> RigState:
    """Have a rig closed and opened again in the background, with the options that it had."""
    return services.rig_desk.reconnect(rig)


@router.get("/rigs/{rig}/live")
def live_numbers(rig: RigName, services: Uses) -> LiveView:
    """Tell what the newest pictures of a rig say; asks for no new ones."""
    return services.rig_desk.live(rig)


@router.post("/rigs/{rig}/live")
def watch_rig(rig: RigName, services: Uses) -> LiveView:
    """Have live pictures taken for the next 3 s, while the rig is connected and nobody captures; answer as GET does.

    Ask again and again as long as somebody looks. Cameras stay armed between pictures; nothing is stored.
    """
    return services.rig_desk.watch(rig)


@router.put("/rigs/{rig}/live")
def set_live(rig: RigName, request: LiveSettings, services: Uses) -> LiveView:
    """Set exposure, gain and what is projected for live pictures; answers with what is in force."""
    return services.rig_desk.set_live(rig, request)


@router.delete("/rigs/{rig}/live")
def end_live(rig: RigName, services: Uses) -> LiveView:
    """End live pictures now: cameras disarmed, projector dark."""
    return services.rig_desk.rest(rig)


@router.post("/rigs/{rig}/check", status_code=202)
def check_rig(
    rig: RigName,
    services: Uses,
    who: Who,
    options: Annotated[
        dict[str, Any] | None,
        Body(description="What the rig's factory takes; none: the options that it has."),
    ] = None,
) -> RigState:
    """Begin to check a rig: a white and a black frame of each camera, and what looks wrong.

    `work` of the rig's state tells how far it is and what was found, `devices` who they are.
    """
    return services.rig_desk.start_check(rig, who.user, options)


@router.post("/rigs/{rig}/latency", status_code=202)
def start_latency(rig: RigName, request: StartLatency, services: Uses, who: Who) -> RigState:
    """Begin to measure how long after its acknowledgement the projector shows a pattern. `work` tells the result."""
    return services.rig_desk.start_latency(rig, request.repetitions, who.user)


@router.get("/rigs/{rig}/latency")
def rig_latency(rig: RigName, services: Uses) -> LatencyView | None:
    """Return the latency that was measured last, else the one kept for the rig; null if there is neither."""
    return services.rig_desk.latency(rig)


@router.delete("/rigs/{rig}/work")
def cancel_work(rig: RigName, services: Uses, who: Who) -> RigState:
    """Have the check or latency calibration ended that runs."""
    return services.rig_desk.cancel(rig, who.user)


@router.post("/rigs/discover")
def discover_cameras(request: DiscoverCameras, services: Uses) -> Discovery:
    """Ask known addresses for cameras, by unicast; only with `search` let every driver look, which may broadcast."""
    return services.rig_desk.discover(request)


@router.get("/scans/{scan}/rig", tags=["scans"])
def scan_rig(scan: ScanId, services: Uses) -> RigView:
    """Tell the rig that a scan was made with, from what the scan carries."""
    return services.scan_rig(scan)
