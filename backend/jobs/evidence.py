"""Frames that count for nothing: exposed, but nobody can say that they show what they were taken for.

They are kept to be looked at: in the store, with a line in the scan's audit trail that names them. The journal doesn't
have them, so no resume, replay or import ever takes one for a frame of the scan.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from backend.devices.protocols import Frame
from backend.jobs.sync_sets import Planned
from backend.storage.rows import AuditRow

ACTION = "unverified"
"""What the audit trail's line is called."""
MOST_FRAMES = 64
MOST_BYTES = 256 * 2**20
"""Of one failure: the frames around the one that is wrong tell what happened, the others only fill the disk."""
MOST_LINES = 8
"""Of one scan: whoever tries on and on doesn't fill the disk either."""


@dataclass(frozen=True)
class Unverified:
    """One frame that is kept to be looked at."""

    planned: Planned
    camera: str
    frame: Frame


KeepEvidence = Callable[[str, Sequence[Mapping[str, Any]]], bool]
"""Writes down why frames don't count, and the frames; False where there are enough already."""


def no_evidence(reason: str, frames: Sequence[Mapping[str, Any]]) -> bool:
    """Keep nothing."""
    return False


def chosen(
    planned: Sequence[Planned], frames: Sequence[Mapping[str, Frame]], number: int | None
) -> list[Unverified]:
    """Choose what is kept of exposures, in their order; those next to the frame `number` of the burst first."""
    pairs = list(zip(planned, frames, strict=False))
    centre = next((n for n, (p, _) in enumerate(pairs) if p.number == number), 0)
    near = sorted(range(len(pairs)), key=lambda n: abs(n - centre))
    kept: set[int] = set()
    count, size = 0, 0
    for n in near:
        count += len(pairs[n][1])
        size += sum(frame.data.nbytes for frame in pairs[n][1].values())
        if kept and (count > MOST_FRAMES or size > MOST_BYTES):
            break
        kept.add(n)
    return [
        Unverified(pairs[n][0], camera, frame)
        for n in sorted(kept)
        for camera, frame in pairs[n][1].items()
    ]


def evidence_of(
    audit: Iterable[AuditRow],
) -> Iterator[tuple[AuditRow, Sequence[Mapping[str, Any]]]]:
    """Return the lines of an audit trail that name such frames, with the frames."""
    for row in audit:
        if row.action == ACTION:
            yield row, row.details["frames"]
