"""Export a scan into a folder: cloud, maps, how it came about, and on request the captured frames."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from backend.contract.scan_file import (
    ScanFile,
    WrittenAudit,
    WrittenDecision,
    WrittenEdit,
    WrittenGiven,
    WrittenMethod,
    WrittenScan,
    WrittenSetting,
    WrittenStage,
)
from backend.contract.scans import ScanState, StageState
from backend.domain.arrays import array_hashes
from backend.domain.errors import ConflictError
from backend.domain.method import Wire
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import Progress
from backend.jobs.evidence import evidence_of
from backend.jobs.loading import LoadedScan, document_of, load_scan
from backend.services.context import Context
from backend.services.export_capture import write_capture, write_evidence
from backend.services.export_folder import (
    SCAN_FILE,
    Array,
    ExportFolder,
    refuse_foreign,
    safe_name,
    whole_folder,
)
from backend.services.handed import takers
from backend.services.ply import ply_parts
from backend.services.portable import written_out
from backend.services.reporting import load_cloud, report
from backend.services.states import scan_state
from backend.services.telling import announce
from backend.stages.cloud import Cloud
from backend.storage.artifacts import ArtifactStore
from backend.storage.codec import decode
from backend.storage.repositories import Repositories
from backend.storage.rows import AuditRow, DecisionRow, EditRow, FrameRow, GivenRow, RunRow

_MAPS = ("picture", "mask")


def export_scan(
    context: Context,
    scan: str,
    folder: Path,
    *,
    frames: bool,
    who: str,
    progress: Progress | None = None,
) -> tuple[Path, ...]:
    """Write a scan's present results into a folder and return its files.

    `scan.json` (how the scan came about, see `contract.scan_file`), `cloud.ply`,
    the method's own files, `maps/<stage>.<field>[.<camera>].npy` for every shown map,
    `arrays/` for what settings refer to, and with `frames` the captured frames in the
    import format, so that importing the folder gives the same results again; frames that
    couldn't be verified go to `unverified/`, which nothing imports. The folder appears whole or not
    at all; an older export in its place is replaced.

    Raises
    ------
    NotFoundError
        If there is no such scan.
    ConflictError
        If the folder holds anything else than an export, or can't be written.
    StorageFullError
        If there is no room; nothing is left behind.
    """
    refuse_foreign(folder.expanduser().absolute())  # before the truth is asked for
    metrics = report(context, scan).document()
    content = _Content.read(context, scan)
    if frames and not content.has_frames:
        raise ConflictError(
            f"Scan {content.loaded.title!r} has no frames yet: run it, or export it without frames."
        )
    with whole_folder(folder) as target:
        _write_results(target, content, context.store)
        if frames:
            _write_frames(target, content, context.store, progress)
        given = {
            name: _written_given(target, content, name, context.store) for name in content.given
        }
        arrays = _write_arrays(target, content, context.store)
        results = _written_results(target, content, context)
        document = content.scan_file(context, given, results, metrics, arrays, dict(target.hashes))
        target.write_json(SCAN_FILE, document.model_dump(mode="json"))
        names = sorted(target.hashes)
    with context.database.transaction() as repositories:
        sentence = f"Exported to {folder}{' with frames' if frames else ''}."
        repositories.audit.add(scan, who, "exported", None, sentence, {"folder": str(folder)})
        state = scan_state(context, repositories, scan)
    announce(context, state)
    return tuple(folder / name for name in names)


def cloud_parts(context: Context, scan: str) -> Iterator[bytes | memoryview]:
    """Return the last cloud of a scan as a PLY file, in pieces.

    Raises
    ------
    NotFoundError
        If there is no such scan.
    ConflictError
        If it has no cloud.
    """
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        cloud = load_cloud(context, repositories, loaded)
    if cloud is None:
        raise ConflictError(f"Scan {loaded.title!r} has no cloud yet: run it to the end.")
    return ply_parts(cloud)


@dataclass(frozen=True)
class _Content:
    """Everything of one scan, read in one transaction."""

    state: ScanState
    loaded: LoadedScan
    cloud: Cloud | None
    runs: Mapping[str, RunRow]
    """The runs of the present results, by stage."""
    journal: tuple[FrameRow, ...]
    """Frames of the present takes."""
    decisions: tuple[DecisionRow, ...]
    edits: tuple[EditRow, ...]
    audit: tuple[AuditRow, ...]
    facts: RigFacts | None
    calibration: RigCalibration | None
    files: Mapping[str, Mapping[str, Any]]
    """The method's own files whose results are there, with the arguments of their functions."""

    @classmethod
    def read(cls, context: Context, scan: str) -> "_Content":
        """Read it; NotFoundError if there is no such scan."""
        with context.database.reading() as repositories:
            loaded = load_scan(repositories, context.registry, scan)
            takes = {(p.name, p.take) for p in loaded.plan.stages if p.stage.captures}
            journal = repositories.frames.of_scan(scan)
            return cls(
                state=scan_state(context, repositories, scan),
                loaded=loaded,
                cloud=load_cloud(context, repositories, loaded),
                runs={p.name: p.run for p in loaded.plan.stages if p.run},
                journal=tuple(row for row in journal if (row.stage, row.take) in takes),
                decisions=tuple(repositories.decisions.of(scan)),
                edits=tuple(repositories.edits.of(scan)),
                audit=tuple(repositories.audit.of(scan)),
                facts=_given(loaded, RigFacts, context.store),
                calibration=_given(loaded, RigCalibration, context.store),
                files=_files(loaded, repositories, context.store),
            )

    @property
    def has_frames(self) -> bool:
        """True if something was captured or imported."""
        imported = set(self.given) & set(self.loaded.method.importers)
        unverified = any(evidence_of(self.audit))
        return self.facts is not None and bool(self.journal or imported or unverified)

    @property
    def given(self) -> Mapping[str, GivenRow]:
        """Results handed over with the scan."""
        return self.loaded.given

    def scan_file(
        self,
        context: Context,
        given: dict[str, WrittenGiven],
        results: dict[str, WrittenGiven],
        metrics: dict[str, Any],
        arrays: dict[str, str],
        files: dict[str, str],
    ) -> ScanFile:
        """Write how the scan came about."""
        row, method = self.loaded.row, self.loaded.method
        return ScanFile(
            format="unglare-scan",
            version=1,
            unglare=context.version,
            exported=_second(context.clock()),
            scan=WrittenScan(
                id=row.id,
                name=row.name,
                note=row.note,
                who=row.who,
                created=row.created,
                revision=row.revision,
                rig=row.rig,
                rig_options=dict(row.rig_options),
                preset=row.preset,
            ),
            method=WrittenMethod(name=method.name, title=method.title),
            settings={s.name: _written_settings(s) for s in self.state.stages},
            stages=tuple(self._stage(s) for s in self.state.stages),
            given=given,
            decisions=tuple(_written_decision(d) for d in self.decisions),
            edits=tuple(_written_edit(e) for e in self.edits),
            audit=tuple(_written_audit(a) for a in self.audit),
            devices={name: d for run in self.runs.values() for name, d in run.device.items()},
            metrics=metrics,
            results=results,
            arrays=arrays,
            files=files,
        )

    def _stage(self, state: StageState) -> WrittenStage:
        run = self.runs.get(state.name)
        return WrittenStage(
            name=state.name,
            title=state.title,
            version=self.loaded.method.stage(state.name).version,
            status=state.status.value,
            message=state.message,
            key=state.key,
            take=state.take,
            run=state.stage_run,
            result_hash=state.result_hash,
            started=state.started,
            duration_s=state.duration_s,
            checks=tuple(check.model_dump(mode="json") for check in state.checks),
            versions=dict(run.versions) if run else {},
        )


