"""Fixtures that many tests need: fresh databases on SQLite and PostgreSQL, and an artifact store.

`database` and `database_url` run a test once on each; PostgreSQL is Debian's package, started on a free
loopback port with a folder of its own, one server per test process.
"""

import contextlib
import itertools
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from backend.storage.artifacts import LocalArtifactStore
from backend.storage.database import Database
from tests.loopback import loopback_address

_READY = "database system is ready to accept connections"
_NUMBERS = itertools.count()


@pytest.fixture
def store(tmp_path: Path) -> LocalArtifactStore:
    """Keep artifacts in the test's folder, without waiting for the disk."""
    return LocalArtifactStore(tmp_path / "artifacts", durable=False)


@pytest.fixture
def addresses() -> tuple[str, str]:
    """Two loopback addresses for devices: no other test has them, in this process or another."""
    return loopback_address(), loopback_address()


@pytest.fixture(params=["sqlite", "postgres"])
def database_url(request: pytest.FixtureRequest) -> str:
    """Address of a fresh database whose tables are up to date; once per kind of database."""
    url = request.getfixturevalue(f"{request.param}_url")
    assert isinstance(url, str)
    return url


@pytest.fixture(params=["sqlite", "postgres"])
def empty_database_url(request: pytest.FixtureRequest, fast_folder: Path) -> str:
    """Address of a fresh database without any tables; once per kind of database."""
    if request.param == "sqlite":
        return f"sqlite:///{fast_folder / 'empty.db'}"
    server = request.getfixturevalue("postgres_server")
    assert isinstance(server, PostgresServer)
    return server.new_database()


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    """Open a fresh database; once per kind of database."""
    with contextlib.closing(Database(database_url)) as opened:
        yield opened


@pytest.fixture
def sqlite_database(sqlite_url: str) -> Iterator[Database]:
    """Open a fresh SQLite database, for tests of what stands above the storage."""
    with contextlib.closing(Database(sqlite_url)) as opened:
        yield opened


@pytest.fixture
def sqlite_url(sqlite_template: Path, fast_folder: Path) -> str:
    """Address of a fresh SQLite file whose tables are up to date."""
    file = fast_folder / "unglare.db"
    shutil.copyfile(sqlite_template, file)
    return f"sqlite:///{file}"


@pytest.fixture
def fast_folder() -> Iterator[Path]:
    """Folder for what is written and thrown away: in memory where the machine can."""
    with tempfile.TemporaryDirectory(prefix="unglare-test-", dir=_memory()) as folder:
        yield Path(folder)


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the tables once; copying a file is 20 times faster than migrating."""
    file = tmp_path_factory.mktemp("template") / "unglare.db"
    _upgrade(f"sqlite:///{file}")
    return file


@pytest.fixture
def postgres_url(postgres_server: "PostgresServer", postgres_template: str) -> Iterator[str]:
    """Address of a fresh PostgreSQL database whose tables are up to date."""
    url = postgres_server.new_database(postgres_template)
    yield url
    postgres_server.drop_database(url)


@pytest.fixture(scope="session")
def postgres_template(postgres_server: "PostgresServer") -> str:
    """Make the tables once; the databases of the tests are copies."""
    url = postgres_server.new_database()
    _upgrade(url)
    return url.rpartition("/")[2]


@pytest.fixture(scope="session")
def postgres_server() -> Iterator["PostgresServer"]:
    """Start PostgreSQL for this test process."""
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not programs:
        pytest.skip("PostgreSQL isn't installed: apt-get install postgresql")
    with _data_folder() as folder, PostgresServer(programs[-1].parent, folder) as server:
        yield server


class PostgresServer:
    """A server that dies with this process, whatever happens to it."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self._programs = programs
        self._data = folder / "data"
        self._log: list[str] = []
        self.port = 0

    def __enter__(self) -> "PostgresServer":
        self._make_data_folder()
        for _ in range(5):  # somebody may take the port between looking and starting
            self.port = _free_port()
            if self._starts():
                return self
        raise AssertionError("PostgreSQL didn't start:\n" + "".join(self._log))

    def __exit__(self, *error: object) -> None:
        self._process.send_signal(signal.SIGQUIT)  # at once, whoever is connected
        self._process.wait(timeout=30)
        self._reader.join()

    def new_database(self, template: str = "template0") -> str:
        """Make a database and return its address."""
        name = f"test_{next(_NUMBERS)}"
        self._sql(f"CREATE DATABASE {name} TEMPLATE {template}")
        return f"postgresql://unglare@127.0.0.1:{self.port}/{name}"

    def drop_database(self, url: str) -> None:
        """Remove a database, whoever is still connected."""
        self._sql(f"DROP DATABASE {url.rpartition('/')[2]} WITH (FORCE)")

    def _sql(self, statement: str) -> None:
        import pg8000.native

        with contextlib.closing(
            pg8000.native.Connection("unglare", "127.0.0.1", "postgres", self.port)
        ) as connection:
            connection.run(statement)

    def _make_data_folder(self) -> None:
        options = ["-U", "unglare", "-A", "trust", "--no-sync", "--encoding=UTF8", "--locale=C"]
        program = [str(self._programs / "initdb"), "-D", str(self._data)]
        done = subprocess.run([*_as_owner(), *program, *options], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    def _starts(self) -> bool:
        settings = {
            "listen_addresses": "127.0.0.1",
            "unix_socket_directories": "",
            "shared_buffers": "16MB",
            # The data are thrown away: nothing has to reach the disk.
            "fsync": "off",
            "synchronous_commit": "off",
            "full_page_writes": "off",
        }
        options = [part for name, value in settings.items() for part in ("-c", f"{name}={value}")]
        program = [str(self._programs / "postgres"), "-D", str(self._data), "-p", str(self.port)]
        self._process = subprocess.Popen(
            [*_as_owner(), "setpriv", "--pdeathsig", "INT", *program, *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        ready = threading.Event()
        self._reader = threading.Thread(target=self._read_log, args=(ready,))
        self._reader.start()
        ready.wait(60)
        return self._process.poll() is None

    def _read_log(self, ready: threading.Event) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as log:
            for line in log:
                self._log.append(line)
                if _READY in line:
                    ready.set()
        self._process.wait()
        ready.set()  # it ended: nobody has to wait any longer


@contextlib.contextmanager
def _data_folder() -> Iterator[Path]:
    # Not below pytest's folder: PostgreSQL's user may not enter it.
    folder = Path(tempfile.mkdtemp(prefix="unglare-postgres-", dir=_memory()))
    try:
        if os.geteuid() == 0:
            owner = pwd.getpwnam(_owner())
            os.chown(folder, owner.pw_uid, owner.pw_gid)
        yield folder
    finally:
        shutil.rmtree(folder)


def _memory() -> Path | None:
    """Folder in memory, if there is one with room: a database is copied there 8 times faster."""
    memory = Path("/dev/shm")
    return memory if memory.is_dir() and shutil.disk_usage(memory).free > 1 << 29 else None


def _owner() -> str:
    names = {user.pw_name for user in pwd.getpwall()}
    return "postgres" if "postgres" in names else "nobody"


def _as_owner() -> list[str]:
    """PostgreSQL refuses to run as root."""
    if os.geteuid() != 0:
        return []
    owner = pwd.getpwnam(_owner())
    return ["setpriv", f"--reuid={owner.pw_uid}", f"--regid={owner.pw_gid}", "--clear-groups"]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _upgrade(url: str) -> None:
    with contextlib.closing(Database(url)) as opened:
        opened.upgrade()
