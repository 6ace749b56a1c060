"""Results that are kept for a rig, and what is handed to scans."""

from typing import Annotated

from fastapi import APIRouter, Path

from backend.api.access import Who
from backend.api.context import Uses
from backend.api.rigs import RigName
from backend.api.scans import ScanId
from backend.contract.requests import GivenSource
from backend.contract.scans import CalibrationView, ScanState

router = APIRouter(tags=["calibrations"])

Number = Annotated[int, Path(ge=1, le=2**62, description="Number of the calibration.")]
TypeName = Annotated[str, Path(min_length=1, max_length=100, description="Type of the result.")]


@router.post("/stage-runs/{stage_run}/calibration", status_code=201)
def keep(
    stage_run: Annotated[str, Path(min_length=1, max_length=64)], services: Uses, who: Who
) -> CalibrationView:
    """Keep a result for its rig: later scans with the same devices get it."""
    return services.keep(stage_run, who.user)


@router.get("/calibrations")
def all_calibrations(services: Uses) -> tuple[CalibrationView, ...]:
    """List what was ever kept for any rig, newest first."""
    return services.calibrations()


@router.get("/rigs/{rig}/calibrations")
def calibrations(rig: RigName, services: Uses) -> tuple[CalibrationView, ...]:
    """List what was ever kept for a rig, newest first."""
    return services.calibrations(rig)


@router.delete("/calibrations/{number}")
def withdraw(number: Number, services: Uses, who: Who) -> CalibrationView:
    """Withdraw a calibration: no later scan gets it; scans that have it keep it."""
    return services.withdraw(number, who.user)


@router.put("/scans/{scan}/given/{type}")
def give(scan: ScanId, type: TypeName, request: GivenSource, services: Uses, who: Who) -> ScanState:
    """Hand a result to a scan: a calibration, or the result of another scan or of an export."""
    return services.give(scan, type, request, who.user)


@router.delete("/scans/{scan}/given/{type}")
def take_away(scan: ScanId, type: TypeName, services: Uses, who: Who) -> ScanState:
    """Take a handed-over result away: stages do without it, or make it themselves."""
    return services.take_away(scan, type, who.user)
