"""Every use case under one roof: what the API and the command line call. Each is one transaction."""

from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from backend.contract.descriptions import MethodDescription, MethodList
from backend.contract.requests import (
    CreateScan,
    Decide,
    EditSettings,
    GivenSource,
    RedoStage,
    StartRun,
    UndoEdit,
)
from backend.contract.rigs import PartView, RigOffer, RigView
from backend.contract.scans import (
    ArtifactRef,
    AuditEntry,
    CalibrationView,
    PixelLevels,
    ScanState,
    ScanSummary,
)
from backend.devices.rig_shelf import RigShelf
from backend.domain.errors import ConflictError
from backend.domain.shots import Progress
from backend.jobs.loading import load_scan
from backend.jobs.recovery import recover
from backend.jobs.rigs import RigPool
from backend.jobs.runner import Runner
from backend.methods import Registry
from backend.services import (
    calibrations,
    editing,
    exporting,
    importing,
    replaying,
    reporting,
    rigs,
    running,
    scans,
)
from backend.services.array_uploads import UploadKind, store_upload
from backend.services.context import Context
from backend.services.events import EventHub
from backend.services.export_folder import refuse_foreign
from backend.services.live_pictures import LIVE_PX, Crop, live_frame, live_part
from backend.services.pixels import levels_at
from backend.services.points import pack_points
from backend.services.previews import Format, Kind, draw, value_at
from backend.services.rig_desk import RigDesk
from backend.services.rig_offers import offer_rigs
from backend.services.states import scan_state
from backend.storage.artifacts import ArtifactStore
from backend.storage.database import Database, utc_now
from backend.storage.repositories.statistics import Counts


