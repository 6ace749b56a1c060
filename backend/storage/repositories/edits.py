"""Changes of settings: a table that only grows."""

from dataclasses import replace

from sqlalchemy import select
from sqlalchemy.orm import Session

from backend.storage import tables
from backend.storage.repositories.conversion import as_row, as_values
from backend.storage.repositories.scans import Scans
from backend.storage.rows import EditRow


class Edits:
    """The edits of every scan, numbered 1, 2, 3 ... within it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._scans = Scans(session)

    def add(self, scan: str, row: EditRow) -> int:
        """Append an edit and return its revision, which is now the scan's.

        The scan is locked until the transaction ends, so that two writers never get one number.
        """
        revision = self._scans.lock(scan).revision + 1
        numbered = replace(row, scan=scan, revision=revision)
        self._session.add(tables.Edit(**as_values(numbered)))
        self._scans.set_revision(scan, revision)
        return revision

    def of(self, scan: str) -> list[EditRow]:
        """Return the scan's edits, oldest first."""
        query = select(tables.Edit).where(tables.Edit.scan == scan).order_by(tables.Edit.revision)
        return [as_row(EditRow, record) for record in self._session.scalars(query)]
