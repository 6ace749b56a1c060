"""The real services with the bench's rigs, and the simulated ones, in front of the real API and station.

`python -m tests.ui.bench_served` serves them to be looked at by hand.
"""

import contextlib
import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backend.contract.rigs import RigOffer
from backend.devices.loading import open_rig
from backend.devices.pages import PageDesk
from backend.devices.protocols import Rig
from backend.devices.rig_shelf import RigShelf
from backend.jobs.execution import Workshop
from backend.jobs.rigs import RigPool
from backend.jobs.runner import InlineRunner
from backend.methods import registry
from backend.services.events import EventHub
from backend.services.latency import Latency
from backend.services.rig_offers import offer_rigs
from backend.services.services import Services
from tests.scans.toy_house import data_folder
from tests.ui.bench_rig import BenchRigs
from tests.ui.served import Served, serve

OFFERS = (
    RigOffer(name="bench", title="Bench 1", doc="", options_schema={"properties": {}}),
    RigOffer(name="spare", title="Spare bench", doc="", options_schema={"properties": {}}),
    RigOffer(name="broken", title="Broken bench", doc="", options_schema={}, error="No module named 'vendor_sdk'."),
)  # fmt: skip


@dataclass(frozen=True)
class Bench:
    """What a test may look into."""

    served: Served
    services: Services
    rigs: BenchRigs
    shelf: RigShelf


@contextlib.contextmanager
def bench_services(folder: Path) -> Iterator[tuple[Services, BenchRigs, RigShelf]]:
    """Make services whose rig `bench` is described by a file; `spare` isn't."""
    shelf = RigShelf(folder / "rigs", PageDesk())
    shelf.folder.mkdir()
    (shelf.folder / "bench.yaml").write_text("{}")

    def settles(name: str) -> float | None:
        kept = Latency.kept(shelf.folder, name)
        return kept.settle_ms if kept else None

    rigs, events = BenchRigs(settles), EventHub()

    def opened(name: str, options: Mapping[str, Any]) -> Rig:
        own = {offer.name for offer in OFFERS}
        return rigs(name, options) if name in own else open_rig(name, options)

    database, store = data_folder(folder)
    pool = RigPool(opened, events.publish)
    shop = Workshop(database, store, pool, registry, events.publish, {"unglare": "test"})
    services = Services(
        database=database, store=store, runner=InlineRunner(shop), rigs=pool, registry=registry(), events=events,
        version="test", offers=lambda: (*OFFERS, *offer_rigs()), shelf=shelf,
    )  # fmt: skip
    try:
        yield services, rigs, shelf
    finally:
        services.close()


@contextlib.contextmanager
def serve_bench(*, port: int = 0) -> Iterator[Bench]:
    """Serve until the block ends."""
    with (
        tempfile.TemporaryDirectory() as folder,
        bench_services(Path(folder)) as (services, rigs, shelf),
        serve(services, port=port) as served,
    ):
        yield Bench(served, services, rigs, shelf)


if __name__ == "__main__":
    with serve_bench(port=int(os.environ.get("PORT", "8098"))) as bench:
        print(bench.served.address(), flush=True)
        threading.Event().wait()