class Services:
    """The application's use cases.

    Parameters
    ----------
    database, store, runner, rigs, registry
        What they work with. `runner` and `rigs` have to publish to `events`.
    events
        Where clients listen.
    version
        The application's version.
    clock
        Now, in UTC.
    rig_patience_s
        How long the answer to a new scan waits for its rig's facts [s]; later they come by themselves.
    offers
        Which rigs there are to choose from.
    shelf
        The station's rig files, for what is kept beside them.
    """

    def __init__(
        self,
        *,
        database: Database,
        store: ArtifactStore,
        runner: Runner,
        rigs: RigPool,
        registry: Registry,
        events: EventHub,
        version: str,
        clock: Callable[[], datetime] = utc_now,
        rig_patience_s: float = 0.05,
        offers: Callable[[], tuple[RigOffer, ...]] = offer_rigs,
        shelf: RigShelf | None = None,
    ) -> None:
        self.context = Context(
            database=database,
            store=store,
            runner=runner,
            rigs=rigs,
            registry=registry,
            events=events,
            version=version,
            clock=clock,
            rig_patience_s=rig_patience_s,
            offers=offers,
            shelf=shelf,
        )
        self.rig_desk = RigDesk(self.context)
        """Rigs without a scan: devices, live pictures, latency."""
        self._closed = False

    @property
    def events(self) -> EventHub:
        """Where clients listen."""
        return self.context.events

    def recover(self) -> int:
        """Mark what a killed process left as running; once, at the start of the process that owns the jobs."""
        return recover(self.context.database)

    def close(self) -> None:
        """Interrupt what runs, so that it can be continued, and give rigs and database back; once is enough."""
        if self._closed:
            return
        self._closed = True
        self.rig_desk.close()
        self.context.runner.close()
        self.context.rigs.close()
        self.context.database.close()

    # methods and scans

    def methods(self) -> MethodList:
        """Describe all methods, and say which plug-ins failed to load."""
        registry = self.context.registry
        described = [registry.methods[name].describe() for name in sorted(registry.methods)]
        return MethodList(
            methods=tuple(MethodDescription.model_validate(d) for d in described),
            broken=dict(registry.broken),
        )

    def create_scan(self, request: CreateScan, who: str) -> ScanState:
        """Make a scan; see `scans.create_scan`."""
        return scans.create_scan(self.context, request, who)

    def scan(self, scan: str) -> ScanState:
        """Return a scan's state; NotFoundError if there is none of that id."""
        with self.context.database.reading() as repositories:
            return scan_state(self.context, repositories, scan)

    def scans(self, limit: int = 50, offset: int = 0, text: str = "") -> tuple[ScanSummary, ...]:
        """Return a page of the scan list, newest first; `text` is looked for in names, notes, operators."""
        return scans.list_scans(self.context, limit, offset, text)

    def audit(self, scan: str) -> tuple[AuditEntry, ...]:
        """Return who did what to a scan, oldest first."""
        return scans.audit_trail(self.context, scan)

    def statistics(self) -> Counts:
        """Count scans, jobs, frames and runs, for those who watch the system."""
        with self.context.database.reading() as repositories:
            return repositories.statistics.counts()

    # captured folders

    def import_capture(
        self, path: str, name: str, who: str, progress: Progress | None = None
    ) -> ScanState:
        """Import a captured folder as a new scan; see `importing.import_capture`."""
        return importing.import_capture(
            self.context, Path(path), name=name, who=who, progress=progress
        )

    def export(
        self,
        scan: str,
        folder: str,
        frames: bool,
        who: str,
        progress: Progress | None = None,
    ) -> tuple[Path, ...]:
        """Write a scan's results into a folder and return its files; see `exporting.export_scan`."""
        return exporting.export_scan(
            self.context, scan, Path(folder), frames=frames, who=who, progress=progress
        )

    def refuse_export(self, folder: str) -> None:
        """Raise `ConflictError` if an export to that folder would be refused: before long work is done for it."""
        refuse_foreign(Path(folder).expanduser().absolute())

    def cloud_ply(self, scan: str) -> Iterator[bytes | memoryview]:
        """Return the last cloud of a scan as a PLY file, in pieces; ConflictError if it has none."""
        return exporting.cloud_parts(self.context, scan)

    def replay(self, scan: str, progress: Progress | None = None) -> replaying.Replay:
        """Do a scan again from its captured frames and compare; see `replaying.replay_scan`."""
        return replaying.replay_scan(self.context, scan, progress=progress)

    def replay_folder(self, path: str, progress: Progress | None = None) -> replaying.Replay:
        """Do an exported scan again and compare; see `replaying.replay_folder`."""
        return replaying.replay_folder(Path(path), self.context.registry, progress=progress)

    def report(self, scan: str) -> reporting.ScanReport:
        """Say what a scan is worth; see `reporting.report`."""
        return reporting.report(self.context, scan)

    # changes

    def edit(self, scan: str, stage: str, request: EditSettings, who: str) -> ScanState:
        """Change settings of a stage; see `editing.edit`."""
        return editing.edit(self.context, scan, stage, request, who)

    def redo(self, scan: str, stage: str | None, request: RedoStage, who: str) -> ScanState:
        """Take pictures again; see `editing.redo`."""
        return editing.redo(self.context, scan, stage, request, who)

    def undo(self, scan: str, request: UndoEdit, who: str) -> ScanState:
        """Take back the last edit; see `editing.undo`."""
        return editing.undo(self.context, scan, request, who)

    # calibrations

    def keep(self, stage_run: str, who: str) -> CalibrationView:
        """Keep a result for its rig; see `calibrations.keep`."""
        return calibrations.keep(self.context, stage_run, who)

    def withdraw(self, number: int, who: str) -> CalibrationView:
        """Take a calibration back; see `calibrations.withdraw`."""
        return calibrations.withdraw(self.context, number, who)

    def calibrations(self, rig: str | None = None) -> tuple[CalibrationView, ...]:
        """Return what was ever kept for a rig (None: for any), newest first."""
        return calibrations.listed(self.context, rig)

    def give(self, scan: str, type_name: str, source: GivenSource, who: str) -> ScanState:
        """Hand a result to a scan; see `calibrations.give`."""
        return calibrations.give(self.context, scan, type_name, source, who)

    def take_away(self, scan: str, type_name: str, who: str) -> ScanState:
        """Take a handed-over result away; see `calibrations.take_away`."""
        return calibrations.take_away(self.context, scan, type_name, who)

    # runs

    def run(self, scan: str, request: StartRun, who: str) -> ScanState:
        """Run what isn't current; see `running.run`."""
        return running.run(self.context, scan, request, who)

    def cancel(self, scan: str, who: str) -> ScanState:
        """End the scan's job; see `running.cancel`."""
        return running.cancel(self.context, scan, who)

    def decide(self, stage_run: str, request: Decide, who: str) -> ScanState:
        """Accept or reject a result; see `running.decide`."""
        return running.decide(self.context, stage_run, request, who)

    def wait(self, scan: str, timeout_s: float | None = None) -> ScanState:
        """Wait until the scan's job has ended (the command line does) and return the state.

        Raises
        ------
        ConflictError
            If it hasn't ended in time.
        """
        with self.context.database.reading() as repositories:
            job = repositories.jobs.last_of(scan)
        if job is not None and not self.context.runner.wait(job.id, timeout_s):
            raise ConflictError(f"The run of scan {scan} hasn't ended after {timeout_s} s.")
        return self.scan(scan)

    # arrays

    def artifact(self, hash: str) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return an array, mapped, read only."""
        return self.context.store.get(hash)

    def artifact_preview(
        self,
        hash: str,
        *,
        max_px: int = 1280,
        colormap: str = "gray",
        low: float | None = None,
        high: float | None = None,
        kind: Kind = "picture",
        format: Format = "png",
    ) -> bytes:
        """Return an array as a picture; see `previews.draw`."""
        return self.context.previews.get(
            (hash, max_px, colormap, low, high, kind, format),
            lambda: draw(
                self.artifact(hash),
                max_px=max_px,
                colormap=colormap,
                low=low,
                high=high,
                kind=kind,
                format=format,
            ),
        )

    def artifact_at(self, hash: str, x: int, y: int) -> Any:
        """Return what an array says at column x of row y; None where it isn't finite."""
        return value_at(self.artifact(hash), x, y)

    def upload_array(self, data: bytes, kind: UploadKind = UploadKind.MASK) -> ArtifactRef:
        """Keep an uploaded `.npy` file or picture; see `array_uploads.store_upload`."""
        return store_upload(self.context.store, data, kind)

    def levels_at(
        self, scan: str, stage: str, field: str, *, camera: str, x: int, y: int
    ) -> PixelLevels:
        """Return what all frames of a camera say at one pixel; see `pixels.levels_at`."""
        return levels_at(self.context, scan, stage, field, camera=camera, x=x, y=y)

    def cloud_preview(
        self,
        stage_run: str,
        field: str,
        *,
        budget: int = 300_000,
        beyond: int = 0,
        scalar: str | None = None,
    ) -> bytes:
        """Return a cloud thinned to at most `budget` points; see `points.pack_points`."""
        with self.context.database.reading() as repositories:
            run = repositories.runs.get(stage_run)
            method = load_scan(repositories, self.context.registry, run.scan).method
        if run.document is None:
            raise ConflictError(f"Stage run {stage_run} isn't finished: it has no points.")
        output = method.stage(run.stage).output
        return pack_points(
            output,
            run.document,
            field,
            self.context.store,
            budget=budget,
            beyond=beyond,
            scalar=scalar,
        )

    # rigs

    def rigs(self) -> tuple[RigOffer, ...]:
        """Return the rigs that a scan can be made with."""
        return rigs.offers(self.context)

    def rig(self, name: str, options: Mapping[str, Any]) -> RigView:
        """Describe a rig; see `rigs.view_rig`."""
        return rigs.view_rig(self.context, name, options)

    def scan_rig(self, scan: str) -> RigView:
        """Describe the rig as a scan has it; see `rigs.view_scan_rig`."""
        return rigs.view_scan_rig(self.context, scan)

    def live_frame(
        self,
        rig: str,
        camera: str,
        *,
        max_px: int = LIVE_PX,
        marks: bool = False,
        crop: Crop | None = None,
    ) -> bytes | None:
        """Return the newest picture of a camera as JPEG; never waits. See `live_pictures.live_jpeg`."""
        return live_frame(self.context, rig, camera, max_px=max_px, marks=marks, crop=crop)

    def live_part(self, rig: str, camera: str, crop: Crop) -> PartView | None:
        """Tell what a part of the newest picture of a camera says; never waits. See `live_pictures.live_part`."""
        return live_part(self.context, rig, camera, crop)
