"""Make scans, list them, look at one."""

import logging
from concurrent.futures import Future

from backend.contract.events import ScanChanged
from backend.contract.requests import CreateScan
from backend.contract.scans import AuditEntry, ScanState, ScanSummary
from backend.domain.errors import RigBusyError, UnglareError
from backend.domain.ids import new_id
from backend.domain.method import Method
from backend.jobs.edits import check_recipe, preset_values
from backend.jobs.execution import store_rig
from backend.jobs.rigs import RigGiven
from backend.services.calibrations import give_from, require_handed
from backend.services.context import Context
from backend.services.states import scan_state, scan_summary
from backend.services.telling import announce
from backend.storage.rows import ScanRow

log = logging.getLogger(__name__)


def create_scan(context: Context, request: CreateScan, who: str) -> ScanState:
    """Make a scan with the rig's facts and calibration; nothing runs yet.

    The rig is opened for it unless its facts are known; opening may take seconds, so the answer doesn't wait and
    the facts follow. Where it captures with other options just now, it is asked at the scan's first run instead.

    Raises
    ------
    NotFoundError
        If there is no such method or rig.
    InvalidSettingError
        If the preset, a setting of the recipe or an option of the rig can't be used.
    ConflictError
        If the method takes no such result from outside.
    DeviceError
        If a device of the rig refuses at once.
    """
    method = context.registry.get(request.method)
    preset_values(method, request.preset)
    recipe = check_recipe(method, request.preset, request.settings, context.store.__contains__)
    for type_name in request.given:
        require_handed(method, type_name)
    asked, rig = _ask_rig(context, request)
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
        sentence = f"Scan made: {method.title} with rig {request.rig}."
        details = {
            "method": method.name,
            "rig": request.rig,
            "rig_options": dict(request.rig_options),
            "preset": request.preset,
            "settings": recipe,
            "given": {t: s.model_dump() if s else None for t, s in request.given.items()},
        }
        repositories.audit.add(row.id, who, "created", None, sentence, details)
        for type_name, source in request.given.items():
            if source is not None:
                give_from(context, repositories, method, row.id, type_name, source)
        if rig is not None:
            store_rig(repositories, context.store, method, row.id, rig, request.given)
        state = scan_state(context, repositories, row.id)
    if asked is not None and rig is None:
        asked.add_done_callback(lambda answer: _store_late(context, method, row.id, answer))
    return announce(context, state)


def list_scans(context: Context, limit: int, offset: int, text: str) -> tuple[ScanSummary, ...]:
    """Return a page of the scan list, newest first.

    A line is put together only when something has happened to its scan: that always is a line in the audit trail.
    """
    with context.database.reading() as repositories:
        rows = repositories.scans.list(limit, offset, text)
        jobs = repositories.jobs.last_of_each([row.id for row in rows])
        happened = repositories.audit.last_of_each([row.id for row in rows])

        def summary(row: ScanRow) -> ScanSummary:
            job = jobs.get(row.id)
            key = (row.id, happened.get(row.id), job.status if job else None)
            return context.summaries.get(key, lambda: scan_summary(context, repositories, row, job))

        return tuple(summary(row) for row in rows)


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


def _ask_rig(
    context: Context, request: CreateScan
) -> tuple[Future[RigGiven] | None, RigGiven | None]:
    """Return the question and, if it came at once, the answer.

    Where a calibration is declined, the answer is waited for: with it the calibrations are handed over.
    """
    declines = None in request.given.values()
    try:
        asked = context.rigs.ask(request.rig, request.rig_options)
        return asked, asked.result(timeout=None if declines else context.rig_patience_s)
    except RigBusyError:
        if declines:
            raise
        return None, None
    except TimeoutError:
        return asked, None


def _store_late(context: Context, method: Method, scan: str, answer: Future[RigGiven]) -> None:
    """Hand a rig's facts to a scan that was made before they were known."""
    try:
        with context.database.transaction() as repositories:
            store_rig(repositories, context.store, method, scan, answer.result())
            revision = repositories.scans.get(scan).revision
    except UnglareError as error:
        # The first run asks again, and tells the operator.
        log.warning("Scan %s doesn't know its rig yet: %s", scan, error)
        return
    context.events.publish(ScanChanged(scan=scan, revision=revision))
