"""The journal of captured frames of one take: what counts after a crash, an undo, or in a replay."""

from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

from backend.domain.hashing import document_hash
from backend.domain.shots import Shot
from backend.storage.database import Database
from backend.storage.rows import FrameRow


@runtime_checkable
class Journal(Protocol):
    """Finds frames by (shot, occurrence) and takes new ones."""

    def find(self, shot: str, occurrence: int) -> FrameRow | None:
        """Return the frame that was captured for this shot, None if none was."""
        ...

    def add(self, rows: Sequence[FrameRow]) -> None:
        """Append a shot's frames, whose artifacts are in the store, together. From now on they count."""
        ...

    def __len__(self) -> int:
        """Count the frames that count."""
        ...


class DatabaseJournal:
    """The journal of (scan, stage, take), read once and appended to frame by frame."""

    def __init__(self, database: Database, scan: str, stage: str, take: int) -> None:
        self._database = database
        with database.reading() as repositories:
            self._known = _by_shot(repositories.frames.of(scan, stage, take))

    def find(self, shot: str, occurrence: int) -> FrameRow | None:  # noqa: D102 (see Journal)
        return self._known.get((shot, occurrence))

    def add(self, rows: Sequence[FrameRow]) -> None:  # noqa: D102 (see Journal)
        with self._database.transaction() as repositories:
            for row in rows:
                repositories.frames.add(row)
        self._known |= _by_shot(rows)

    def __len__(self) -> int:
        return len(self._known)


def _by_shot(rows: Iterable[FrameRow]) -> dict[tuple[str, int], FrameRow]:
    return {(row.shot, row.occurrence): row for row in rows}


def shot_document(shot: Shot, mask_hash: str | None) -> dict[str, object]:
    """Write a shot as JSON values, as the journal keeps it."""
    return {
        "pattern": shot.pattern.model_dump(mode="json"),
        "exposure_ms": float(shot.exposure_ms),
        "gain_db": float(shot.gain_db),
        "role": shot.role,
        "mask": mask_hash,
    }


def shot_hash(shot: Shot, camera: str, mask_hash: str | None) -> str:
    """Identify a shot of one camera by what was asked for; the role is a label and stays out."""
    document = shot_document(shot, mask_hash)
    del document["role"]
    return document_hash([document, camera])
