"""What every use case works with: made once by the composition root, never changed."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime

from backend.contract.rigs import RigOffer
from backend.contract.scans import ScanSummary
from backend.devices.rig_shelf import RigShelf
from backend.jobs.rigs import RigPool
from backend.jobs.runner import Runner
from backend.methods import Registry
from backend.services.events import EventHub
from backend.services.fields import ShownResult
from backend.services.memory import Memory
from backend.services.rig_offers import offer_rigs
from backend.storage.artifacts import ArtifactStore
from backend.storage.database import Database, utc_now


@dataclass(frozen=True)
class Context:
    """Database, store, runner, rigs, methods, events."""

    database: Database
    store: ArtifactStore
    runner: Runner
    rigs: RigPool
    registry: Registry
    events: EventHub
    version: str
    clock: Callable[[], datetime] = utc_now
    rig_patience_s: float = 0.05
    """How long a new scan waits for its rig's facts; later they come by themselves."""
    offers: Callable[[], tuple[RigOffer, ...]] = offer_rigs
    shelf: RigShelf | None = None
    """The station's rig files; None: there are none."""
    previews: Memory[bytes] = field(default_factory=lambda: Memory(64 << 20, len))
    """Pictures for the screen, up to so many bytes."""
    shown: Memory[ShownResult] = field(default_factory=lambda: Memory(500))
    """Results as clients see them."""
    summaries: Memory[ScanSummary] = field(default_factory=lambda: Memory(10_000))
    """Lines of the scan list."""
