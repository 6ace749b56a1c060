"""The rigs in use: opened when first needed, used by one thread each, lent to one capture at a time."""

import itertools
import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from backend.contract.events import Event, RigChanged
from backend.devices.errors import DeviceError
from backend.devices.protocols import LinkState, Rig
from backend.domain.errors import RigBusyError, RigFailedError
from backend.domain.patterns import WHITE
from backend.domain.rig import RigCalibration, RigFacts
from backend.jobs.control import JobControl
from backend.jobs.rendering import render
from backend.jobs.shooting import Shooter

log = logging.getLogger(__name__)

T = TypeVar("T")

OpenRig = Callable[[str, Mapping[str, Any]], Rig]
"""Makes a rig of its name and options, see `backend.devices.loading.open_rig`."""


@dataclass(frozen=True)
class Owner:
    """Who captures with a rig."""

    scan: str
    scan_name: str
    who: str


@dataclass(frozen=True)
class RigGiven:
    """What a rig hands to every method."""

    facts: RigFacts
    calibration: RigCalibration | None


@dataclass(frozen=True)
class LivePicture:
    """The newest picture of a camera; never stored."""

    gray: np.ndarray[Any, np.dtype[Any]]
    bit_depth: int
    number: int = field(default_factory=itertools.count().__next__)
    """Tells two pictures apart."""


class Lease:
    """A rig while one capture owns it."""

    def __init__(self, slot: "_Slot") -> None:
        self._slot = slot

    def call(self, work: Callable[[Rig], T]) -> T:
        """Run something on the rig's own thread and wait for it."""
        return self._slot.submit(work).result()


class RigPool:
    """All rigs of this process.

    There is one rig per name: the same name with other options closes the old one first, as hardware can't be
    opened twice. A rig that failed is closed and opened anew by the next one who needs it.

    Parameters
    ----------
    open_rig
        Makes a rig of name and options.
    publish
        Is told when a rig is opened, closed, lent or returned.
    """

    def __init__(
        self, open_rig: OpenRig, publish: Callable[[Event], None] = lambda event: None
    ) -> None:
        self._open_rig = open_rig
        self._publish = publish
        self._lock = threading.Lock()
        self._slots: dict[str, _Slot] = {}
        self._given: dict[tuple[str, str], RigGiven] = {}

    def ask(self, name: str, options: Mapping[str, Any]) -> "Future[RigGiven]":
        """Ask a rig for facts and calibration; it is opened for that in the background, which may take seconds.

        Raises
        ------
        RigBusyError
            At once, if they aren't known and the rig captures with other options.
        NotFoundError, InvalidSettingError
            At once, if there is no such rig or an option can't be used.
        """
        key = (name, _canonical(options))
        if key in self._given:
            known: Future[RigGiven] = Future()
            known.set_result(self._given[key])
            return known
        slot = self._slot(name)
        slot.refuse_other(options)
        made = None if slot.holds(options) else self._open_rig(name, options)
        return slot.opened(options, lambda rig: self._given[key], made=made)

    def given(self, name: str, options: Mapping[str, Any]) -> RigGiven:
        """Wait for the facts and the calibration of a rig; raises what `ask` does, DeviceError if a device doesn't answer."""
        return self.ask(name, options).result()

    def use(self, name: str, options: Mapping[str, Any], work: Callable[[Rig], T]) -> T:
        """Ask a rig something that takes no pictures (its truth, its devices' names), on its own thread.

        Waits for what the rig is doing; `RigBusyError` at once if it captures with other options.
        """
        slot = self._slot(name)
        slot.refuse_other(options)
        return slot.opened(options, work).result()

    @contextmanager
    def lease(self, name: str, options: Mapping[str, Any], owner: Owner) -> Iterator[Lease]:
        """Own a rig for one capture.

        Raises
        ------
        RigBusyError
            At once, naming the scan and the person, if another capture owns the rig.
        """
        slot = self._slot(name)
        slot.take(owner)
        try:
            slot.opened(options, lambda rig: None, leased=True).result()
            yield Lease(slot)
        except (RigFailedError, DeviceError):
            slot.discard().result()
            raise
        finally:
            slot.give_back()

    def owner(self, name: str) -> Owner | None:
        """Return who captures with the rig now."""
        slot = self._slots.get(name)
        return slot.owner if slot else None

    def refuse_busy(self, name: str) -> None:
        """Raise `RigBusyError` if a capture owns the rig."""
        self._slot(name).refuse_busy()

    def show(self, name: str, camera: str, picture: LivePicture) -> None:
        """Make a picture the newest of its camera."""
        self._slot(name).live[camera] = picture

    def live(self, name: str, camera: str) -> LivePicture | None:
        """Return the newest picture of a camera; never waits.

        Where nobody captures, a new one is asked for: the next call finds it.
        """
        slot = self._slots.get(name)
        if slot is None:
            return None
        slot.ask_for_picture()
        return slot.live.get(camera)

    def close(self) -> None:
        """Give all rigs back."""
        with self._lock:
            slots, self._slots = list(self._slots.values()), {}
        for slot in slots:
            slot.close()

    def _slot(self, name: str) -> "_Slot":
        with self._lock:
            if name not in self._slots:
                self._slots[name] = _Slot(name, self._open_rig, self._publish, self._remember)
            return self._slots[name]

    def _remember(self, name: str, options: str, rig: Rig) -> None:
        self._given[name, options] = RigGiven(rig.facts(), rig.calibration())


