"""Do a scan again from its captured frames and compare the results, hash by hash."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from backend.contract.events import Event, JobProgress
from backend.contract.requests import Decide, StartRun
from backend.contract.scans import ScanState
from backend.devices.protocols import Rig
from backend.domain.errors import ConflictError, InvalidCaptureError, RigFailedError
from backend.domain.shots import Progress
from backend.domain.states import StageStatus, Verdict
from backend.jobs.edits import FIRST_TAKE
from backend.jobs.execution import Workshop
from backend.jobs.execution import versions as program_versions
from backend.jobs.loading import NO_RIG, LoadedScan, load_scan
from backend.jobs.rigs import RigPool
from backend.jobs.runner import InlineRunner
from backend.methods import Registry
from backend.services import running
from backend.services.capture_folder import open_capture
from backend.services.context import Context
from backend.services.events import EventHub
from backend.services.importing import Importer, read_scan_file
from backend.services.states import scan_state
from backend.storage.artifacts import ArtifactStore, LocalArtifactStore
from backend.storage.database import Database
from backend.storage.rows import FrameRow

_WHO = "replay"


@dataclass(frozen=True)
class ReplayedStage:
    """One stage, then and now."""

    name: str
    title: str
    expected: str | None
    """Hash of the result then; None: there was none."""
    found: str | None
    """Hash of the result now; None: there is none."""
    message: str
    """What the stage says now."""

    @property
    def is_same(self) -> bool:
        """True if the result is bit by bit what it was."""
        return self.expected == self.found

    @property
    def verdict(self) -> str:
        """Say it in a word or two."""
        if self.expected is None:
            return "had no result" if self.found is None else "has a result now"
        if self.found is None:
            return "no result"
        return "same" if self.is_same else "different"


@dataclass(frozen=True)
class Replay:
    """What a replay found."""

    name: str
    stages: tuple[ReplayedStage, ...]
    versions_then: Mapping[str, str]
    versions_now: Mapping[str, str]

    @property
    def is_same(self) -> bool:
        """True if every result that there was came out the same."""
        return all(stage.is_same for stage in self.stages if stage.expected is not None)

    @property
    def changed_versions(self) -> dict[str, tuple[str, str]]:
        """Programs that are of another version now: what a difference may come from."""
        then, now = self.versions_then, self.versions_now
        return {n: (then[n], now[n]) for n in then if n in now and then[n] != now[n]}


@dataclass(frozen=True)
class _Past:
    """What the scan was."""

    name: str
    hashes: Mapping[str, str | None]
    versions: Mapping[str, str]


def replay_scan(context: Context, scan: str, *, progress: Progress | None = None) -> Replay:
    """Do a scan of the database again, from its journal; the scan itself stays as it is.

    Raises
    ------
    NotFoundError
        If there is no such scan.
    ConflictError
        If nothing of it was captured or handed over yet.
    """
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        journal = repositories.frames.of_scan(scan)
    hashes = {p.name: p.result.hash if p.result else None for p in loaded.plan.stages}
    if not any(hashes.values()):
        raise ConflictError(f"{loaded.title!r} has no results to compare with: run it first.")
    versions = {n: v for p in loaded.plan.stages if p.run for n, v in p.run.versions.items()}
    with _workroom(context.registry, progress, context.store) as room:
        _copy(loaded, journal, room.database)
        return _replayed(room, scan, _Past(loaded.title, hashes, versions))


def replay_folder(path: Path, methods: Registry, *, progress: Progress | None = None) -> Replay:
    """Do an exported scan again, from the frames in its folder.

    Raises
    ------
    InvalidCaptureError
        If the folder isn't an export with frames, or a file of it is damaged.
    """
    folder = open_capture(path)
    scan_file = read_scan_file(folder)
    if scan_file is None:
        raise InvalidCaptureError(
            f"{folder.folder} has no scan.json to compare with: export the scan with its frames."
        )
    versions = {n: v for stage in scan_file.stages for n, v in stage.versions.items()}
    hashes = {stage.name: stage.result_hash for stage in scan_file.stages}
    past = _Past(scan_file.scan.name or scan_file.scan.id, hashes, versions)
    with _workroom(methods, progress) as room:
        scan = Importer(room.database, room.store, methods).run(path, who=_WHO, progress=progress)
        return _replayed(room, scan, past)


@contextlib.contextmanager
def _workroom(
    methods: Registry, progress: Progress | None, store: ArtifactStore | None = None
) -> Iterator[Context]:
    """Open a database that is thrown away afterwards, and a store unless there is one that has the frames."""
    with tempfile.TemporaryDirectory(prefix="unglare-replay-") as name, ExitStack() as stack:
        database = Database(f"sqlite:///{Path(name) / 'replay.db'}")
        stack.callback(database.close)
        database.upgrade()
        store = store or LocalArtifactStore(Path(name) / "artifacts", durable=False)
        rigs = RigPool(_no_rig)
        shop = Workshop(database, store, rigs, lambda: methods, _passed_on(progress))
        yield Context(
            database=database,
            store=store,
            runner=InlineRunner(shop, who=_WHO),
            rigs=rigs,
            registry=methods,
            events=EventHub(),
            version="",
        )


def _no_rig(name: str, options: Mapping[str, Any]) -> Rig:
    raise RigFailedError(f"A replay asks no rig, but something wants {name!r}: this is a defect.")


def _passed_on(progress: Progress | None) -> Callable[[Event], None]:
    def publish(event: Event) -> None:
        if progress is not None and isinstance(event, JobProgress) and event.job.stage:
            progress(event.job.progress, f"{event.job.stage} {event.job.text}".strip())

    return publish


def _copy(loaded: LoadedScan, journal: Sequence[FrameRow], database: Database) -> None:
    """Write the scan into another database as if its frames had been imported."""
    takes = {(p.name, p.take) for p in loaded.plan.stages if p.stage.captures}
    row = replace(
        loaded.row, rig=NO_RIG, rig_options={}, preset=None, recipe=_recipe(loaded), revision=0
    )
    with database.transaction() as repositories:
        repositories.scans.add(row)
        for given in loaded.given.values():
            repositories.given.add(
                row.id, given.name, given.type_name, given.document, given.hash, given.origin
            )
        for frame in journal:
            if (frame.stage, frame.take) in takes:
                repositories.frames.add(replace(frame, take=FIRST_TAKE))


def _recipe(loaded: LoadedScan) -> dict[str, dict[str, Any]]:
    """Return today's settings of a scan as far as they aren't defaults."""
    recipe: dict[str, dict[str, Any]] = {}
    for planned in loaded.plan.stages:
        defaults = planned.stage.params().model_dump(mode="json")
        values = planned.settings.values
        recipe[planned.name] = {n: v for n, v in values.items() if v != defaults[n]}
    return recipe


def _replayed(room: Context, scan: str, past: _Past) -> Replay:
    state = _run_through(room, scan)
    return Replay(
        name=past.name,
        stages=tuple(
            ReplayedStage(s.name, s.title, past.hashes.get(s.name), s.result_hash, s.message)
            for s in state.stages
        ),
        versions_then=past.versions,
        versions_now=program_versions(),
    )


def _run_through(room: Context, scan: str) -> ScanState:
    """Run to the end; every gate is passed, because results are compared and not judged."""
    running.run(room, scan, StartRun(), _WHO)
    while True:
        with room.database.reading() as repositories:
            state = scan_state(room, repositories, scan)
        gates = [s for s in state.stages if s.status is StageStatus.AWAITING_REVIEW]
        if not gates or gates[0].stage_run is None:
            return state
        running.decide(room, gates[0].stage_run, Decide(verdict=Verdict.ACCEPT), _WHO)