def _given(loaded: LoadedScan, kind: type, store: ArtifactStore) -> Any:
    row = loaded.given.get(kind.__name__)
    return decode(row.document, kind, store) if row else None


def _files(
    loaded: LoadedScan, repositories: Repositories, store: ArtifactStore
) -> dict[str, dict[str, Any]]:
    """Collect what the method's own files are made of; a file that lacks something isn't there."""
    found: dict[str, dict[str, Any]] = {}
    for name in loaded.method.files:
        arguments = {}
        for wire in loaded.method.file_wires(name):
            result = _result(loaded, wire)
            kind = wire.input.type
            document = None if result is None else document_of(repositories, result)
            arguments[wire.input.name] = None if document is None else decode(document, kind, store)
            if document is None and not wire.input.optional:
                break
        else:
            found[name] = arguments
    return found


def _result(loaded: LoadedScan, wire: Wire) -> GivenRow | RunRow | None:
    if wire.source is None:
        return loaded.given.get(wire.input.type.__name__)
    return loaded.plan.stage(wire.source).result


def _write_results(target: ExportFolder, content: _Content, store: ArtifactStore) -> None:
    if content.cloud is not None:
        target.write("cloud.ply", ply_parts(content.cloud))
    for name, arguments in content.files.items():
        target.write(name, (content.loaded.method.files[name](**arguments),))
    for name, array in _maps(content.state, store):
        target.write_array(f"maps/{name}.npy", array)


