"""The captured frames of a scan in the import format: `capture.json`, pictures, masks."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from backend.contract.capture import (
    Capture,
    CapturedCamera,
    CapturedFrame,
    CapturedProjector,
    Extrinsics,
    JournalPlace,
)
from backend.domain.method import Method
from backend.domain.rig import CameraFacts, PinholeModel, Pose, RigCalibration, RigFacts
from backend.domain.shots import Progress
from backend.jobs.evidence import evidence_of
from backend.numerics.pinhole import RigidTransform, compose, inverse
from backend.services.capture_calibration import PROJECTOR
from backend.services.export_folder import Array, ExportFolder, safe_name
from backend.storage.artifacts import ArtifactStore
from backend.storage.rows import AuditRow, FrameRow, GivenRow

_PNG_LEVEL = 1
"""Noise doesn't compress: the higher levels take ten times as long for a few per cent."""
_THREADS = 2
"""Pictures that are compressed at a time: memory for so many."""


@dataclass(frozen=True)
class _Picture:
    """One frame on its way into the folder."""

    artifact: str
    frame: CapturedFrame


def write_capture(
    folder: ExportFolder,
    store: ArtifactStore,
    method: Method,
    *,
    name: str,
    facts: RigFacts,
    calibration: RigCalibration | None,
    journal: tuple[FrameRow, ...],
    given: Mapping[str, GivenRow],
    progress: Progress | None = None,
) -> None:
    """Write `capture.json` and the pictures it names.

    Parameters
    ----------
    folder
        Where to.
    store
        Has the pictures.
    method
        The scan's method: knows which given results were made of imported frames.
    name
        Name of the capture.
    facts, calibration
        The rig's.
    journal
        Frames that were captured here; they are written with their places in the journal.
    given
        Results handed over with the scan; those of importers are written as the frames they hold.
    """
    pictures = [*_journalled(journal), *_imported(method, given)]
    if not pictures:
        return
    for mask in sorted({row.document["mask"] for row in journal if row.document["mask"]}):
        _write_mask(folder, mask, store.get(mask))
    _write_pictures(folder, store, pictures, progress)
    capture = Capture(
        format="unglare-capture",
        version=1,
        name=name,
        method=method.name,
        cameras={n: _camera(c, _model(calibration, n)) for n, c in facts.cameras.items()},
        projector=_projector(facts, calibration),
        extrinsics=tuple(_extrinsics(calibration)) if calibration else (),
        frames=tuple(picture.frame for picture in pictures),
        reference=facts.reference,
    )
    folder.write_json(
        "capture.json", capture.model_dump(mode="json", by_alias=True, exclude_none=True)
    )


def write_evidence(folder: ExportFolder, store: ArtifactStore, audit: Sequence[AuditRow]) -> None:
    """Write frames that couldn't be verified beside the capture: pictures, and `unverified.json` that says what they are.

    Nothing imports them.
    """
    failures = []
    for n, (row, frames) in enumerate(evidence_of(audit)):
        files = []
        for number, frame in enumerate(frames):
            name = f"unverified/{n:02d}/{safe_name(frame['camera'])}/{number:04d}.png"
            folder.write(name, (_png(store.get(frame["artifact"])),))
            told = {key: value for key, value in frame.items() if key != "artifact"}
            files.append({"file": name, **told})
        failures.append(
            {
                "stage": row.stage,
                "when": row.when.isoformat(),
                "reason": row.sentence,
                "frames": files,
            }
        )
    if failures:
        folder.write_json("unverified.json", failures)


def _journalled(journal: tuple[FrameRow, ...]) -> Iterator[_Picture]:
    counts: dict[tuple[str, str], int] = {}
    for row in journal:
        number = counts[row.stage, row.camera] = counts.get((row.stage, row.camera), -1) + 1
        mask = row.document["mask"]
        yield _Picture(
            row.artifact,
            CapturedFrame(
                file=f"frames/{row.stage}/{safe_name(row.camera)}/{number:04d}.png",
                camera=row.camera,
                exposure_ms=row.metadata["exposure_us"] / 1000.0,
                gain_db=row.metadata["gain_db"],
                pattern=row.document["pattern"],
                stage=row.stage,
                role=row.document["role"],
                mask=f"masks/{mask}.png" if mask else None,
                journal=JournalPlace(
                    take=row.take,
                    occurrence=row.occurrence,
                    exposure_ms=row.document["exposure_ms"],
                    gain_db=row.document["gain_db"],
                    mask=f"masks/{mask}.npy" if mask else None,
                    captured=row.when,
                    metadata=row.metadata,
                ),
            ),
        )


