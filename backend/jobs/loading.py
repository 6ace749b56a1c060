"""Read a scan from the database, and find out where it stands."""

from collections.abc import Mapping
from dataclasses import dataclass

from backend.domain.method import Method
from backend.jobs.edits import present_takes, resolve_settings
from backend.jobs.plan import History, PlannedStage, ScanPlan, plan_scan
from backend.jobs.stage_work import Document
from backend.methods import Registry
from backend.storage.repositories import Repositories
from backend.storage.rows import EditRow, GivenRow, RunRow, RunStatus, ScanRow

NO_RIG = ""
"""Name of the rig of a scan whose frames were imported."""


@dataclass(frozen=True)
class LoadedScan:
    """A scan as it is in the database now."""

    row: ScanRow
    method: Method
    edits: list[EditRow]
    given: Mapping[str, GivenRow]
    runs: list[RunRow]
    """All runs, oldest first, without their documents."""
    plan: ScanPlan

    @property
    def title(self) -> str:
        """What a person calls the scan."""
        return self.row.name or self.row.id


def load_scan(repositories: Repositories, registry: Registry, scan: str) -> LoadedScan:
    """Read a scan and plan it. Documents of results stay in the database: keys need only their hashes.

    Raises
    ------
    NotFoundError
        If there is no such scan, or its method isn't there any more.
    """
    row = repositories.scans.get(scan)
    journal = repositories.frames.takes(scan) if row.rig == NO_RIG else ()
    method = registry.get(row.method)
    edits = repositories.edits.of(scan)
    given = repositories.given.of(scan)
    runs = repositories.runs.of(scan, documents=False)
    takes = present_takes(method, edits)
    finished = {run.key: run for run in runs if run.status is RunStatus.FINISHED}
    plan = plan_scan(
        scan,
        method,
        settings=resolve_settings(method, preset=row.preset, recipe=row.recipe, edits=edits),
        takes=takes,
        given=given,
        history=History(finished.get, repositories.decisions.last_by_key(scan).get),
        has_rig=row.rig != NO_RIG,
        journalled={stage for stage, take in journal if takes.get(stage) == take},
    )
    return LoadedScan(row, method, edits, given, runs, plan)


def load_inputs(repositories: Repositories, planned: PlannedStage) -> dict[str, Document | None]:
    """Read the documents of a stage's inputs."""
    return {
        name: document_of(repositories, source) if source else None
        for name, source in planned.inputs.items()
    }


def document_of(repositories: Repositories, result: RunRow | GivenRow) -> Document:
    """Return a result's document, which plans come without."""
    if isinstance(result, GivenRow):
        return result.document
    document = repositories.runs.get(result.id).document
    assert document is not None, "a plan's present runs are finished"
    return document
