"""Migrations: both ways, on both databases, and no drift from the tables in the code."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect, text

from backend.domain.errors import StartupError
from backend.storage import migrate
from backend.storage.database import Database
from backend.storage.tables import APPEND_ONLY, Base


@pytest.fixture
def empty(empty_database_url: str) -> Iterator[Database]:
    with contextlib.closing(Database(empty_database_url)) as opened:
        yield opened


def table_names(database: Database) -> set[str]:
    return set(inspect(database.engine).get_table_names()) - {"alembic_version"}


def test_the_first_start_makes_the_tables_and_the_second_changes_nothing(empty: Database) -> None:
    assert table_names(empty) == set()
    empty.upgrade()
    assert table_names(empty) == set(Base.metadata.tables)
    empty.upgrade()
    assert table_names(empty) == set(Base.metadata.tables)


def test_the_migrated_tables_are_those_of_the_code(empty: Database) -> None:
    empty.upgrade()
    with empty.engine.begin() as connection:
        options = {"compare_type": True, "compare_server_default": True}
        context = MigrationContext.configure(connection, opts=options)
        assert compare_metadata(context, Base.metadata) == []


def test_the_migrated_checks_are_those_of_the_code(empty: Database) -> None:
    empty.upgrade()
    with empty.engine.begin() as connection:
        migrated = checks(connection)
        Base.metadata.drop_all(connection)
        Base.metadata.create_all(connection)
        assert migrated == checks(connection)
    assert len(migrated) >= 10


def checks(connection: Connection) -> set[tuple[str, str, str]]:
    """Return table, name and condition of every check: Alembic's comparison passes over them."""
    inspector = inspect(connection)
    return {
        (table, str(check["name"]), check["sqltext"])
        for table in Base.metadata.tables
        for check in inspector.get_check_constraints(table)
    }


def test_every_constraint_has_a_name(empty: Database) -> None:
    empty.upgrade()
    inspector = inspect(empty.engine)
    for table in Base.metadata.tables:
        key = inspector.get_pk_constraint(table)
        if empty.engine.dialect.name == "sqlite" and key["constrained_columns"] == ["sequence"]:
            key["name"] = "SQLite has no name for a number that it counts up itself"
        found = [
            key,
            *inspector.get_foreign_keys(table),
            *inspector.get_unique_constraints(table),
            *inspector.get_check_constraints(table),
            *inspector.get_indexes(table),
        ]
        assert [c for c in found if not c["name"]] == []


def test_each_step_can_be_taken_back_and_taken_again(empty: Database) -> None:
    for revision in revisions(empty):
        with empty.engine.begin() as connection:
            migrate.upgrade(connection, revision)
        before = description(empty)
        with empty.engine.begin() as connection:
            migrate.downgrade(connection, "-1")
        with empty.engine.begin() as connection:
            migrate.upgrade(connection, revision)
        assert description(empty) == before


def test_taking_all_steps_back_leaves_nothing(empty: Database) -> None:
    empty.upgrade()
    with empty.engine.begin() as connection:
        migrate.downgrade(connection, "base")
    assert table_names(empty) == set()
    assert triggers(empty) == set()
    if empty.engine.dialect.name == "postgresql":
        with empty.engine.connect() as connection:
            left = "SELECT proname FROM pg_proc WHERE pronamespace = 'public'::regnamespace"
            assert connection.scalars(text(left)).all() == []


def revisions(database: Database) -> list[str]:
    """Return all migrations, oldest first."""
    with database.engine.connect() as connection:
        scripts = ScriptDirectory.from_config(migrate.configuration(connection))
    return [script.revision for script in reversed(list(scripts.walk_revisions()))]


def description(database: Database) -> dict[str, object]:
    inspector = inspect(database.engine)
    columns = {
        t: sorted(c["name"] for c in inspector.get_columns(t)) for t in table_names(database)
    }
    return {"columns": columns, "triggers": triggers(database)}


def triggers(database: Database) -> set[str]:
    queries = {
        "sqlite": "SELECT name FROM sqlite_master WHERE type = 'trigger'",
        "postgresql": "SELECT tgname FROM pg_trigger WHERE NOT tgisinternal",
    }
    with database.engine.connect() as connection:
        return set(connection.scalars(text(queries[database.engine.dialect.name])))


def test_every_table_that_only_grows_has_its_triggers(database: Database) -> None:
    names = triggers(database)
    assert all(any(n.startswith(f"{table}_only_grows") for n in names) for table in APPEND_ONLY)


def test_a_migration_that_fails_leaves_the_database_as_it_was(
    empty: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A table of that name is there already: the first migration fails after it made others.
    with empty.engine.begin() as connection:
        connection.execute(text("CREATE TABLE runs (id INTEGER)"))
    with pytest.raises(StartupError, match=r"runs.* already exists"):
        empty.upgrade()
    assert table_names(empty) == {"runs"}


def test_a_database_of_a_newer_version_is_left_alone(database: Database) -> None:
    with database.engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(StartupError, match=r"newer version \(migration 9999.*install that version"):
        database.upgrade()


def test_the_migrations_are_part_of_the_package() -> None:
    folder = Path(migrate.__file__).parent / "migrations"
    assert (folder / "env.py").is_file()
    assert list((folder / "versions").glob("0001_*.py"))