def _imported(method: Method, given: Mapping[str, GivenRow]) -> Iterator[_Picture]:
    """Return the frames that importers were given; those of the main capture name no stage."""
    main = next(iter(method.importers), None)
    for name in method.importers:
        frames = list(_frames(given[name].document)) if name in given else []
        for number, frame in enumerate(frames):
            yield _Picture(
                frame["image"]["$array"],
                CapturedFrame(
                    file=f"frames/{name}/{safe_name(frame['camera'])}/{number:04d}.png",
                    camera=frame["camera"],
                    exposure_ms=frame["exposure_ms"],
                    gain_db=frame["gain_db"],
                    pattern=frame["pattern"],
                    stage=None if name == main else name,
                    role=frame["role"],
                ),
            )


def _frames(document: Any) -> Iterator[dict[str, Any]]:
    """Find the frames of an encoded result, in their order."""
    if isinstance(document, Mapping):
        if "$frame" in document:
            yield document["$frame"]
            return
        document = list(document.values())
    if isinstance(document, list):
        for value in document:
            yield from _frames(value)


def _write_pictures(
    folder: ExportFolder, store: ArtifactStore, pictures: list[_Picture], progress: Progress | None
) -> None:
    """Compress on two threads, write in order."""
    with ThreadPoolExecutor(_THREADS) as threads:
        for start in range(0, len(pictures), 2 * _THREADS):
            batch = pictures[start : start + 2 * _THREADS]
            if progress:
                progress(start / len(pictures), f"picture {start + 1} of {len(pictures)}")
            for picture, png in zip(
                batch, threads.map(lambda p: _png(store.get(p.artifact)), batch), strict=True
            ):
                folder.write(picture.frame.file, (png,))


def _png(gray: Array) -> bytes:
    # Not imwrite: it doesn't tell when the disk is full.
    done, data = cv2.imencode(".png", gray, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    if not done:
        raise ValueError(f"a picture of {gray.dtype} {gray.shape} can't be written as PNG")
    return data.tobytes()


def _write_mask(folder: ExportFolder, hash: str, factor: Array) -> None:
    """Write a mask for everybody (16 bit) and bit by bit for ourselves."""
    folder.write(f"masks/{hash}.png", (_png(np.round(factor * 65535.0).astype(np.uint16)),))
    folder.write_array(f"masks/{hash}.npy", factor)


def _model(calibration: RigCalibration | None, name: str) -> PinholeModel | None:
    return calibration.cameras.get(name) if calibration else None


def _camera(facts: CameraFacts, model: PinholeModel | None) -> CapturedCamera:
    return CapturedCamera(
        width_px=facts.width_px,
        height_px=facts.height_px,
        bit_depth=facts.bit_depth,
        black_level_gray=facts.black_level_gray,
        full_well_e=facts.full_well_e,
        read_noise_e=facts.read_noise_e,
        **_optics(model),
    )


def _projector(facts: RigFacts, calibration: RigCalibration | None) -> CapturedProjector | None:
    if facts.projector is None:
        return None
    return CapturedProjector(
        width_px=facts.projector.width_px,
        height_px=facts.projector.height_px,
        frame_period_ms=facts.projector.frame_period_ms,
        gamma=facts.projector.gamma,
        **_optics(calibration.projector if calibration else None),
    )


def _optics(model: PinholeModel | None) -> dict[str, Any]:
    if model is None:
        return {}
    return {"K": model.K.tolist(), "distortion": model.distortion.tolist()}


def _extrinsics(calibration: RigCalibration) -> Iterator[Extrinsics]:
    """Tie every device to the reference camera."""
    reference_from_world = _transform(calibration.camera_from_world[calibration.reference])
    world_from_reference = inverse(reference_from_world)
    devices = {
        name: (pose, "stereo")
        for name, pose in calibration.camera_from_world.items()
        if name != calibration.reference
    }
    if calibration.projector_from_world is not None:
        devices[PROJECTOR] = (calibration.projector_from_world, "camera-projector")
    for name, (pose, kind) in devices.items():
        R, t_mm = compose(_transform(pose), world_from_reference)
        yield Extrinsics.model_validate(
            {
                "kind": kind,
                "from": calibration.reference,
                "to": name,
                "R": R.tolist(),
                "t_mm": t_mm.tolist(),
            }
        )


def _transform(pose: Pose) -> RigidTransform:
    return RigidTransform(pose.R, pose.t_mm)
