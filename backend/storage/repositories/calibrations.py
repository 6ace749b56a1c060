"""Results that are kept for a rig."""

from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from backend.domain.errors import NotFoundError
from backend.storage import tables
from backend.storage.repositories.conversion import as_row
from backend.storage.rows import CalibrationRow


class Calibrations:
    """What is kept for the rigs. Rows are only added; one that is wrong is withdrawn."""

    def __init__(self, session: Session, now: Callable[[], datetime]) -> None:
        self._session = session
        self._now = now

    def add(
        self,
        *,
        type_name: str,
        rig: str,
        facts_hash: str,
        calibration_hash: str | None,
        document: dict[str, Any],
        hash: str,
        scan: str,
        stage: str,
        run: str,
        who: str,
    ) -> CalibrationRow:
        """Keep a result for a rig."""
        record = tables.Calibration(
            type_name=type_name,
            rig=rig,
            facts_hash=facts_hash,
            calibration_hash=calibration_hash,
            document=document,
            hash=hash,
            scan=scan,
            stage=stage,
            run=run,
            who=who,
            when=self._now(),
        )
        self._session.add(record)
        self._session.flush()
        return as_row(CalibrationRow, record)

    def get(self, sequence: int) -> CalibrationRow:
        """Return one; NotFoundError if there is none of that number."""
        return as_row(CalibrationRow, self._record(sequence))

    def of_rig(self, rig: str | None = None) -> tuple[CalibrationRow, ...]:
        """Return what was ever kept for a rig (None: for any), newest first."""
        query = select(tables.Calibration).order_by(tables.Calibration.sequence.desc())
        if rig is not None:
            query = query.where(tables.Calibration.rig == rig)
        return tuple(as_row(CalibrationRow, record) for record in self._session.scalars(query))

    def newest(
        self,
        types: Sequence[str],
        *,
        rig: str,
        facts_hash: str,
        calibration_hash: str | None,
    ) -> dict[str, CalibrationRow]:
        """Return the newest of each type that holds for a rig with these facts and this geometry."""
        table = tables.Calibration
        query = (
            select(table)
            .where(
                table.type_name.in_(types),
                table.rig == rig,
                table.facts_hash == facts_hash,
                table.calibration_hash.is_not_distinct_from(calibration_hash),
                table.withdrawn.is_(None),
            )
            .order_by(table.sequence)
        )
        return {r.type_name: as_row(CalibrationRow, r) for r in self._session.scalars(query)}

    def withdraw(self, sequence: int, who: str) -> CalibrationRow:
        """Take one back; nothing happens if it is taken back already."""
        record = self._record(sequence)
        if record.withdrawn is None:
            record.withdrawn, record.withdrawn_by = self._now(), who
            self._session.flush()
        return as_row(CalibrationRow, record)

    def _record(self, sequence: int) -> tables.Calibration:
        found = self._session.get(tables.Calibration, sequence)
        if found is None:
            raise NotFoundError(
                f"there is no calibration {sequence}; `unglare calibrations list` shows their numbers"
            )
        return found
