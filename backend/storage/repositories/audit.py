"""The audit trail: a table that only grows."""

from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from backend.storage import tables
from backend.storage.repositories.conversion import as_row
from backend.storage.rows import AuditRow


class AuditTrail:
    """Who did what to a scan, when and why."""

    def __init__(self, session: Session, now: Callable[[], datetime]) -> None:
        self._session = session
        self._now = now

    def add(
        self,
        scan: str,
        who: str,
        action: str,
        stage: str | None,
        sentence: str,
        details: Mapping[str, Any] | None = None,
    ) -> None:
        """Append a line."""
        self._session.add(
            tables.Audit(
                scan=scan,
                when=self._now(),
                who=who,
                action=action,
                stage=stage,
                sentence=sentence,
                details=dict(details or {}),
            )
        )
        self._session.flush()

    def of(self, scan: str) -> list[AuditRow]:
        """Return the scan's lines, oldest first."""
        query = (
            select(tables.Audit).where(tables.Audit.scan == scan).order_by(tables.Audit.sequence)
        )
        return [as_row(AuditRow, record) for record in self._session.scalars(query)]

    def last_of_each(self, scans: Iterable[str]) -> dict[str, int]:
        """Return the number of the newest line of each of the scans: whatever happens to a scan raises it."""
        query = (
            select(tables.Audit.scan, func.max(tables.Audit.sequence))
            .where(tables.Audit.scan.in_(list(scans)))
            .group_by(tables.Audit.scan)
        )
        return {scan: int(sequence) for scan, sequence in self._session.execute(query)}
