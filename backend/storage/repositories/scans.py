"""Scans, and the results that are handed over with them."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from backend.domain.errors import NotFoundError
from backend.storage import tables
from backend.storage.repositories.conversion import as_row, as_values
from backend.storage.rows import GivenRow, ScanRow


class Scans:
    """The scans, newest first."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def add(self, row: ScanRow) -> None:
        """Store a new scan."""
        self._session.add(tables.Scan(**as_values(row)))
        self._session.flush()

    def get(self, scan: str) -> ScanRow:
        """Return a scan; NotFoundError if there is none of that id."""
        return as_row(ScanRow, self._record(scan))

    def list(self, limit: int = 100, offset: int = 0, text: str = "") -> tuple[ScanRow, ...]:
        """Return scans whose name, note, method, rig, operator or id contains the text, newest first."""
        query = (
            select(tables.Scan)
            .where(_contains(text))
            .order_by(tables.Scan.created.desc(), tables.Scan.id.desc())
            .limit(limit)
            .offset(offset)
        )
        return tuple(as_row(ScanRow, record) for record in self._session.scalars(query))

    def count(self, text: str = "") -> int:
        """Return how many scans `list` would find without a limit."""
        query = select(func.count()).select_from(tables.Scan).where(_contains(text))
        return self._session.scalar(query) or 0

    def lock(self, scan: str) -> ScanRow:
        """Keep other writers of this scan out until the transaction ends, and return the scan as it is now.

        On SQLite a writing transaction keeps all other writers out anyway.
        """
        return as_row(ScanRow, self._record(scan, lock=True))

    def set_revision(self, scan: str, revision: int) -> None:
        """Note the number of the scan's last edit; `Edits.add` does so itself."""
        self._record(scan).revision = revision
        self._session.flush()

    def _record(self, scan: str, *, lock: bool = False) -> tables.Scan:
        found = self._session.get(
            tables.Scan, scan, with_for_update=lock or None, populate_existing=lock
        )
        if found is None:
            raise NotFoundError(f"there is no scan {scan!r}; the list of scans shows their ids")
        return found


def _contains(text: str) -> ColumnElement[bool]:
    columns = [tables.Scan.name, tables.Scan.note, tables.Scan.method]
    columns += [tables.Scan.rig, tables.Scan.who, tables.Scan.id]
    return or_(*(column.icontains(text, autoescape=True) for column in columns))


class GivenResults:
    """Results that no stage of the scan makes: imported frames, facts, a calibration."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def add(
        self,
        scan: str,
        name: str,
        type_name: str,
        document: Mapping[str, Any],
        hash: str,
        origin: Mapping[str, Any] | None = None,
    ) -> None:
        """Hand over one encoded result, under a stage's or a type's name."""
        self._session.add(
            tables.Given(
                scan=scan,
                name=name,
                type_name=type_name,
                document=dict(document),
                hash=hash,
                origin=dict(origin) if origin else None,
            )
        )
        self._session.flush()

    def remove(self, scan: str, name: str) -> GivenRow | None:
        """Take a given result away and return it; None if there is none. Audited by whoever asks for it."""
        record = self._session.get(tables.Given, (scan, name))
        if record is None:
            return None
        row = as_row(GivenRow, record)
        self._session.delete(record)
        self._session.flush()
        return row

    def of(self, scan: str) -> dict[str, GivenRow]:
        """Return the scan's given results by name."""
        query = select(tables.Given).where(tables.Given.scan == scan).order_by(tables.Given.name)
        return {r.name: as_row(GivenRow, r) for r in self._session.scalars(query)}
