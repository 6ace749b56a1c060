"""The rigs in use: opened when first needed, used by one thread each, lent to one capture at a time."""

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from backend.contract.events import Event, RigChanged
from backend.contract.rigs import RigLink
from backend.devices.errors import DeviceError, IncompleteFrame
from backend.devices.protocols import (
    CameraCapabilities,
    Device,
    DeviceInfo,
    LinkState,
    ProjectorCapabilities,
    Rig,
)
from backend.domain.errors import RigBusyError, RigFailedError, UnglareError
from backend.domain.rig import RigCalibration, RigFacts
from backend.jobs.control import JobControl
from backend.jobs.device_threads import DeviceThreads
from backend.jobs.live import LiveBench, LivePicture, LiveWish
from backend.jobs.rig_thread import CLOSING, OPENING, RigThread, wait_for

log = logging.getLogger(__name__)

T = TypeVar("T")

_MOST_WAITING = 4
"""So many may wait for the answer of one rig at the same time."""
_CLOSING_S = 15.0
"""How long the application waits for its rigs when it ends."""

_FEW_INCOMPLETE = 3
"""So many live pictures in a row may arrive with parts missing before somebody is told."""
LIVE_HOLD_S = 3.0
"""So long pictures stay live after somebody has asked for them."""

OpenRig = Callable[[str, Mapping[str, Any]], Rig]
"""Makes a rig of its name and options, see `backend.devices.loading.open_rig`."""


@dataclass(frozen=True)
class Owner:
    """Who captures with a rig."""

    scan: str
    """Id of the scan; empty: other work, which `scan_name` names."""
    scan_name: str
    who: str

    @property
    def doing(self) -> str:
        """What he does, as half a sentence."""
        return f"captures scan {self.scan_name!r}" if self.scan else f"runs the {self.scan_name}"


@dataclass(frozen=True)
class RigGiven:
    """What a rig hands to every method."""

    facts: RigFacts
    calibration: RigCalibration | None


@dataclass(frozen=True)
class KnownDevice:
    """A device of an open rig, as it was when it was asked last: looking at it never waits for the device."""

    device: Device
    info: DeviceInfo
    capabilities: CameraCapabilities | ProjectorCapabilities

    @property
    def link(self) -> LinkState:
        """Where it is in its life now."""
        return self.device.state


@dataclass(frozen=True)
class RigStatus:
    """How a rig is doing just now."""

    link: RigLink
    options: Mapping[str, Any] | None
    """Those that it is open with, or was last; None: never opened."""
    owner: Owner | None
    failure: str | None
    """Why it couldn't be opened, or why no live picture came; None: all is well."""
    devices: tuple[KnownDevice, ...]
    is_live: bool
    """Somebody looks at live pictures."""
    wish: LiveWish | None
    """How they are taken."""
    facts: RigFacts | None = None
    """Of the open rig."""


class Lease:
    """A rig while one capture owns it."""

    def __init__(self, slot: "_Slot") -> None:
        self._slot = slot

    @property
    def threads(self) -> DeviceThreads:
        """The threads of the opened rig's devices."""
        return self._slot.threads

    def call(self, work: Callable[[Rig], T]) -> T:
        """Run something on the rig's own thread and wait for it."""
        return self._slot.submit(work).result()


