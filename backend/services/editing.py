"""Change settings, take pictures again, undo. Edits are only ever added."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from backend.contract.requests import EditSettings, RedoStage, UndoEdit
from backend.contract.scans import ScanState
from backend.domain.errors import ConflictError, NotFoundError, StaleEditError
from backend.domain.ids import new_id
from backend.domain.stage import Stage
from backend.jobs.edits import (
    TAKE,
    edited_values,
    fresh_take,
    last_group,
    present_takes,
    preset_values,
    since,
)
from backend.jobs.loading import NO_RIG, LoadedScan, load_scan
from backend.jobs.stage_settings import check_values, require_arrays, require_field
from backend.services.context import Context
from backend.services.states import scan_state
from backend.services.telling import announce, refuse_running
from backend.services.words import shown_value
from backend.storage.repositories import Repositories
from backend.storage.rows import EditKind, EditRow


def edit(context: Context, scan: str, stage: str, request: EditSettings, who: str) -> ScanState:
    """Change settings of one stage; what changes nothing isn't stored.

    A field set to what it would be without edits counts as reset.

    Raises
    ------
    StaleEditError
        If one of these fields was edited since the client's revision; `details` holds that edit.
    InvalidSettingError
        Naming stage, field, value and what is allowed.
    """
    with context.database.transaction() as repositories:
        repositories.scans.lock(scan)
        loaded = load_scan(repositories, context.registry, scan)
        target = find_stage(loaded, stage)
        fields = {*request.changes, *request.reset}
        for name in sorted(fields):
            require_field(target, name)
        known = [row for row in since(loaded.edits, request.revision) if row.stage == stage]
        _refuse_stale(loaded, [row for row in known if row.field in fields])
        changes = _changes(context, loaded, target, request)
        if changes:
            _store(context, repositories, loaded, changes, reason=request.reason, who=who)
            _audit_edit(repositories, loaded, target, changes, request.reason, who)
        state = scan_state(context, repositories, scan)
    return announce(context, state)


def redo(context: Context, scan: str, stage: str | None, request: RedoStage, who: str) -> ScanState:
    """Take the pictures of a stage again: take + 1. Without a stage: of all of them, the part moved.

    Raises
    ------
    StaleEditError
        If somebody else did the same since the client's revision.
    ConflictError
        If the stage doesn't capture here, or a job runs: it would capture without being asked to.
    """
    with context.database.transaction() as repositories:
        repositories.scans.lock(scan)
        loaded = load_scan(repositories, context.registry, scan)
        refuse_running(context, repositories, loaded)
        stages = _retakable(loaded, None if request.all else stage)
        takes = present_takes(loaded.method, loaded.edits)
        names = [s.name for s in stages]
        newer = since(loaded.edits, request.revision)
        _refuse_stale(loaded, [r for r in newer if r.field == TAKE and r.stage in names])
        changes = [
            _Change(s, TAKE, takes[s.name], fresh_take(loaded.edits, s.name), EditKind.TAKE)
            for s in stages
        ]
        _store(context, repositories, loaded, changes, reason=request.reason, who=who)
        for change in changes:
            sentence = f"{change.stage.title}: take {change.new} instead of {change.old}."
            details = {"old": change.old, "new": change.new, "all": stage is None or request.all}
            repositories.audit.add(
                scan, who, "redone", change.stage.name, _because(sentence, request.reason), details
            )
        state = scan_state(context, repositories, scan)
    return announce(context, state)


def undo(context: Context, scan: str, request: UndoEdit, who: str) -> ScanState:
    """Take back the last request that still holds: old settings, old keys, old results.

    Raises
    ------
    StaleEditError
        If anything was edited since the client's revision: it would take back something else than it shows.
    ConflictError
        If there is nothing to undo, or a job runs and the undo is one of a take.
    """
    with context.database.transaction() as repositories:
        repositories.scans.lock(scan)
        loaded = load_scan(repositories, context.registry, scan)
        group = last_group(loaded.edits)
        if not group:
            raise ConflictError(f"There is nothing to undo in {loaded.title!r}.")
        _refuse_stale(loaded, since(loaded.edits, request.revision))
        if any(row.kind is EditKind.TAKE for row in group):
            refuse_running(context, repositories, loaded)
        stages = {row.stage: loaded.method.stage(row.stage) for row in group}
        changes = [
            _Change(stages[row.stage], row.field, row.new, row.old, EditKind.UNDO) for row in group
        ]
        _store(context, repositories, loaded, changes, who=who, reverts=group[0].group)
        for change in changes:
            repositories.audit.add(
                scan,
                who,
                "undone",
                change.stage.name,
                f"{change.stage.title}: {change.field} is {shown_value(change.new)} again.",
                {"field": change.field, "old": change.old, "new": change.new},
            )
        state = scan_state(context, repositories, scan)
    return announce(context, state)


def find_stage(loaded: LoadedScan, name: str) -> Stage:
    """Return a stage of the scan's method; NotFoundError naming those there are."""
    try:
        return loaded.method.stage(name)
    except KeyError:
        known = ", ".join(s.name for s in loaded.method.stages)
        raise NotFoundError(
            f"{loaded.method.name} has no stage {name!r}; its stages are {known}."
        ) from None


