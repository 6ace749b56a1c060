"""Jobs: what was asked to run, and how far it is."""

from collections.abc import Callable, Iterable
from datetime import datetime
from typing import TypedDict, Unpack

from sqlalchemy import select
from sqlalchemy.orm import Session

from backend.domain.errors import NotFoundError
from backend.domain.states import JobStatus
from backend.storage import tables
from backend.storage.repositories.conversion import as_row, as_values
from backend.storage.rows import JobRow


class JobChanges(TypedDict, total=False):
    """What may change about a job; what is left out stays."""

    status: JobStatus
    stage: str | None
    progress: float
    text: str
    error: str | None


class Jobs:
    """The jobs of all scans."""

    def __init__(self, session: Session, now: Callable[[], datetime]) -> None:
        self._session = session
        self._now = now

    def add(self, row: JobRow) -> None:
        """Store a new job."""
        self._session.add(tables.Job(**as_values(row)))
        self._session.flush()

    def update(self, job: str, **changes: Unpack[JobChanges]) -> JobRow:
        """Change a job. Its start and end are noted when the status says so."""
        record = self._record(job)
        for name, value in changes.items():
            setattr(record, name, value)
        status = changes.get("status")
        if status is JobStatus.RUNNING and record.started is None:
            record.started = self._now()
        if status is not None and status.ended and record.ended is None:
            record.ended = self._now()
        self._session.flush()
        return as_row(JobRow, record)

    def get(self, job: str) -> JobRow:
        """Return a job; NotFoundError if there is none of that id."""
        return as_row(JobRow, self._record(job))

    def last_of(self, scan: str) -> JobRow | None:
        """Return the scan's newest job."""
        return self.last_of_each([scan]).get(scan)

    def last_of_each(self, scans: Iterable[str]) -> dict[str, JobRow]:
        """Return the newest job of each of the scans that has one, in one query."""
        query = (
            select(tables.Job)
            .where(tables.Job.scan.in_(list(scans)))
            .order_by(tables.Job.created, tables.Job.id)
        )
        return {record.scan: as_row(JobRow, record) for record in self._session.scalars(query)}

    def unfinished(self) -> list[JobRow]:
        """Return the jobs that are queued or running, oldest first."""
        going = [status for status in JobStatus if not status.ended]
        query = (
            select(tables.Job)
            .where(tables.Job.status.in_(going))
            .order_by(tables.Job.created, tables.Job.id)
        )
        return [as_row(JobRow, record) for record in self._session.scalars(query)]

    def _record(self, job: str) -> tables.Job:
        found = self._session.get(tables.Job, job)
        if found is None:
            raise NotFoundError(f"there is no job {job!r}; the scan's state shows its last one")
        return found
