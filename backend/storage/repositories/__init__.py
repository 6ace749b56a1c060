"""Everything that is read from and written to the database, one class per table.

A `Repositories` lives as long as its transaction and is used by one thread. Nothing here commits.
"""

from collections.abc import Callable
from datetime import datetime

from sqlalchemy.orm import Session

from backend.storage.repositories.audit import AuditTrail
from backend.storage.repositories.calibrations import Calibrations
from backend.storage.repositories.edits import Edits
from backend.storage.repositories.frames import Frames
from backend.storage.repositories.jobs import Jobs
from backend.storage.repositories.runs import Decisions, Runs
from backend.storage.repositories.scans import GivenResults, Scans
from backend.storage.repositories.statistics import Statistics

__all__ = ["Repositories"]


class Repositories:
    """One unit of work: see `Database.transaction`."""

    def __init__(self, session: Session, now: Callable[[], datetime]) -> None:
        self.scans = Scans(session)
        self.given = GivenResults(session)
        self.calibrations = Calibrations(session, now)
        self.edits = Edits(session)
        self.runs = Runs(session, now)
        self.decisions = Decisions(session, now)
        self.frames = Frames(session)
        self.jobs = Jobs(session, now)
        self.audit = AuditTrail(session, now)
        self.statistics = Statistics(session)
