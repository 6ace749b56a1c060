"""Transactions, start and faults of the database."""

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy import event, text
from sqlalchemy.exc import DBAPIError

from backend.domain.errors import (
    ConflictError,
    CorruptDataError,
    StartupError,
    StorageFullError,
    UnglareError,
)
from backend.storage import database as database_module
from backend.storage.database import Database
from backend.storage.rows import ScanRow

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def a_scan(id: str, note: str = "") -> ScanRow:
    return ScanRow(id, "", note, "hdr-fringe", "simulated", {}, None, {}, NOON, "ada")


def add(database: Database, id: str, note: str = "") -> None:
    with database.transaction() as r:
        r.scans.add(a_scan(id, note))


def names(database: Database) -> set[str]:
    with database.reading() as r:
        return {scan.id for scan in r.scans.list()}


# --- transactions ---------------------------------------------------------------------------------


def test_a_transaction_that_raises_leaves_nothing(database: Database) -> None:
    def add_and_fail() -> None:
        with database.transaction() as r:
            r.scans.add(a_scan("a"))
            raise RuntimeError("a defect")

    with pytest.raises(RuntimeError, match="a defect"):
        add_and_fail()
    assert names(database) == set()


def test_reading_never_writes_and_writing_works_afterwards(database: Database) -> None:
    with pytest.raises(DBAPIError, match=r"(?i)read-?only"), database.reading() as r:
        r.scans.add(a_scan("a"))
    for _ in range(10):  # whichever connection of the pool it gets
        with database.reading() as r:
            r.scans.count()
    add(database, "b")
    assert names(database) == {"b"}


def test_reading_sees_one_state_while_others_write(database: Database) -> None:
    add(database, "a")
    with database.reading() as r:
        assert r.scans.count() == 1
        add(database, "b")
        assert r.scans.count() == 1
    assert names(database) == {"a", "b"}


