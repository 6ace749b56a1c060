"""Keep results for a rig, and hand them (or results of other scans) to scans."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from backend.contract.requests import GivenSource
from backend.contract.scan_file import SCAN_FORMAT, ScanFile, WrittenGiven
from backend.contract.scans import CalibrationView, ScanState
from backend.domain.errors import ConflictError, InvalidCaptureError, NotFoundError
from backend.domain.method import Method
from backend.domain.states import Level, Verdict
from backend.domain.type_names import words
from backend.jobs.calibrations import give_calibration, rig_identity
from backend.jobs.loading import NO_RIG, LoadedScan, document_of, load_scan
from backend.jobs.plan import PlannedStage, run_level
from backend.methods import Registry
from backend.services.context import Context
from backend.services.export_folder import SCAN_FILE
from backend.services.handed import takers
from backend.services.portable import read_back
from backend.services.states import scan_state
from backend.services.telling import announce
from backend.storage.codec import content_hash, decode
from backend.storage.repositories import Repositories
from backend.storage.rows import CalibrationRow, RunRow


def keep(context: Context, stage_run: str, who: str) -> CalibrationView:
    """Keep a finished stage's result for its rig: scans made later with the same devices get it.

    Raises
    ------
    NotFoundError
        If there is no such run.
    ConflictError
        If no method takes such a result, it isn't today's, its check failed, or the scan has no rig.
    """
    with context.database.transaction() as repositories:
        row = repositories.runs.get(stage_run)
        repositories.scans.lock(row.scan)
        loaded = load_scan(repositories, context.registry, row.scan)
        planned, run = _present(loaded, row.key)
        _refuse_unfit(context.registry, loaded, planned, run)
        identity = rig_identity(loaded.row.rig, loaded.given)
        assert identity is not None, "a stage has run, so the facts are known"
        document = document_of(repositories, run)
        kept = repositories.calibrations.add(
            type_name=planned.stage.output.__name__,
            **identity._asdict(),
            document=document,
            hash=content_hash(document),
            scan=loaded.row.id,
            stage=planned.name,
            run=run.id,
            who=who,
        )
        sentence = f"{planned.stage.title} kept as calibration {kept.sequence} of rig {kept.rig}."
        details = {"calibration": kept.sequence, "run": run.id, "hash": kept.hash}
        repositories.audit.add(loaded.row.id, who, "kept", planned.name, sentence, details)
        view = _view(repositories, kept)
        state = scan_state(context, repositories, loaded.row.id)
    announce(context, state)
    return view


def withdraw(context: Context, number: int, who: str) -> CalibrationView:
    """Take a calibration back: no later scan gets it; scans that have it keep it."""
    with context.database.transaction() as repositories:
        row = repositories.calibrations.get(number)
        if row.withdrawn is not None:
            raise ConflictError(
                f"Calibration {number} was withdrawn by {row.withdrawn_by} already."
            )
        row = repositories.calibrations.withdraw(number, who)
        sentence = f"Calibration {number} of rig {row.rig} withdrawn."
        repositories.audit.add(
            row.scan, who, "withdrawn", row.stage, sentence, {"calibration": number}
        )
        view = _view(repositories, row)
        state = scan_state(context, repositories, row.scan)
    announce(context, state)
    return view


def listed(context: Context, rig: str | None) -> tuple[CalibrationView, ...]:
    """Return what was ever kept for a rig (None: for any), newest first."""
    with context.database.reading() as repositories:
        return tuple(_view(repositories, row) for row in repositories.calibrations.of_rig(rig))


def give(context: Context, scan: str, type_name: str, source: GivenSource, who: str) -> ScanState:
    """Hand a result to a scan instead of the one that it has, if any.

    Raises
    ------
    NotFoundError
        If there is no such scan, calibration or result.
    ConflictError
        If the scan's method takes no such result.
    InvalidCaptureError
        If the folder isn't an export, or damaged.
    """
    with context.database.transaction() as repositories:
        repositories.scans.lock(scan)
        loaded = load_scan(repositories, context.registry, scan)
        place = require_handed(loaded.method, type_name)
        old = repositories.given.remove(scan, place)
        give_from(context, repositories, loaded.method, scan, type_name, source)
        new = repositories.given.of(scan)[place]
        said = (new.origin or {}).get("sentence", "")
        details = {"type": type_name, "old": old.hash if old else None, "new": new.hash}
        sentence = f"{words(type_name)} handed over: {said}"
        repositories.audit.add(scan, who, "given", _stage_of(loaded, place), sentence, details)
        state = scan_state(context, repositories, scan)
    return announce(context, state)


def take_away(context: Context, scan: str, type_name: str, who: str) -> ScanState:
    """Take a handed-over result from a scan: its stages do without, or make it themselves.

    Raises
    ------
    NotFoundError
        If there is no such scan.
    ConflictError
        If nothing of that type was handed over, or it isn't an operator's to take away.
    """
    with context.database.transaction() as repositories:
        repositories.scans.lock(scan)
        loaded = load_scan(repositories, context.registry, scan)
        place = require_handed(loaded.method, type_name)
        old = repositories.given.remove(scan, place)
        if old is None:
            raise ConflictError(
                f"No {type_name} was handed to {loaded.title!r}: there is nothing to take away."
            )
        details = {"type": type_name, "old": old.hash, "new": None}
        sentence = f"{words(type_name)} taken away."
        repositories.audit.add(scan, who, "given", _stage_of(loaded, place), sentence, details)
        state = scan_state(context, repositories, scan)
    return announce(context, state)


def give_from(
    context: Context,
    repositories: Repositories,
    method: Method,
    scan: str,
    type_name: str,
    source: GivenSource,
) -> None:
    """Store a result from a calibration, another scan or an export as given to a scan that has none yet."""
    place = require_handed(method, type_name)
    if source.calibration is not None:
        calibration = repositories.calibrations.get(source.calibration)
        if calibration.type_name != type_name:
            raise ConflictError(
                f"Calibration {calibration.sequence} is a {calibration.type_name}, not a {type_name}: choose another."
            )
        give_calibration(repositories, method, scan, calibration)
        return
    if source.scan is not None:
        found = _result_of_scan(context, repositories, type_name, source.scan)
    else:
        found = _result_of_folder(context, method, type_name, Path(str(source.folder)))
    repositories.given.add(
        scan, place, type_name, found.document, content_hash(found.document), found.origin
    )


def require_handed(method: Method, type_name: str) -> str:
    """Return the name that such a result is given under; ConflictError naming what may be handed over."""
    if type_name not in method.handed:
        there_are = ", ".join(method.handed) or "nothing"
        raise ConflictError(
            f"{method.name} takes no {type_name} from outside; what can be handed over: {there_are}."
        )
    return method.handed[type_name]


class _Found(NamedTuple):
    document: dict[str, Any]
    origin: dict[str, Any]


def _result_of_scan(
    context: Context, repositories: Repositories, type_name: str, scan: str
) -> _Found:
    loaded = load_scan(repositories, context.registry, scan)
    for planned in reversed(loaded.plan.stages):
        result = planned.result
        if result is not None and planned.stage.output.__name__ == type_name:
            sentence = f"From scan {loaded.title!r}, {planned.stage.title}."
            origin = {"sentence": sentence, "scan": scan, "stage": planned.name}
            return _Found(document_of(repositories, result), origin)
    for row in loaded.given.values():
        if row.type_name == type_name:
            sentence = f"From scan {loaded.title!r}, which was given it."
            return _Found(row.document, {"sentence": sentence, "scan": scan})
    raise NotFoundError(
        f"Scan {loaded.title!r} has no {type_name} now: run the stage that makes it."
    )


def _result_of_folder(context: Context, method: Method, type_name: str, folder: Path) -> _Found:
    written = _scan_file(folder)
    found = [r for r in (*written.results.values(), *written.given.values()) if r.type == type_name]
    if not found or found[-1].document is None:
        raise NotFoundError(f"The export in {folder} holds no {type_name}: name another one.")
    document = _checked(context, method, found[-1], folder)
    name = written.scan.name or written.scan.id
    sentence = f"From the export of {name!r} in {folder}."
    return _Found(document, {"sentence": sentence, "folder": str(folder), "scan": written.scan.id})


def _checked(
    context: Context, method: Method, written: WrittenGiven, folder: Path
) -> dict[str, Any]:
    document: dict[str, Any] = read_back(written.document, context.store, folder)
    decode(document, method.type_named(written.type), context.store)
    if content_hash(document) != written.hash:
        raise InvalidCaptureError(
            f"{written.type} in {folder / SCAN_FILE} isn't what was exported (its hash differs): export the scan again."
        )
    return document


def _scan_file(folder: Path) -> ScanFile:
    file = folder / SCAN_FILE
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        if document["format"] != SCAN_FORMAT:
            raise ValueError(f"its format is {document['format']!r}")
        return ScanFile.model_validate(document)
    except OSError as error:
        raise InvalidCaptureError(
            f"{file} can't be read ({error.strerror}): name the folder of an export."
        ) from None
    except (ValueError, KeyError, TypeError, ValidationError) as error:
        reason = str(error).partition("\n")[0]
        raise InvalidCaptureError(
            f"{file} isn't a scan of ours ({reason}): export the scan again."
        ) from None


def _present(loaded: LoadedScan, key: str) -> tuple[PlannedStage, RunRow]:
    for planned in loaded.plan.stages:
        if planned.key == key and planned.run is not None:
            return planned, planned.run
    raise ConflictError(
        f"That result of {loaded.title!r} isn't today's any more, or not finished: look at the scan again."
    )


def _refuse_unfit(
    registry: Registry, loaded: LoadedScan, planned: PlannedStage, run: RunRow
) -> None:
    stage, decision = planned.stage, planned.decision
    if stage.output.__name__ not in takers(registry):
        known = ", ".join(sorted(takers(registry))) or "none"
        raise ConflictError(
            f"No method takes a {stage.output.__name__} from outside, so {stage.title} isn't kept; kept can be: {known}."
        )
    if loaded.row.rig == NO_RIG:
        raise ConflictError(
            f"{loaded.title!r} was imported, so there is no rig to keep {stage.title} for: hand it to a scan instead."
        )
    accepted = decision is not None and decision.verdict is Verdict.ACCEPT
    rejected = decision is not None and not accepted
    if rejected or (run_level(run) is Level.FAILURE and not accepted):
        reason = "was rejected" if rejected else "failed a check"
        raise ConflictError(
            f"{stage.title} {reason}, so it isn't kept: accept it first, or redo it."
        )


def _stage_of(loaded: LoadedScan, place: str) -> str | None:
    return place if place in {s.name for s in loaded.method.stages} else None


def _view(repositories: Repositories, row: CalibrationRow) -> CalibrationView:
    newest = repositories.calibrations.newest(
        [row.type_name],
        rig=row.rig,
        facts_hash=row.facts_hash,
        calibration_hash=row.calibration_hash,
    ).get(row.type_name)
    return CalibrationView(
        number=row.sequence,
        type=row.type_name,
        title=words(row.type_name),
        rig=row.rig,
        scan=row.scan,
        scan_name=repositories.scans.get(row.scan).name,
        stage=row.stage,
        who=row.who,
        when=row.when,
        result_hash=row.hash,
        facts_hash=row.facts_hash,
        calibration_hash=row.calibration_hash,
        newest=newest is not None and newest.sequence == row.sequence,
        withdrawn=row.withdrawn,
        withdrawn_by=row.withdrawn_by,
    )
