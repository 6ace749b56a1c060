"""The whole backend without HTTP, around the toy method and the toy rig."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import event

from backend.contract.events import Event
from backend.contract.requests import (
    CreateScan,
    Decide,
    EditSettings,
    RedoStage,
    StartRun,
    UndoEdit,
)
from backend.contract.rigs import RigOffer
from backend.contract.scans import ScanState, StageState
from backend.domain.states import Verdict
from backend.jobs.execution import Workshop
from backend.jobs.rigs import RigPool
from backend.jobs.runner import InlineRunner, LocalRunner, Runner
from backend.services.events import EventHub
from backend.services.rig_offers import offer_rigs
from backend.services.services import Services
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.database import Database
from tests.scans.toy import ToyRigs, toy_registry


def toy_offers() -> tuple[RigOffer, ...]:
    """Offer the toys beside the built-in rigs; `ToyRigs` opens whatever it is asked for."""
    toys = ("toy", "other", "sulky", "late")
    return (*offer_rigs(), *(RigOffer(name=n, title=n, doc="", options_schema={}) for n in toys))


class House:
    """Services around the toys, with short words for what tests do all the time."""

    def __init__(
        self,
        database: Database,
        store: LocalArtifactStore,
        make_runner: Callable[[Workshop], Runner],
    ) -> None:
        self.rigs = ToyRigs()
        self.events: list[Event] = []
        self.watchers: list[Callable[[Event], None]] = []
        hub = EventHub()

        def publish(event: Event) -> None:
            self.events.append(event)
            for look in self.watchers:
                look(event)
            hub.publish(event)

        pool = RigPool(self.rigs, publish)
        self.shop = Workshop(database, store, pool, toy_registry, publish, {"unglare": "test"})
        self.services = Services(
            database=database,
            store=store,
            runner=make_runner(self.shop),
            rigs=pool,
            registry=toy_registry(),
            events=hub,
            version="test",
            rig_patience_s=10.0,
            offers=toy_offers,
        )

    def create(self, *, who: str = "ada", **options: Any) -> ScanState:
        request = CreateScan(**{"method": "toy", "rig": "toy", "name": "part", **options})
        return self.services.create_scan(request, who)

    def run(self, scan: str, *, who: str = "ada", **options: Any) -> ScanState:
        """Run and wait."""
        self.services.run(scan, StartRun(**options), who)
        return self.services.wait(scan, 30.0)

    def run_through(self, scan: str) -> ScanState:
        """Run to the end, accepting what waits for a decision."""
        state = self.run(scan)
        while (gate := waiting(state)) is not None:
            self.accept(gate)
            state = self.services.wait(scan, 30.0)
        return state

    def accept(self, stage: StageState, *, who: str = "ada", **options: Any) -> ScanState:
        assert stage.stage_run
        request = Decide(**{"verdict": Verdict.ACCEPT, **options})
        return self.services.decide(stage.stage_run, request, who)

    def edit(
        self,
        state: ScanState,
        stage: str,
        *,
        who: str = "ada",
        reset: tuple[str, ...] = (),
        **changes: Any,
    ) -> ScanState:
        request = EditSettings(changes=changes, reset=reset, revision=state.revision)
        return self.services.edit(state.id, stage, request, who)

    def undo(self, state: ScanState, *, who: str = "ada") -> ScanState:
        return self.services.undo(state.id, UndoEdit(revision=state.revision), who)

    def redo(self, state: ScanState, stage: str | None, *, who: str = "ada") -> ScanState:
        request = RedoStage(all=stage is None, revision=state.revision)
        return self.services.redo(state.id, stage, request, who)


def waiting(state: ScanState) -> StageState | None:
    """Return the first stage that waits for a decision."""
    return next((s for s in state.stages if s.status == "awaiting_review"), None)


def stage(state: ScanState, name: str) -> StageState:
    return next(s for s in state.stages if s.name == name)


def statuses(state: ScanState) -> dict[str, str]:
    return {s.name.removeprefix("toy_"): s.status.value for s in state.stages}


def hashes(state: ScanState) -> dict[str, str | None]:
    return {s.name.removeprefix("toy_"): s.result_hash for s in state.stages}


@contextlib.contextmanager
def inline_house(database: Database, store: LocalArtifactStore) -> Iterator[House]:
    house = House(database, store, InlineRunner)
    yield house
    house.services.close()


@contextlib.contextmanager
def local_house(database: Database, store: LocalArtifactStore) -> Iterator[House]:
    house = House(database, store, LocalRunner)
    yield house
    house.services.close()


def hurry(database: Database) -> None:
    """Don't wait for the disk."""
    event.listen(database.engine, "connect", lambda c, _: c.execute("PRAGMA synchronous = OFF"))


class Gate:
    """Holds the rig before its n-th shot until the test lets it go on."""

    def __init__(self, rigs: ToyRigs, shot: int) -> None:
        self.reached = threading.Event()
        self.open = threading.Event()
        self._shot = shot
        rigs.faults.before_shot = self._before

    def _before(self, shot: int) -> None:
        if shot == self._shot:
            self.reached.set()
            assert self.open.wait(20)


def data_folder(path: Path) -> tuple[Database, LocalArtifactStore]:
    """Open (or make) database and store in a folder, without waiting for the disk: processes die, not the power."""
    database = Database(f"sqlite:///{path / 'unglare.db'}")
    hurry(database)
    database.upgrade()
    return database, LocalArtifactStore(path / "artifacts", durable=False)
