"""Make scans, list them, look at one."""

from backend.contract.requests import CreateScan
from backend.contract.scans import AuditEntry, ScanState, ScanSummary
from backend.domain.errors import RigBusyError
from backend.domain.ids import new_id
from backend.jobs.edits import check_recipe, preset_values
from backend.jobs.execution import store_rig
from backend.jobs.rigs import RigGiven
from backend.services.context import Context
from backend.services.states import scan_state, scan_summary
from backend.services.telling import announce
from backend.storage.rows import ScanRow


def create_scan(context: Context, request: CreateScan, who: str) -> ScanState:
    """Make a scan with the rig's facts and calibration; nothing runs yet.

    The rig is opened for it unless its facts are known. Where it captures with other options just now, it is
    asked at the scan's first run instead, so that nobody waits.

    Raises
    ------
    NotFoundError
        If there is no such method or rig.
    InvalidSettingError
        If the preset, a setting of the recipe or an option of the rig can't be used.
    DeviceError
        If a device of the rig doesn't answer.
    """
    method = context.registry.get(request.method)
    preset_values(method, request.preset)
    recipe = check_recipe(method, request.preset, request.settings)
    rig = _ask_rig(context, request)
    row = ScanRow(
        id=new_id(),
        name=request.name,
        note=request.note,
        method=method.name,
        rig=request.rig,
        rig_options=dict(request.rig_options),
        preset=request.preset,
        recipe=recipe,
        created=context.clock(),
        who=who,
    )
    with context.database.transaction() as repositories:
        repositories.scans.add(row)
        if rig is not None:
            store_rig(repositories, context.store, row.id, rig)
        sentence = f"Scan made: {method.title} with rig {request.rig}."
        details = {
            "method": method.name,
            "rig": request.rig,
            "rig_options": dict(request.rig_options),
            "preset": request.preset,
            "settings": recipe,
        }
        repositories.audit.add(row.id, who, "created", None, sentence, details)
        state = scan_state(context, repositories, row.id)
    return announce(context, state)


def list_scans(context: Context, limit: int, offset: int, text: str) -> tuple[ScanSummary, ...]:
    """Return a page of the scan list, newest first."""
    with context.database.reading() as repositories:
        rows = repositories.scans.list(limit, offset, text)
        jobs = repositories.jobs.last_of_each([row.id for row in rows])
        return tuple(scan_summary(context, repositories, row, jobs.get(row.id)) for row in rows)


def audit_trail(context: Context, scan: str) -> tuple[AuditEntry, ...]:
    """Return who did what to a scan, oldest first; NotFoundError if there is none of that id."""
    with context.database.reading() as repositories:
        repositories.scans.get(scan)
        rows = repositories.audit.of(scan)
    return tuple(
        AuditEntry(
            sequence=row.sequence,
            when=row.when,
            who=row.who,
            action=row.action,
            stage=row.stage,
            sentence=row.sentence,
            details=row.details,
        )
        for row in rows
    )


def _ask_rig(context: Context, request: CreateScan) -> RigGiven | None:
    try:
        return context.rigs.given(request.rig, request.rig_options)
    except RigBusyError:
        return None