def _maps(state: ScanState, store: ArtifactStore) -> Iterator[tuple[str, Array]]:
    """Return every shown map of every present result, with its name."""
    for stage in state.stages:
        for field in stage.fields:
            if field.hint["kind"] not in _MAPS:
                continue
            for camera, ref in field.arrays.items():
                suffix = f".{safe_name(camera)}" if camera else ""
                yield f"{stage.name}.{field.name}{suffix}", store.get(ref.hash)


def _write_frames(
    target: ExportFolder, content: _Content, store: ArtifactStore, progress: Progress | None
) -> None:
    assert content.facts is not None, "refused before anything is written"
    write_capture(
        target,
        store,
        content.loaded.method,
        name=content.loaded.title,
        facts=content.facts,
        calibration=content.calibration,
        journal=content.journal,
        given=content.given,
        progress=progress,
    )
    write_evidence(target, store, content.audit)


def _write_arrays(target: ExportFolder, content: _Content, store: ArtifactStore) -> dict[str, str]:
    """Write the arrays that today's settings refer to."""
    files: dict[str, str] = {}
    for planned in content.loaded.plan.stages:
        for _, array_hash in array_hashes(planned.settings.params):
            files[array_hash] = f"arrays/{array_hash}.npy"
    for array_hash, name in files.items():
        target.write_array(name, store.get(array_hash))
    return files


def _written_given(
    target: ExportFolder, content: _Content, name: str, store: ArtifactStore
) -> WrittenGiven:
    row = content.given[name]
    imported = name in content.loaded.method.importers
    document = None if imported else _written_document(target, row.document, store)
    origin = dict(row.origin) if row.origin else None
    return WrittenGiven(type=row.type_name, hash=row.hash, document=document, origin=origin)


def _written_results(
    target: ExportFolder, content: _Content, context: Context
) -> dict[str, WrittenGiven]:
    """Write the results that can be handed to other scans, whole."""
    wanted = takers(context.registry)
    with context.database.reading() as repositories:
        found = {
            p.name: (p.stage.output.__name__, repositories.runs.get(p.run.id).document, p.run.hash)
            for p in content.loaded.plan.stages
            if p.run and p.stage.output.__name__ in wanted
        }
    return {
        stage: WrittenGiven(
            type=kind, hash=hash, document=_written_document(target, document, context.store)
        )
        for stage, (kind, document, hash) in found.items()
        if document is not None and hash is not None
    }


def _written_document(
    target: ExportFolder, document: Mapping[str, Any], store: ArtifactStore
) -> dict[str, Any]:
    def write(hash: str, array: Array) -> str:
        target.write_array(f"given/{hash}.npy", array)
        return f"given/{hash}.npy"

    written: dict[str, Any] = written_out(document, store, write)
    return written


def _written_settings(state: StageState) -> dict[str, WrittenSetting]:
    return {
        name: WrittenSetting(value=view.value, source=view.source, chosen=view.chosen)
        for name, view in state.settings.items()
    }


def _written_decision(row: DecisionRow) -> WrittenDecision:
    return WrittenDecision(
        stage=row.stage,
        key=row.key,
        verdict=row.verdict.value,
        reason=row.reason,
        who=row.who,
        when=row.when,
    )


def _written_edit(row: EditRow) -> WrittenEdit:
    return WrittenEdit(
        revision=row.revision,
        stage=row.stage,
        field=row.field,
        old=row.old,
        new=row.new,
        kind=row.kind.value,
        reason=row.reason,
        who=row.who,
        when=row.when,
    )


def _written_audit(row: AuditRow) -> WrittenAudit:
    return WrittenAudit(
        when=row.when, who=row.who, action=row.action, stage=row.stage, sentence=row.sentence
    )


def _second(moment: datetime) -> datetime:
    return moment.replace(microsecond=0)
