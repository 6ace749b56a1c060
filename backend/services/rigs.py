"""What clients may know of rigs: offers, views, checks, live pictures."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from backend.contract.rigs import (
    CameraView,
    PinholeView,
    PoseView,
    ProjectorView,
    RigOffer,
    RigView,
)
from backend.domain.errors import NotFoundError, StageUnavailableError
from backend.domain.rig import PinholeModel, Pose, RigCalibration, RigFacts
from backend.jobs.rigs import RigGiven
from backend.services.context import Context
from backend.storage.codec import decode

_PER_EDGE = 8
"""Points that an edge of a bent screen is drawn with."""


def view_rig(context: Context, name: str, options: Mapping[str, Any]) -> RigView:
    """Describe a rig with its options; opens it unless it is known already.

    Raises
    ------
    NotFoundError
        If there is no such rig.
    """
    refuse_unknown(context, name)
    return rig_view(name, _title(context, name), options, context.rigs.given(name, options))


def refuse_unknown(context: Context, name: str) -> None:
    """Refuse a name that no rig has; `package.module:factory` is looked for when it is opened.

    Raises
    ------
    NotFoundError
        If there is none; the sentence lists those that there are.
    """
    known = [offer.name for offer in context.offers()]
    if ":" not in name and name not in known:
        raise NotFoundError(f"There is no rig {name!r}; there are: {', '.join(known)}.")


def view_scan_rig(context: Context, scan: str) -> RigView:
    """Describe the rig as a scan has it: what was handed over when it was made, also if it is gone since.

    Raises
    ------
    StageUnavailableError
        If the scan has no facts of a rig (yet).
    """
    with context.database.reading() as repositories:
        row = repositories.scans.get(scan)
        given = repositories.given.of(scan)
    if RigFacts.__name__ not in given:
        raise StageUnavailableError(
            f"Scan {row.name or row.id!r} knows nothing of its rig yet: it is asked at the first run."
        )
    facts = decode(given[RigFacts.__name__].document, RigFacts, context.store)
    known = given.get(RigCalibration.__name__)
    calibration = decode(known.document, RigCalibration, context.store) if known else None
    title = _title(context, row.rig) if row.rig else "Imported frames"
    return rig_view(row.rig, title, row.rig_options, RigGiven(facts, calibration))


def rig_view(name: str, title: str, options: Mapping[str, Any], rig: RigGiven) -> RigView:
    """Write facts and calibration as a client gets them."""
    return RigView(
        name=name,
        title=title,
        options=dict(options),
        reference=rig.facts.reference,
        cameras=tuple(_camera(camera, rig) for camera in rig.facts.cameras),
        projector=_projector(rig),
        screen_mm=_screen_edge(rig.calibration),
        mirror_mm=_mirror_middle(rig.calibration),
    )


def _screen_edge(calibration: RigCalibration | None) -> tuple[tuple[float, float, float], ...]:
    """Return the known points of the screen that are nearest to places around its edge, in the world."""
    if calibration is None or calibration.screen is None or calibration.screen_from_world is None:
        return ()
    along, there, back = (
        np.linspace(0, 1, _PER_EDGE, endpoint=False),
        np.ones(_PER_EDGE),
        np.zeros(_PER_EDGE),
    )
    x = np.concatenate([along, there, 1 - along, back])
    y = np.concatenate([back, along, there, 1 - along])
    shares, pose = calibration.screen.shares, calibration.screen_from_world
    nearest = [
        int(np.argmin(((shares - place) ** 2).sum(axis=1))) for place in zip(x, y, strict=True)
    ]
    kept = [k for i, k in enumerate(nearest) if k != nearest[i - 1]]
    world = (calibration.screen.points_mm[kept] - pose.t_mm) @ pose.R
    return tuple((float(p[0]), float(p[1]), float(p[2])) for p in world)


def _mirror_middle(calibration: RigCalibration | None) -> tuple[float, float, float] | None:
    pose = calibration.mirror_from_world if calibration else None
    if pose is None:
        return None
    x, y, z = (-pose.R.T @ pose.t_mm).tolist()
    return x, y, z


def _camera(name: str, rig: RigGiven) -> CameraView:
    facts, calibration = rig.facts.cameras[name], rig.calibration
    return CameraView(
        name=name,
        width_px=facts.width_px,
        height_px=facts.height_px,
        bit_depth=facts.bit_depth,
        exposure_min_ms=facts.exposure_min_ms,
        exposure_max_ms=facts.exposure_max_ms,
        model=_pinhole(calibration.cameras.get(name)) if calibration else None,
        camera_from_world=_pose(calibration.camera_from_world.get(name)) if calibration else None,
    )


def _projector(rig: RigGiven) -> ProjectorView | None:
    facts, calibration = rig.facts.projector, rig.calibration
    if facts is None:
        return None
    return ProjectorView(
        width_px=facts.width_px,
        height_px=facts.height_px,
        frame_period_ms=facts.frame_period_ms,
        model=_pinhole(calibration.projector) if calibration else None,
        projector_from_world=_pose(calibration.projector_from_world) if calibration else None,
    )


def _pinhole(model: PinholeModel | None) -> PinholeView | None:
    if model is None:
        return None
    return PinholeView(
        width_px=model.width_px,
        height_px=model.height_px,
        K=_rows(model.K),
        distortion=tuple(model.distortion.tolist()),
    )


def _pose(pose: Pose | None) -> PoseView | None:
    if pose is None:
        return None
    return PoseView(R=_rows(pose.R), t_mm=tuple(pose.t_mm.tolist()))


def _rows(matrix: np.ndarray[tuple[int, ...], np.dtype[Any]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


def _title(context: Context, name: str) -> str:
    titles = {offer.name: offer.title for offer in context.offers()}
    return titles.get(name, name)


def offers(context: Context) -> tuple[RigOffer, ...]:
    """Return the rigs that a scan can be made with."""
    return context.offers()
