"""Fixtures of the tests that run scans of the toy method."""

import contextlib
from collections.abc import Iterator

import pytest

from backend.jobs import shooting
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.database import Database
from tests.scans.toy_house import House, hurry, inline_house


@pytest.fixture
def sqlite_database(sqlite_url: str) -> Iterator[Database]:
    """Open a fresh SQLite database that doesn't wait for the disk: nobody pulls the plug here."""
    with contextlib.closing(Database(sqlite_url)) as opened:
        hurry(opened)
        yield opened


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a device that was lost a moment to come back, not as long as somebody takes to plug in a cable."""
    monkeypatch.setattr(shooting, "RECONNECT_S", 0.2)


@pytest.fixture
def house(sqlite_database: Database, store: LocalArtifactStore) -> Iterator[House]:
    """Run everything in this process."""
    with inline_house(sqlite_database, store) as house:
        yield house
