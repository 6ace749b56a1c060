"""Counts over all tables, for those who watch the system."""

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from backend.storage import tables


@dataclass(frozen=True)
class RunCount:
    """How often a stage ran with one outcome."""

    stage: str
    status: str
    count: int
    duration_s: float
    """Sum over these runs."""


@dataclass(frozen=True)
class Counts:
    """How much there is."""

    scans: int
    frames: int
    jobs: Mapping[str, int]
    """By status."""
    runs: tuple[RunCount, ...]


class Statistics:
    """Counts over all scans."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def counts(self) -> Counts:
        """Count everything, in four queries."""
        jobs = select(tables.Job.status, func.count()).group_by(tables.Job.status)
        runs = (
            select(
                tables.Run.stage,
                tables.Run.status,
                func.count(),
                func.coalesce(func.sum(tables.Run.duration_s), 0.0),
            )
            .group_by(tables.Run.stage, tables.Run.status)
            .order_by(tables.Run.stage, tables.Run.status)
        )
        return Counts(
            scans=self._number_of(tables.Scan),
            frames=self._number_of(tables.Frame),
            jobs={status.value: count for status, count in self._session.execute(jobs)},
            runs=tuple(
                RunCount(stage, status.value, count, float(duration_s or 0.0))
                for stage, status, count, duration_s in self._session.execute(runs)
            ),
        )

    def _number_of(self, table: type[tables.Base]) -> int:
        return self._session.scalar(select(func.count()).select_from(table)) or 0
