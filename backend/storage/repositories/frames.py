"""The journal of captured frames: a table that only grows."""

from sqlalchemy import select
from sqlalchemy.orm import Session

from backend.storage import tables
from backend.storage.repositories.conversion import as_row, as_values
from backend.storage.rows import FrameRow


class Frames:
    """What was captured for (scan, stage, take), in the order of capture."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def add(self, row: FrameRow) -> None:
        """Append a frame whose artifact is in the store already.

        One place (scan, stage, take, shot, occurrence) takes one frame: a second is an IntegrityError.
        """
        self._session.add(tables.Frame(**as_values(row)))
        self._session.flush()

    def of(self, scan: str, stage: str, take: int) -> list[FrameRow]:
        """Return the frames of one take, oldest first."""
        query = (
            select(tables.Frame)
            .where(
                tables.Frame.scan == scan, tables.Frame.stage == stage, tables.Frame.take == take
            )
            .order_by(tables.Frame.sequence)
        )
        return [as_row(FrameRow, record) for record in self._session.scalars(query)]

    def takes(self, scan: str) -> set[tuple[str, int]]:
        """Return the stages and takes of which there are frames."""
        query = (
            select(tables.Frame.stage, tables.Frame.take)
            .where(tables.Frame.scan == scan)
            .distinct()
        )
        return {(stage, take) for stage, take in self._session.execute(query)}

    def of_scan(self, scan: str) -> list[FrameRow]:
        """Return the frames of all takes of all stages, oldest first."""
        query = (
            select(tables.Frame).where(tables.Frame.scan == scan).order_by(tables.Frame.sequence)
        )
        return [as_row(FrameRow, record) for record in self._session.scalars(query)]
