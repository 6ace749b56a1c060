"""Import a captured folder as a new scan: frames into the store, then all rows in one transaction.

Frames become the results of capturing stages (`Method.importers`), so that the scan starts in the method's
middle. An export of ours goes further: its frames know which shot of which capture they are, so they become
the new scan's journal, and the capturing stages run again by driving their plans on it without a rig.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from backend.contract.capture import CapturedFrame, JournalPlace
from backend.contract.scan_file import SCAN_FORMAT, ScanFile
from backend.contract.scans import ScanState
from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.ids import new_id
from backend.domain.method import Method
from backend.domain.rig import RigCalibration
from backend.domain.shots import Progress, Shot
from backend.jobs.edits import FIRST_TAKE, check_recipe
from backend.jobs.journal import shot_document, shot_hash
from backend.jobs.loading import NO_RIG
from backend.methods import Registry
from backend.services.capture_calibration import capture_calibration
from backend.services.capture_folder import CaptureFolder, capture_facts
from backend.services.capture_sources import open_source
from backend.services.context import Context
from backend.services.portable import read_array, read_back
from backend.services.states import scan_state
from backend.services.telling import announce
from backend.storage.artifacts import ArtifactStore, StoredPixels
from backend.storage.codec import content_hash, decode, encode
from backend.storage.database import Database, utc_now
from backend.storage.rows import FrameRow, GivenRow, ScanRow


def import_capture(
    context: Context, path: Path, *, name: str, who: str, progress: Progress | None = None
) -> ScanState:
    """Import a captured folder as a new scan; see `Importer.run`."""
    importer = Importer(context.database, context.store, context.registry, context.clock)
    scan = importer.run(path, who=who, name=name, progress=progress)
    with context.database.reading() as repositories:
        state = scan_state(context, repositories, scan)
    return announce(context, state)


@dataclass(frozen=True)
class Importer:
    """Makes scans of captured folders."""

    database: Database
    store: ArtifactStore
    registry: Registry
    now: Callable[[], datetime] = utc_now

    def run(self, path: Path, *, who: str, name: str = "", progress: Progress | None = None) -> str:
        """Import `capture.json` (or the folder it is in) and return the new scan's id; nothing runs yet.

        Raises
        ------
        InvalidCaptureError, InvalidCalibrationError, InvalidSettingError, NotFoundError
            In one sentence: what is wrong with which file. No scan is made then.
        StorageFullError
            If there is no room for the frames.
        """
        folder = open_source(path)
        method = self.registry.get(folder.capture.method)
        plan = _ImportPlan(folder, method, read_scan_file(folder))
        calibration = plan.calibration()  # before hundreds of frames are read
        plan.bring_arrays(self.store)
        recipe = plan.recipe(self.store)
        stored = self._store_frames(plan, progress)
        scan = new_id()
        journal = self._journal(scan, stored, folder)
        given = self._given(plan, stored, calibration)
        row = self._row(scan, name, who, plan, recipe)
        with self.database.transaction() as repositories:
            repositories.scans.add(row)
            for result in given:
                repositories.given.add(
                    scan,
                    result.name,
                    result.type_name,
                    result.document,
                    result.hash,
                    result.origin,
                )
            for frame in journal:
                repositories.frames.add(frame)
            repositories.audit.add(
                scan,
                who,
                "imported",
                None,
                f"Imported {len(stored.frames)} frames of {folder.capture.name!r} from {folder.folder}{stored.left_out}.",
                plan.origin(),
            )
        return scan

    def _store_frames(self, plan: "_ImportPlan", progress: Progress | None) -> "_Stored":
        """Read, check and keep one picture after the other: never two of them in memory."""
        stored = _Stored()
        total = len(plan.folder.capture.frames)
        for number, (captured, gray) in enumerate(plan.folder.pictures()):
            if progress:
                progress(number / total, f"frame {number + 1} of {total}")
            place = plan.place_of(captured)
            if place is None:
                stored.unused[str(captured.stage)] += 1
                continue
            pixels = StoredPixels(self.store, self.store.put(gray).hash)
            frame = Frame(
                camera=captured.camera,
                pattern=captured.pattern,
                exposure_ms=captured.exposure_ms,
                pixels=pixels,
                bit_depth=plan.folder.capture.cameras[captured.camera].bit_depth,
                gain_db=captured.gain_db,
                role=captured.role,
            )
            stored.frames.append(_StoredFrame(place, frame, pixels.hash, captured, plan.journalled))
        return stored

    def _journal(self, scan: str, stored: "_Stored", folder: CaptureFolder) -> list[FrameRow]:
        rows: dict[tuple[str, str, int], FrameRow] = {}
        for frame in stored.frames:
            if frame.is_journalled and frame.captured.journal is not None:
                row = self._journal_row(scan, frame, frame.captured.journal, folder)
                key = (row.stage, row.shot, row.occurrence)
                if key in rows:
                    raise InvalidCaptureError(
                        f"{frame.captured.file} is the same shot of {row.stage} as an earlier frame: "
                        "take one of them out of capture.json."
                    )
                rows[key] = row
        return list(rows.values())

    def _journal_row(
        self, scan: str, frame: "_StoredFrame", place: JournalPlace, folder: CaptureFolder
    ) -> FrameRow:
        """Place a frame as if it had been captured in the new scan, whose takes start anew."""
        mask_hash = None
        if place.mask is not None:
            mask_hash = self.store.put(read_array(folder.folder, place.mask)).hash
        shot = Shot(
            frame.frame.pattern, place.exposure_ms, gain_db=place.gain_db, role=frame.frame.role
        )
        _require_told(place, frame.captured)
        return FrameRow(
            scan=scan,
            stage=frame.place,
            take=FIRST_TAKE,
            shot=shot_hash(shot, frame.frame.camera, mask_hash),
            occurrence=place.occurrence,
            camera=frame.frame.camera,
            document=shot_document(shot, mask_hash),
            artifact=frame.artifact,
            bit_depth=frame.frame.bit_depth,
            when=place.captured,
            metadata=dict(place.metadata),
        )

    def _given(
        self, plan: "_ImportPlan", stored: "_Stored", calibration: RigCalibration | None
    ) -> list[GivenRow]:
        rows = {row.name: row for row in plan.given_of_export(self.store)}
        for result in (capture_facts(plan.folder.capture), calibration):
            name = type(result).__name__
            if result is not None and name not in rows and type(result) in plan.method.given:
                rows[name] = self._given_row(name, result)
        for name, result in plan.folder.given.items():
            rows[name] = self._given_row(name, result)
        for name, importer in plan.method.importers.items():
            frames = stored.given_to(name)
            if frames:
                rows[name] = self._given_row(name, importer(frames))
        return list(rows.values())

    def _given_row(self, name: str, result: Any) -> GivenRow:
        document = encode(result, self.store)
        return GivenRow(name, type(result).__name__, document, content_hash(document))

    def _row(
        self,
        scan: str,
        name: str,
        who: str,
        plan: "_ImportPlan",
        recipe: Mapping[str, Mapping[str, Any]],
    ) -> ScanRow:
        origin = plan.scan_file
        return ScanRow(
            id=scan,
            name=name or (origin.scan.name if origin else "") or plan.folder.capture.name,
            note=origin.scan.note if origin else "",
            method=plan.method.name,
            rig=NO_RIG,
            rig_options={},
            preset=None,
            recipe=recipe,
            created=self.now(),
            who=who,
        )


@dataclass(frozen=True)
class _StoredFrame:
    """One frame that is in the store."""

    place: str
    """Name of the stage (or the given type) that it belongs to."""
    frame: Frame
    artifact: str
    captured: CapturedFrame
    is_journalled: bool


@dataclass
class _Stored:
    """What was read so far."""

    frames: list[_StoredFrame] = field(default_factory=list)
    unused: Counter[str] = field(default_factory=Counter)

    def given_to(self, name: str) -> tuple[Frame, ...]:
        """Return the frames that an importer gets."""
        return tuple(
            f.frame
            for f in self.frames
            if f.place == name and not (f.is_journalled and f.captured.journal)
        )

    @property
    def left_out(self) -> str:
        """Say which frames the method has no use for."""
        if not self.unused:
            return ""
        counts = ", ".join(f"{count} of {stage}" for stage, count in self.unused.items())
        return f"; left out, as without a scan.json of ours only the main capture is read: {counts}"


@dataclass(frozen=True)
class _ImportPlan:
    """What goes where."""

    folder: CaptureFolder
    method: Method
    scan_file: ScanFile | None

    def __post_init__(self) -> None:
        """Refuse what can't be imported before any picture is read."""
        if not self.method.importers and not self.journalled:
            raise InvalidCaptureError(f"The method {self.method.name!r} can't start from frames.")
        for frame in self.folder.capture.frames:
            if frame.stage is not None and frame.stage not in self._places:
                raise InvalidCaptureError(
                    f"{frame.file} belongs to a stage {frame.stage!r}, which {self.method.name!r} doesn't have; "
                    f"frames may belong to {', '.join(sorted(self._places))}."
                )
        if self.scan_file and self.scan_file.method.name != self.method.name:
            raise InvalidCaptureError(
                f"scan.json is of method {self.scan_file.method.name!r} but capture.json of {self.method.name!r}: "
                "they don't belong together, remove one."
            )
        if not any(self.place_of(frame) for frame in self.folder.capture.frames):
            raise InvalidCaptureError(
                f"No frame belongs to a capture of {self.method.name!r} that can be imported: "
                f"they may belong to {', '.join(self.method.importers)}."
            )

    @property
    def journalled(self) -> bool:
        """True for an export of ours whose frames know their shots."""
        return self.scan_file is not None and any(f.journal for f in self.folder.capture.frames)

    @property
    def _places(self) -> set[str]:
        return {s.name for s in self.method.stages if s.captures} | set(self.method.importers)

    def place_of(self, frame: CapturedFrame) -> str | None:
        """Return the stage or type that a frame belongs to; None if there is no use for it."""
        if frame.stage is None:
            return next(iter(self.method.importers), None)
        if frame.stage in self.method.importers or (self.journalled and frame.journal):
            return frame.stage
        return None

    def bring_arrays(self, store: ArtifactStore) -> None:
        """Put the arrays that the export's settings refer to into the store."""
        for array_hash, name in (self.scan_file.arrays if self.scan_file else {}).items():
            if store.put(read_array(self.folder.folder, name)).hash != array_hash:
                raise InvalidCaptureError(
                    f"{name} isn't what was exported (its hash differs): export the scan again."
                )

    def recipe(self, store: ArtifactStore) -> dict[str, dict[str, Any]]:
        """Return the settings of the export that aren't today's defaults, or those of another program's file."""
        if self.scan_file is None:
            return self._settings_of_file(store)
        chosen: dict[str, dict[str, Any]] = {}
        for s in self.method.stages:
            written = self.scan_file.settings.get(s.name, {})
            defaults = s.params().model_dump(mode="json")
            values = {
                name: setting.value
                for name, setting in written.items()
                if setting.source != "default" or setting.value != defaults.get(name, setting.value)
            }
            if values:
                chosen[s.name] = values
        return check_recipe(self.method, None, chosen, store.__contains__)

    def _settings_of_file(self, store: ArtifactStore) -> dict[str, dict[str, Any]]:
        """Return the settings that another program's file brings."""
        chosen = {stage: dict(values) for stage, values in self.folder.settings.items()}
        for (stage, name), array in self.folder.setting_arrays.items():
            chosen.setdefault(stage, {})[name] = store.put(array).hash
        return check_recipe(self.method, None, chosen, store.__contains__)

    def calibration(self) -> RigCalibration | None:
        """Return the folder's own calibration, where an export doesn't bring the exact one."""
        if self.scan_file and RigCalibration.__name__ in self.scan_file.given:
            return None
        return self.folder.calibration or capture_calibration(self.folder.capture)

    def given_of_export(self, store: ArtifactStore) -> list[GivenRow]:
        """Return what was handed over with the exported scan, but for imported frames."""
        if self.scan_file is None:
            return []
        rows = []
        for name, given in self.scan_file.given.items():
            if given.document is None:
                continue
            document = read_back(given.document, store, self.folder.folder)
            self._check(name, document, given.hash, store)
            hash = content_hash(document)
            rows.append(GivenRow(name, given.type, document, hash, given.origin))
        return rows

    def _check(self, name: str, document: dict[str, Any], hash: str, store: ArtifactStore) -> None:
        try:
            decode(document, self.method.type_of(name), store)
        except KeyError:
            raise InvalidCaptureError(
                f"scan.json hands over {name!r}, which {self.method.name!r} doesn't know: take it out."
            ) from None
        if content_hash(document) != hash:
            raise InvalidCaptureError(
                f"{name} in scan.json isn't what was exported (its hash differs): export the scan again."
            )

    def origin(self) -> dict[str, Any]:
        """Return where the frames come from, for the audit trail."""
        details: dict[str, Any] = {"folder": str(self.folder.folder)}
        if self.scan_file:
            details["scan"] = self.scan_file.scan.id
            details["unglare"] = self.scan_file.unglare
        return details


def read_scan_file(folder: CaptureFolder) -> ScanFile | None:
    """Read the `scan.json` beside a capture; None if there is none.

    Raises
    ------
    InvalidCaptureError
        If it isn't one of ours, or of a version that isn't known.
    """
    if folder.scan is None:
        return None
    file = folder.folder / "scan.json"
    if folder.scan.get("format") != SCAN_FORMAT:
        raise InvalidCaptureError(
            f"{file} isn't a scan of ours (its format is {folder.scan.get('format')!r}, not {SCAN_FORMAT!r}): "
            "remove it to import with default settings."
        )
    try:
        return ScanFile.model_validate(folder.scan)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InvalidCaptureError(
            f"{file}: {place}: {first['msg']}; remove it to import with default settings."
        ) from None


def _require_told(place: JournalPlace, frame: CapturedFrame) -> None:
    """Refuse a journalled frame that doesn't tell what the camera made of the exposure: results depend on it."""
    told = place.metadata.get("exposure_us"), place.metadata.get("gain_db")
    if not all(isinstance(value, int | float) for value in told):
        raise InvalidCaptureError(
            f"{frame.file} doesn't tell the exposure and gain that the camera used "
            "(journal.metadata.exposure_us and gain_db): export the scan again."
        )