@dataclass(frozen=True)
class _Change:
    stage: Stage
    field: str
    old: Any
    new: Any
    kind: EditKind


def _changes(
    context: Context, loaded: LoadedScan, stage: Stage, request: EditSettings
) -> list[_Change]:
    """Find out what a request changes; settings are compared as they are stored, not as they are written."""
    edited = edited_values(loaded.edits).get(stage.name, {})
    base = _without_edits(loaded, stage)
    kept = {name: value for name, value in edited.items() if name not in request.reset}
    wanted = check_values(stage, _known(stage, base | kept | dict(request.changes)))
    require_arrays(stage, wanted, context.store.__contains__)
    new = wanted.model_dump(mode="json")
    unedited = check_values(stage, _known(stage, base)).model_dump(mode="json")
    old = loaded.plan.stage(stage.name).settings.values
    changes = []
    for name in dict.fromkeys([*request.changes, *request.reset]):
        if new[name] == unedited[name]:
            if name in edited:
                changes.append(_Change(stage, name, old[name], new[name], EditKind.RESET))
        elif new[name] != old[name] or name not in edited:
            changes.append(_Change(stage, name, old[name], new[name], EditKind.SET))
    return changes


def _without_edits(loaded: LoadedScan, stage: Stage) -> dict[str, Any]:
    preset = loaded.row.preset
    layer = preset_values(loaded.method, preset) if preset in loaded.method.presets else {}
    return {**layer.get(stage.name, {}), **loaded.row.recipe.get(stage.name, {})}


def _known(stage: Stage, values: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what an older version stored and today's stage doesn't know; requests are checked before."""
    return {name: value for name, value in values.items() if name in stage.params.model_fields}


def _retakable(loaded: LoadedScan, name: str | None) -> list[Stage]:
    if loaded.row.rig == NO_RIG:
        raise ConflictError(
            f"The frames of {loaded.title!r} were imported: there is no rig to take them again with."
        )
    capturing = [p.stage for p in loaded.plan.stages if p.stage.captures and not p.given]
    if name is None:
        return capturing
    stage = find_stage(loaded, name)
    if stage not in capturing:
        reason = "its result was handed over" if stage.captures else "it takes no pictures"
        raise ConflictError(f"{stage.title} can't be redone, {reason}: change a setting instead.")
    return [stage]


def _refuse_stale(loaded: LoadedScan, newer: Iterable[EditRow]) -> None:
    rows = list(newer)
    if not rows:
        return
    row = rows[-1]
    stage = loaded.method.stage(row.stage)
    did = f"{row.field} from {shown_value(row.old)} to {shown_value(row.new)}"
    raise StaleEditError(
        f"{row.who} changed {stage.title}, {did}, since you last looked: look at it and decide again.",
        details={
            "edit": {
                "stage": row.stage,
                "field": row.field,
                "old": row.old,
                "new": row.new,
                "who": row.who,
                "when": row.when.isoformat(),
                "reason": row.reason,
                "revision": row.revision,
            },
            "revision": loaded.row.revision,
        },
    )


def _store(
    context: Context,
    repositories: Repositories,
    loaded: LoadedScan,
    changes: list[_Change],
    *,
    who: str,
    reason: str = "",
    reverts: str | None = None,
) -> None:
    group, now = new_id(), context.clock()
    for change in changes:
        row = EditRow(
            scan=loaded.row.id,
            stage=change.stage.name,
            field=change.field,
            old=change.old,
            new=change.new,
            kind=change.kind,
            group=group,
            reason=reason,
            who=who,
            when=now,
            reverts=reverts,
        )
        repositories.edits.add(loaded.row.id, row)


def _audit_edit(
    repositories: Repositories,
    loaded: LoadedScan,
    stage: Stage,
    changes: list[_Change],
    reason: str,
    who: str,
) -> None:
    texts = [f"{c.field} from {shown_value(c.old)} to {shown_value(c.new)}" for c in changes]
    details = [
        {"field": c.field, "old": c.old, "new": c.new, "kind": c.kind.value} for c in changes
    ]
    sentence = _because(f"{stage.title}: {', '.join(texts)}.", reason)
    repositories.audit.add(
        loaded.row.id, who, "edited", stage.name, sentence, {"changes": details, "reason": reason}
    )


def _because(sentence: str, reason: str) -> str:
    return f"{sentence} {reason}".rstrip()
