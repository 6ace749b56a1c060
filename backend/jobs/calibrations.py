"""Hand results that are kept for a rig to a new scan: the newest of each type that the method takes."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from backend.domain.method import Method
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.type_names import words
from backend.storage.repositories import Repositories
from backend.storage.rows import CalibrationRow, GivenRow


class RigIdentity(NamedTuple):
    """When two rigs are the same: a result that was made with one holds for the other."""

    rig: str
    facts_hash: str
    """Sizes, ranges and noise: another camera, another size or bit depth is another rig."""
    calibration_hash: str | None
    """Geometry: after a device was moved and calibrated anew, what was kept before doesn't hold any more."""


def rig_identity(rig: str, given: Mapping[str, GivenRow]) -> RigIdentity | None:
    """Return the identity of a scan's rig; None while its facts aren't known."""
    facts, calibration = given.get(RigFacts.__name__), given.get(RigCalibration.__name__)
    if facts is None:
        return None
    return RigIdentity(rig, facts.hash, calibration.hash if calibration else None)


def hand_over(
    repositories: Repositories, method: Method, scan: str, declined: Collection[str] = ()
) -> None:
    """Give a scan what is kept for its rig, but for types that it was given already or that were declined."""
    row = repositories.scans.get(scan)
    given = repositories.given.of(scan)
    identity = rig_identity(row.rig, given)
    wanted = [t for t, name in method.handed.items() if name not in given and t not in declined]
    if identity is None or not wanted:
        return
    kept = repositories.calibrations.newest(
        wanted,
        rig=identity.rig,
        facts_hash=identity.facts_hash,
        calibration_hash=identity.calibration_hash,
    )
    for type_name, calibration in kept.items():
        give_calibration(repositories, method, scan, calibration)
        repositories.audit.add(
            scan,
            row.who,
            "given",
            None,
            f"{words(type_name)} taken from calibration {calibration.sequence} of rig {row.rig}.",
            {"type": type_name, "calibration": calibration.sequence, "hash": calibration.hash},
        )


def give_calibration(
    repositories: Repositories, method: Method, scan: str, calibration: CalibrationRow
) -> None:
    """Store a kept result as given to a scan."""
    repositories.given.add(
        scan,
        method.handed[calibration.type_name],
        calibration.type_name,
        calibration.document,
        calibration.hash,
        origin(repositories, calibration),
    )


def origin(repositories: Repositories, calibration: CalibrationRow) -> dict[str, Any]:
    """Say where a kept result comes from."""
    source = repositories.scans.get(calibration.scan)
    sentence = (
        f"Calibration {calibration.sequence} of the rig: {source.name or source.id!r}, "
        f"{calibration.who}, {calibration.when:%d %b %Y %H:%M} UTC."
    )
    return {
        "sentence": sentence,
        "calibration": calibration.sequence,
        "scan": calibration.scan,
        "stage": calibration.stage,
    }