def test_writers_in_many_threads_lose_nothing(database: Database) -> None:
    def write(first: int) -> None:
        for n in range(first, first + 10):
            add(database, f"{n:02d}")

    threads = [threading.Thread(target=write, args=(10 * n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(names(database)) == 40


def test_the_settings_of_sqlite(sqlite_database: Database) -> None:
    with sqlite_database.engine.connect() as connection:
        values = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "recursive_triggers")
        }
    full = 2
    assert values == {
        "journal_mode": "wal",
        "synchronous": full,
        "foreign_keys": 1,
        "recursive_triggers": 1,
    }


# --- start ------------------------------------------------------------------------------------------


def test_folders_are_made(tmp_path: Path) -> None:
    file = tmp_path / "data" / "station 1" / "unglare.db"
    with contextlib.closing(Database(f"sqlite:///{file}")) as opened:
        opened.upgrade()
    assert file.is_file()


def test_threads_that_start_at_once_upgrade_once(empty_database_url: str) -> None:
    errors: list[Exception] = []

    def start() -> None:
        try:
            with contextlib.closing(Database(empty_database_url)) as opened:
                opened.upgrade()
        except Exception as error:  # noqa: BLE001 (looked at below)
            errors.append(error)

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def no_address(_: Path) -> str:
    return "unglare.db"


def no_file(_: Path) -> str:
    return "sqlite://"


def no_driver(_: Path) -> str:
    return "nodb://host/name"


def no_server(_: Path) -> str:
    return "postgresql://unglare:secret@127.0.0.1:1/unglare"


def below_a_file(folder: Path) -> str:
    (folder / "a file").touch()
    return f"sqlite:///{folder}/a file/unglare.db"


def a_folder(folder: Path) -> str:
    return f"sqlite:///{folder}"


def another_file(folder: Path) -> str:
    (folder / "picture.png").write_bytes(b"not a database" * 1000)
    return f"sqlite:///{folder}/picture.png"


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        (no_address, "'unglare.db' can't be understood; write sqlite:////"),
        (no_file, "names no file.*; write sqlite:////"),
        (no_driver, "driver of .*nodb.* isn't installed"),
        (no_server, r"postgresql\+pg8000://unglare:\*\*\*@127.0.0.1:1/unglare can't be opened"),
        (below_a_file, "folder .*a file can't be made .*; choose another"),
        (a_folder, "can't be opened .*unable to open database file"),
        (another_file, "picture.png can't be opened .*not a database"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_database_that_cannot_be_opened_is_one_sentence(
    tmp_path: Path, address: Callable[[Path], str], sentence: str
) -> None:
    with pytest.raises(StartupError, match=sentence) as caught:
        start(address(tmp_path))
    assert "\n" not in caught.value.sentence
    assert "secret" not in caught.value.sentence


def start(url: str) -> None:
    with contextlib.closing(Database(url)) as opened:
        opened.upgrade()


# --- faults -----------------------------------------------------------------------------------------


def test_a_full_disk_keeps_what_was_there(sqlite_database: Database) -> None:
    add(sqlite_database, "a")

    @event.listens_for(sqlite_database.engine, "begin")
    def no_more_pages(connection: object) -> None:
        connection.exec_driver_sql("PRAGMA max_page_count = 1")  # type: ignore[attr-defined]  # is a Connection

    with pytest.raises(StorageFullError, match="no room on the disk"):
        add(sqlite_database, "b", note="x" * 1_000_000)
    event.remove(sqlite_database.engine, "begin", no_more_pages)
    assert names(sqlite_database) == {"a"}


SERVER_FAULTS = {"53100": StorageFullError, "XX001": CorruptDataError, "40P01": ConflictError}


@pytest.mark.parametrize("code", SERVER_FAULTS)
def test_faults_of_a_server_are_told_by_their_code(postgres_url: str, code: str) -> None:
    fault = f"DO $$ BEGIN RAISE EXCEPTION 'Platte voll' USING ERRCODE = '{code}'; END $$"
    with contextlib.closing(Database(postgres_url)) as opened:

        @event.listens_for(opened.engine, "begin")
        def fail(connection: object) -> None:
            connection.exec_driver_sql(fault)  # type: ignore[attr-defined]  # is a Connection

        with pytest.raises(SERVER_FAULTS[code]):
            add(opened, "a")


def test_a_damaged_file_is_named(sqlite_url: str) -> None:
    file = Path(sqlite_url.removeprefix("sqlite:///"))
    content = bytearray(file.read_bytes())
    content[4096 : 4096 * 20] = b"\xff" * 4096 * 19
    file.write_bytes(content)
    with (
        contextlib.closing(Database(sqlite_url)) as opened,
        pytest.raises(CorruptDataError, match="restore it from a backup"),
    ):
        add(opened, "a")


def test_a_writer_that_never_ends_is_a_conflict(
    sqlite_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database_module, "_BUSY_TIMEOUT_MS", 20)
    file = sqlite_url.removeprefix("sqlite:///")
    with (
        contextlib.closing(Database(sqlite_url)) as opened,
        contextlib.closing(sqlite3.connect(file, isolation_level=None)) as other,
    ):
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(ConflictError, match="busy"):
            add(opened, "a")
        other.execute("ROLLBACK")
        add(opened, "b")
        assert names(opened) == {"b"}


WRITER = """
import sys
from datetime import UTC, datetime
from backend.storage.database import Database
from backend.storage.rows import ScanRow

database = Database(sys.argv[1])
noon = datetime(2026, 3, 1, 12, tzinfo=UTC)
for n in range(100_000):
    with database.transaction() as r:
        name = f"{sys.argv[2]}-{n}"
        r.scans.add(ScanRow(name, "", "", "hdr-fringe", "simulated", {}, None, {}, noon, "ada"))
        r.audit.add(name, "ada", "created", None, "Made the scan.")
    print(name, flush=True)
"""


def test_a_writer_killed_at_any_moment_leaves_whole_transactions(sqlite_url: str) -> None:
    told: set[str] = set()
    for round_, lines in enumerate([1, 3, 8]):
        told |= write_and_be_killed(sqlite_url, str(round_), lines)
    with contextlib.closing(Database(sqlite_url)) as opened:
        opened.upgrade()
        with opened.reading() as r:
            scans = r.scans.list(limit=100_000)
            assert {scan.id for scan in scans} >= told
            assert all(len(r.audit.of(scan.id)) == 1 for scan in scans)
        with opened.engine.connect() as connection:
            assert connection.scalar(text("PRAGMA integrity_check")) == "ok"


def write_and_be_killed(url: str, name: str, lines: int) -> set[str]:
    """Kill a writer right after it told of some commits, i.e. in the middle of the next one."""
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, url, name], stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        told = {child.stdout.readline().strip() for _ in range(lines)}
        os.kill(child.pid, signal.SIGKILL)
    assert "" not in told
    return told


def test_expected_errors_pass_as_they_are(database: Database) -> None:
    def refuse() -> None:
        with database.transaction():
            raise UnglareError("no light")

    with pytest.raises(UnglareError, match="no light"):
        refuse()
