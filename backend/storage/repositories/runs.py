"""Runs of stages, and what operators decided about their results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, defer

from backend.domain.checks import Check
from backend.domain.errors import NotFoundError
from backend.domain.ids import new_id
from backend.domain.states import Verdict
from backend.storage import tables
from backend.storage.repositories.conversion import as_row
from backend.storage.rows import DecisionRow, RunRow, RunStatus


class Runs:
    """The runs of every stage of every scan. A finished run is never changed again."""

    def __init__(self, session: Session, now: Callable[[], datetime]) -> None:
        self._session = session
        self._now = now

    def start(
        self,
        scan: str,
        stage: str,
        key: str,
        take: int,
        job: str | None = None,
        *,
        versions: Mapping[str, str] | None = None,
        device: Mapping[str, Any] | None = None,
    ) -> str:
        """Note that a stage begins; return the run's id."""
        record = tables.Run(
            id=new_id(),
            scan=scan,
            stage=stage,
            key=key,
            take=take,
            job=job,
            status=RunStatus.RUNNING,
            started=self._now(),
            checks=[],
            defect=False,
            versions=dict(versions or {}),
            device=dict(device or {}),
        )
        self._session.add(record)
        self._session.flush()
        return record.id

    def finish(
        self,
        run: str,
        document: Mapping[str, Any],
        hash: str,
        checks: Sequence[Check | Mapping[str, Any]] = (),
        duration_s: float | None = None,
        *,
        device: Mapping[str, Any] | None = None,
    ) -> None:
        """Store a run's encoded result with its content hash and checks."""
        record = self._end(run, RunStatus.FINISHED)
        record.document = dict(document)
        record.hash = hash
        record.checks = [_check_document(check) for check in checks]
        if duration_s is not None:
            record.duration_s = duration_s
        if device is not None:
            record.device = dict(device)
        self._session.flush()

    def fail(self, run: str, error: str, *, defect: bool = False) -> None:
        """Store the one sentence that a run ended with."""
        record = self._end(run, RunStatus.FAILED)
        record.error = error
        record.defect = defect
        self._session.flush()

    def cancel(self, run: str) -> None:
        """Note that the operator cancelled the run."""
        self._end(run, RunStatus.CANCELLED)
        self._session.flush()

    def interrupt(self, run: str) -> None:
        """Note that the process died during the run."""
        self._end(run, RunStatus.INTERRUPTED)
        self._session.flush()

    def get(self, run: str) -> RunRow:
        """Return a run; NotFoundError if there is none of that id."""
        return as_row(RunRow, self._record(run))

    def of(self, scan: str, *, documents: bool = True) -> list[RunRow]:
        """Return the scan's runs, oldest first; without their documents if they aren't wanted."""
        query = select(tables.Run).where(tables.Run.scan == scan).order_by(*_age())
        if not documents:
            query = query.options(defer(tables.Run.document, raiseload=True))
        return [_as_run(record, documents=documents) for record in self._session.scalars(query)]

    def finished(self, scan: str, key: str) -> RunRow | None:
        """Return the newest finished run with that key."""
        return self._newest(scan, key, RunStatus.FINISHED)

    def finished_by_key(self, scan: str) -> dict[str, RunRow]:
        """Return the newest finished run of every key of the scan, in one query."""
        query = (
            select(tables.Run)
            .where(tables.Run.scan == scan, tables.Run.status == RunStatus.FINISHED)
            .order_by(*_age())
        )
        return {record.key: as_row(RunRow, record) for record in self._session.scalars(query)}

    def latest_failed(self, scan: str, key: str) -> RunRow | None:
        """Return the newest failed run with that key."""
        return self._newest(scan, key, RunStatus.FAILED)

    def unfinished(self) -> list[RunRow]:
        """Return the runs that are marked as running, of all scans."""
        query = select(tables.Run).where(tables.Run.status == RunStatus.RUNNING).order_by(*_age())
        return [as_row(RunRow, record) for record in self._session.scalars(query)]

    def _newest(self, scan: str, key: str, status: RunStatus) -> RunRow | None:
        query = select(tables.Run).where(
            tables.Run.scan == scan, tables.Run.key == key, tables.Run.status == status
        )
        newest = [column.desc() for column in _age()]
        record = self._session.scalars(query.order_by(*newest).limit(1)).first()
        return None if record is None else as_row(RunRow, record)

    def _end(self, run: str, status: RunStatus) -> tables.Run:
        record = self._record(run)
        if record.status is not RunStatus.RUNNING:
            raise ValueError(f"run {run!r} is {record.status} already and can't become {status}")
        record.status = status
        record.finished = self._now()
        record.duration_s = max(0.0, (record.finished - record.started).total_seconds())
        return record

    def _record(self, run: str) -> tables.Run:
        found = self._session.get(tables.Run, run)
        if found is None:
            raise NotFoundError(f"there is no stage run {run!r}; the scan's state shows their ids")
        return found


def _age() -> tuple[Any, Any]:
    # Ids sort by the time of their making: they decide between runs of one clock tick.
    return tables.Run.started, tables.Run.id


def _as_run(record: tables.Run, *, documents: bool) -> RunRow:
    if documents:
        return as_row(RunRow, record)
    columns = [c.key for c in tables.Run.__mapper__.column_attrs if c.key != "document"]
    return RunRow(**{name: getattr(record, name) for name in columns})


def _check_document(check: Check | Mapping[str, Any]) -> dict[str, Any]:
    return asdict(check) if is_dataclass(check) else dict(check)


class Decisions:
    """Accepted and rejected results. An accepted decision holds for its key in its scan."""

    def __init__(self, session: Session, now: Callable[[], datetime]) -> None:
        self._session = session
        self._now = now

    def add(
        self,
        scan: str,
        run: str,
        stage: str,
        key: str,
        verdict: Verdict,
        reason: str,
        who: str,
        when: datetime | None = None,
    ) -> None:
        """Append a decision; `when` is now if it isn't given."""
        self._session.add(
            tables.Decision(
                scan=scan,
                run=run,
                stage=stage,
                key=key,
                verdict=verdict,
                reason=reason,
                who=who,
                when=when or self._now(),
            )
        )
        self._session.flush()

    def last(self, scan: str, key: str) -> DecisionRow | None:
        """Return the last decision on that key in that scan."""
        query = (
            select(tables.Decision)
            .where(tables.Decision.scan == scan, tables.Decision.key == key)
            .order_by(tables.Decision.sequence.desc())
            .limit(1)
        )
        record = self._session.scalars(query).first()
        return None if record is None else as_row(DecisionRow, record)

    def last_by_key(self, scan: str) -> dict[str, DecisionRow]:
        """Return the last decision on every key of the scan, in one query."""
        return {row.key: row for row in self.of(scan)}

    def of(self, scan: str) -> list[DecisionRow]:
        """Return the scan's decisions, oldest first."""
        query = (
            select(tables.Decision)
            .where(tables.Decision.scan == scan)
            .order_by(tables.Decision.sequence)
        )
        return [as_row(DecisionRow, record) for record in self._session.scalars(query)]