class RigPool:
    """All rigs of this process.

    There is one rig per name: the same name with other options closes the old one first, as hardware can't be
    opened twice. A rig that failed is closed and opened anew by the next one who needs it; one whose driver never
    returns is left behind for that.

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
        asked = self.ask(name, options)
        return self._slot(name).answer(asked)

    def use(self, name: str, options: Mapping[str, Any], work: Callable[[Rig], T]) -> T:
        """Ask a rig something that takes no pictures (its truth, its devices' names), on its own thread.

        Waits for what the rig is doing; `RigBusyError` at once if it captures with other options.
        """
        slot = self._slot(name)
        slot.refuse_other(options)
        return slot.answer(slot.opened(options, work))

    @contextmanager
    def lease(
        self,
        name: str,
        options: Mapping[str, Any],
        owner: Owner,
        control: JobControl | None = None,
    ) -> Iterator[Lease]:
        """Own a rig for one capture; the job behind `control` may be cancelled while the rig is opened.

        Raises
        ------
        RigBusyError
            At once, naming the scan and the person, if another capture owns the rig.
        """
        slot = self._slot(name)
        slot.take(owner)
        try:
            wait_for(slot.opened(options, lambda rig: None, leased=True), control)
            yield Lease(slot)
        except (RigFailedError, DeviceError):
            slot.discard().result()
            raise
        finally:
            slot.leave_stuck()
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
        """Return the newest picture of a camera; never waits, and asks for nothing."""
        slot = self._slots.get(name)
        return slot.live.get(camera) if slot else None

    # a rig without a scan: everything here returns at once

    def status(self, name: str) -> RigStatus:
        """Tell how a rig is doing; one that was never opened is closed."""
        slot = self._slots.get(name)
        if slot is None:
            return RigStatus(RigLink.CLOSED, None, None, None, (), is_live=False, wish=None)
        return slot.status()

    def connect(self, name: str, options: Mapping[str, Any]) -> None:
        """Have a rig opened, in the background; an open one stays as it is, whatever its options.

        `status` tells when it is open, or why it couldn't be opened.
        """
        self._slot(name).connect(options)

    def disconnect(self, name: str) -> None:
        """Have the devices of a rig closed, so that another program can use them.

        Raises
        ------
        RigBusyError
            If a capture owns the rig.
        """
        with self._lock:
            slot = self._slots.get(name)
        if slot is not None:
            slot.disconnect()

    def reconnect(self, name: str, options: Mapping[str, Any] | None = None) -> None:
        """Have a rig closed and opened again; None: with the options that it had.

        Raises
        ------
        RigBusyError
            If a capture owns the rig.
        """
        slot = self._slot(name)
        slot.refuse_busy()
        known = slot.status().options
        slot.disconnect()
        slot.connect(options if options is not None else known or {}, anew=True)

    def wish(self, name: str, wish: LiveWish) -> None:
        """Say how the next live pictures are taken."""
        self._slot(name).wish = wish

    def watch(self, name: str) -> None:
        """Ask for live pictures for the next `LIVE_HOLD_S`: taken while the rig is open and nobody captures."""
        slot = self._slots.get(name)
        if slot is not None:
            slot.watch()

    def rest(self, name: str) -> None:
        """End live pictures at once: cameras disarmed, projector dark."""
        slot = self._slots.get(name)
        if slot is not None:
            slot.rest()

    def close(self) -> None:
        """Give all rigs back."""
        with self._lock:
            slots, self._slots = list(self._slots.values()), {}
        wait([slot.discard() for slot in slots], timeout=_CLOSING_S)

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
        self.wish: LiveWish | None = None
        self._open_rig = open_rig
        self._publish = publish
        self._thread = RigThread(name, self._forget)
        self._threads: DeviceThreads | None = None
        self._lock = threading.Lock()
        self._places = threading.Semaphore(_MOST_WAITING)
        self._owner: Owner | None = None
        self._rig: Rig | None = None
        self._options: str | None = None
        self._asked_options: Mapping[str, Any] | None = None
        self._devices: tuple[KnownDevice, ...] = ()
        self._facts: RigFacts | None = None
        self._link = RigLink.CLOSED
        self._failure: str | None = None
        self._incomplete = 0
        self._bench: LiveBench | None = None
        self._picture: Future[None] | None = None
        self._wanted_until_s = 0.0
        self._watching: threading.Timer | None = None

    @property
    def owner(self) -> Owner | None:
        return self._owner

    @property
    def threads(self) -> DeviceThreads:
        """The threads of the opened rig's devices."""
        threads = self._threads
        if threads is None:
            raise self._closed_meanwhile()
        return threads

    def status(self) -> RigStatus:
        return RigStatus(
            link=self._link,
            options=self._asked_options,
            owner=self._owner,
            failure=self._failure,
            devices=self._devices,
            is_live=self._is_wanted(),
            wish=self.wish,
            facts=self._facts,
        )

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
                f"Rig {self.name!r} is busy: {owner.who} {owner.doing}; wait until that is done or cancel it.",
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
            else:
                self._end_live()
            self._open(options, made)
            return work(self._opened_rig())

        return self._thread.submit(open_and_work)

    def answer(self, asked: Future[T]) -> T:
        """Wait for an answer, but not with too many others: each of them holds one of the server's threads."""
        if asked.done():
            return asked.result()
        if not self._places.acquire(blocking=False):
            raise RigBusyError(
                f"Rig {self.name!r} doesn't answer yet, and others wait for it already: ask again in a moment."
            )
        try:
            return asked.result()
        finally:
            self._places.release()

    def discard(self) -> Future[None]:
        return self._thread.submit(self._close)

    def leave_stuck(self) -> None:
        """Leave the rig behind if a call into one of its drivers is stuck; doesn't wait for one that is opening."""
        threads = self._threads
        if threads is not None and threads.stuck:
            self._thread.submit(self._leave_if_stuck).result()

    def connect(self, options: Mapping[str, Any], *, anew: bool = False) -> None:
        with self._lock:
            if self._link in (RigLink.OPEN, RigLink.OPENING) and not anew:
                return
            self._link = RigLink.OPENING
            self._asked_options = dict(options)
        opening = self._thread.submit(lambda: self._open_unless_lent(options))
        opening.add_done_callback(self._note_failure)
        self._publish(RigChanged(rig=self.name))

    def disconnect(self) -> None:
        with self._lock:
            self.refuse_busy()
            rig = self._rig
            self._failure = None
            self._wanted_until_s = 0.0
            if rig is not None:
                self._link = RigLink.CLOSING
        if rig is not None:
            # Whoever waits for a picture stops waiting. Beside us: a driver may take its time even for that.
            threading.Thread(target=_abort, args=(rig,), daemon=True).start()
        self.discard()
        self._publish(RigChanged(rig=self.name))

    def watch(self) -> None:
        with self._lock:
            was_wanted = self._is_wanted()
            self._wanted_until_s = time.monotonic() + LIVE_HOLD_S
            if self._watching is None:
                self._look_again(LIVE_HOLD_S)
        if not was_wanted:
            self._publish(RigChanged(rig=self.name))
        self._ask_for_picture()

    def rest(self) -> None:
        self._wanted_until_s = 0.0
        self._thread.submit(self._end_live)
        self._publish(RigChanged(rig=self.name))

    def _is_wanted(self) -> bool:
        return time.monotonic() < self._wanted_until_s

    def _ask_for_picture(self) -> None:
        with self._lock:
            waiting = self._picture is not None and not self._picture.done()
            if self._link is not RigLink.OPEN or self._owner is not None or waiting:
                return
            self._picture = self._thread.submit(self._take_picture)

    def _look_again(self, later_s: float) -> None:
        self._watching = threading.Timer(later_s, self._look)
        self._watching.daemon = True
        self._watching.start()

    def _look(self) -> None:
        """See whether somebody still wants pictures; if nobody does, end them."""
        with self._lock:
            left_s = self._wanted_until_s - time.monotonic()
            if left_s > 0:
                self._look_again(left_s + 0.01)
                return
            self._watching = None
        self.rest()

    def _note_failure(self, opening: "Future[None]") -> None:
        """Keep why a rig couldn't be opened for those who look."""
        error = opening.exception()
        if isinstance(error, UnglareError):
            self._failure = error.sentence
        elif error is not None:
            # A plug-in may raise anything.
            log.error("Rig %r can't be opened.", self.name, exc_info=error)
            self._failure = (
                f"Rig {self.name!r} failed with {type(error).__name__}: {error}; see the log."
            )
        self._publish(RigChanged(rig=self.name))

    # on the rig's thread

    def _closed_meanwhile(self) -> RigFailedError:
        return RigFailedError(f"Rig {self.name!r} was closed in the meantime: run again.")

    def _opened_rig(self) -> Rig:
        if self._rig is None:
            raise self._closed_meanwhile()
        return self._rig

    def _open_unless_lent(self, options: Mapping[str, Any]) -> None:
        """Open the rig, unless somebody has begun to capture meanwhile: it is opened with his options."""
        if self._owner is None:
            self._open(options, None)
        else:
            self._link = RigLink.CLOSED if self._rig is None else RigLink.OPEN

    def _open(self, options: Mapping[str, Any], made: Rig | None) -> None:
        if self._rig is not None and self.holds(options) and _is_healthy(self._rig):
            self._link = RigLink.OPEN
            return
        self._close()
        self._link, self._asked_options = RigLink.OPENING, dict(options)
        try:
            self._open_anew(made or self._open_rig(self.name, options), options)
        except BaseException:
            if self._thread.is_here:
                self._link = RigLink.CLOSED
            raise
        self._link, self._failure = RigLink.OPEN, None
        self._publish(RigChanged(rig=self.name))

    def _open_anew(self, rig: Rig, options: Mapping[str, Any]) -> None:
        with self._thread.beside_what_is_stuck(), self._thread.limited(rig, OPENING):
            rig.open()
            try:
                self._tell_opened(self.name, _canonical(options), rig)
                devices, facts = _known(rig), rig.facts()
            except BaseException:
                rig.close()
                raise
        # Only now: a thread that was left behind doesn't get here, another rig may be open meanwhile.
        self._devices, self._facts = devices, facts
        self._threads = DeviceThreads(known.device for known in self._devices)
        self._rig, self._options = rig, _canonical(options)

    def _close(self) -> None:
        rig, threads = self._rig, self._threads
        if rig is None or threads is None:
            self._link = RigLink.CLOSED
            return
        self._link = RigLink.CLOSING
        if self._leave_if_stuck():
            return
        self._end_live()
        if self._leave_if_stuck():
            return
        threads.leave(self._closed_meanwhile(), _nothing)
        with self._thread.limited(rig, CLOSING):
            rig.close()
        self._forget()

    def _forget(self) -> None:
        """Know no rig any more: it is closed, or left behind."""
        self._rig, self._options, self._threads, self._devices = None, None, None, ()
        self._bench, self._facts, self._link = None, None, RigLink.CLOSED
        self.live.clear()
        self._publish(RigChanged(rig=self.name))

    def _leave_if_stuck(self) -> bool:
        rig, threads = self._rig, self._threads
        return rig is not None and threads is not None and self._thread.leave_stuck(rig, threads)

    def _take_picture(self) -> None:
        rig, wish = self._rig, self.wish
        if rig is None or wish is None or self._owner is not None or not self._is_wanted():
            return
        if not _is_healthy(rig):
            return  # it has to be reconnected; its devices' states say so
        if self._bench is None:
            # Asked again: a page measures its monitor's refresh rate when it has one.
            self._bench, self._devices = LiveBench(rig, self.threads), _known(rig)
        try:
            self.live.update(self._bench.take(wish))
        except UnglareError as error:
            if self._link is RigLink.CLOSING:
                return  # whoever disconnects doesn't want the picture
            if isinstance(error, IncompleteFrame) and self._incomplete < _FEW_INCOMPLETE:
                self._incomplete += 1
                return  # nobody misses it: the next one comes at once
            if error.sentence != self._failure:
                log.warning("No live picture of rig %r: %s", self.name, error)
            self._failure = error.sentence
            self._leave_if_stuck()
        else:
            self._failure, self._incomplete = None, 0

    def _end_live(self) -> None:
        bench, self._bench = self._bench, None
        if bench is not None:
            bench.rest()


def _nothing() -> None:
    """Nothing is stuck that it could be called behind."""


def _abort(rig: Rig) -> None:
    for camera in rig.cameras.values():
        camera.abort()


def _known(rig: Rig) -> tuple[KnownDevice, ...]:
    cameras = [KnownDevice(c, c.info, c.capabilities) for c in rig.cameras.values()]
    projector = rig.projector
    return (*cameras, KnownDevice(projector, projector.info, projector.capabilities))


def _is_healthy(rig: Rig) -> bool:
    devices = [*rig.cameras.values(), rig.projector]
    return all(device.state in (LinkState.READY, LinkState.ARMED) for device in devices)


def _canonical(options: Mapping[str, Any]) -> str:
    return json.dumps(options, sort_keys=True, default=str)
