"""One scan measured in several ways: each way is an edit of its settings, so equal shots are taken once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from backend.contract.requests import EditSettings, StartRun
from backend.domain.errors import StageUnavailableError, UnglareError
from backend.domain.type_names import words
from backend.jobs.loading import LoadedScan, document_of
from backend.services import editing, running
from backend.services.context import Context
from backend.storage.codec import decode
from backend.storage.repositories import Repositories

T = TypeVar("T")

SettingsOfStages = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Variant:
    """One way to measure."""

    name: str
    title: str
    settings: SettingsOfStages
    """`{stage: {field: value}}`; fields that only other variants set go back to what the scan began with."""


def run_variant(
    context: Context,
    scan: str,
    variant: Variant,
    touched: Mapping[str, set[str]],
    who: str,
    *,
    until: str | None = None,
) -> str | None:
    """Measure a scan in one way.

    Parameters
    ----------
    context
        Its runner has to return from `start` when the job has ended.
    scan
        The scan that all variants share.
    variant
        How to measure.
    touched
        Fields that any variant of the scan sets, see `touched_fields`.
    who
        Stands in the audit trail.
    until
        Last stage; None: to the end.

    Returns
    -------
    What went wrong, in one sentence; None if nothing did.
    """
    try:
        choose(context, scan, variant.settings, touched, reason=variant.title, who=who)
        state = running.run(context, scan, StartRun(until=until, unattended=True), who)
    except UnglareError as error:
        return error.sentence
    return state.job.error if state.job else None


def touched_fields(settings: Sequence[SettingsOfStages]) -> dict[str, set[str]]:
    """Collect the fields that several sets of settings differ in."""
    touched: dict[str, set[str]] = {}
    for one in settings:
        for stage, fields in one.items():
            touched.setdefault(stage, set()).update(fields)
    return touched


def choose(
    context: Context,
    scan: str,
    settings: SettingsOfStages,
    touched: Mapping[str, set[str]],
    *,
    reason: str,
    who: str,
) -> None:
    """Edit the settings that variants differ in; all others stay as they are."""
    for stage, names in touched.items():
        changes = dict(settings.get(stage, {}))
        request = EditSettings(
            changes=changes,
            reset=tuple(sorted(names - set(changes))),
            reason=reason,
            revision=_revision(context, scan),
        )
        editing.edit(context, scan, stage, request, who)


def present_result(
    context: Context, repositories: Repositories, loaded: LoadedScan, kind: type[T]
) -> T:
    """Return the present result of the last stage that makes a type.

    Raises
    ------
    StageUnavailableError
        If no stage has one.
    """
    for planned in reversed(loaded.plan.stages):
        if planned.stage.output is kind and planned.result is not None:
            found: T = decode(document_of(repositories, planned.result), kind, context.store)
            return found
    raise StageUnavailableError(
        f"{loaded.title!r} has no {words(kind.__name__).lower()}: run it at least to the stage that makes one."
    )


def given_result(context: Context, loaded: LoadedScan, kind: type[T]) -> T:
    """Return a result that was given to a scan.

    Raises
    ------
    StageUnavailableError
        If it has none of that type.
    """
    row = loaded.given.get(kind.__name__)
    if row is None:
        raise StageUnavailableError(
            f"{loaded.title!r} has no {words(kind.__name__).lower()}: calibrate the rig."
        )
    found: T = decode(row.document, kind, context.store)
    return found


def _revision(context: Context, scan: str) -> int:
    with context.database.reading() as repositories:
        return repositories.scans.get(scan).revision