class _Slot:
    """The place of one rig: its thread, its owner, its newest pictures."""

    def __init__(
        self,
        name: str,
        open_rig: OpenRig,
        publish: Callable[[Event], None],
        opened: Callable[[str, str, Rig], None],
    ) -> None:
        self.name = name
        self._tell_opened = opened
        self.live: dict[str, LivePicture] = {}
        self._open_rig = open_rig
        self._publish = publish
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"rig-{name}")
        self._lock = threading.Lock()
        self._owner: Owner | None = None
        self._rig: Rig | None = None
        self._options: str | None = None
        self._picture: Future[None] | None = None

    @property
    def owner(self) -> Owner | None:
        return self._owner

    def take(self, owner: Owner) -> None:
        with self._lock:
            self.refuse_busy()
            self._owner = owner
        self._publish(RigChanged(rig=self.name))

    def give_back(self) -> None:
        with self._lock:
            self._owner = None
        self._publish(RigChanged(rig=self.name))

    def refuse_busy(self) -> None:
        owner = self._owner
        if owner is not None:
            raise RigBusyError(
                f"Rig {self.name!r} is busy: {owner.who} captures scan {owner.scan_name!r}; "
                f"wait until that is done or cancel it.",
                details={"scan": owner.scan, "who": owner.who},
            )

    def submit(self, work: Callable[[Rig], T]) -> Future[T]:
        """Run something with the open rig, on its thread."""
        return self._thread.submit(lambda: work(self._opened_rig()))

    def holds(self, options: Mapping[str, Any]) -> bool:
        """Tell whether the open rig has these options."""
        return self._options == _canonical(options)

    def refuse_other(self, options: Mapping[str, Any]) -> None:
        if not self.holds(options):
            self.refuse_busy()

    def opened(
        self,
        options: Mapping[str, Any],
        work: Callable[[Rig], T],
        *,
        leased: bool = False,
        made: Rig | None = None,
    ) -> Future[T]:
        """Open the rig if it isn't, then run something with it, on its thread.

        Nobody but the owner may change the options while the rig is lent: that is looked at on the rig's
        thread, where nothing can come in between.
        """

        def open_and_work() -> T:
            if not leased:
                self.refuse_other(options)
            self._open(options, made)
            return work(self._opened_rig())

        return self._thread.submit(open_and_work)

    def discard(self) -> Future[None]:
        return self._thread.submit(self._close)

    def close(self) -> None:
        self.discard().result()
        self._thread.shutdown()

    def ask_for_picture(self) -> None:
        with self._lock:
            waiting = self._picture is not None and not self._picture.done()
            if self._rig is None or self._owner is not None or waiting:
                return
            self._picture = self._thread.submit(self._take_picture)

    # on the rig's thread

    def _opened_rig(self) -> Rig:
        if self._rig is None:
            raise RigFailedError(f"Rig {self.name!r} was closed in the meantime: run again.")
        return self._rig

    def _open(self, options: Mapping[str, Any], made: Rig | None) -> None:
        if self._rig is not None and self.holds(options) and _is_healthy(self._rig):
            return
        self._close()
        rig = made or self._open_rig(self.name, options)
        rig.open()
        try:
            self._tell_opened(self.name, _canonical(options), rig)
        except BaseException:
            rig.close()
            raise
        self._rig, self._options = rig, _canonical(options)
        self._publish(RigChanged(rig=self.name))

    def _close(self) -> None:
        if self._rig is None:
            return
        self._rig.close()
        self._rig, self._options = None, None
        self.live.clear()
        self._publish(RigChanged(rig=self.name))

    def _take_picture(self) -> None:
        rig = self._rig
        if rig is None or self._owner is not None:
            return
        try:
            with Shooter(rig, JobControl()) as shooter:
                width_px, height_px = shooter.projector_size
                shooter.load([render(WHITE, width_px=width_px, height_px=height_px)])
                exposure_us = next(iter(rig.cameras.values())).settings.exposure_us
                frames = shooter.take(
                    0, exposure_ms=exposure_us / 1000.0, gain_db=0.0, cameras=list(rig.cameras)
                )
        except DeviceError as error:
            log.warning("No live picture of rig %r: %s", self.name, error)
            return
        for name, frame in frames.items():
            self.live[name] = LivePicture(frame.data, frame.bits)


def _is_healthy(rig: Rig) -> bool:
    devices = [*rig.cameras.values(), rig.projector]
    return all(device.state in (LinkState.READY, LinkState.ARMED) for device in devices)


def _canonical(options: Mapping[str, Any]) -> str:
    return json.dumps(options, sort_keys=True, default=str)
