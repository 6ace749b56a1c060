"""What the drivers of cameras behind blocking libraries share: the protocol's rules, told once.

A driver adds how its library opens, sets, starts, triggers and fetches. Waiting is done in slices, so that `abort`
and a lost device are noticed whatever the library does meanwhile.
"""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8, UInt16

from backend.devices.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
)
from backend.devices.link import Link
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
    LinkState,
    Range,
    TriggerSource,
)
from backend.devices.refusals import (
    cure_of_silence,
    refuse_impossible,
    refuse_locked,
    refuse_trigger,
)

log = logging.getLogger(__name__)

SLICE_S = 0.1
"""How long a wait lasts before `abort` and a lost device are noticed."""
HEARTBEAT_S = 3.0
"""So long a dead client keeps control of a camera on the network."""
_RETRY_S = 0.25
_READY_S = 2.0
_PATIENCE_S = 2.0
"""How long `abort` and `close` wait for a call of the library to return."""

_UNKNOWN = CameraCapabilities((0, 0), (), Range(0, 0), Range(0, 0), ())
"""Before a camera was opened: it can't be set to anything."""


class LibraryCamera(Link):
    """A `Camera` but for the library: the methods that raise `NotImplementedError` are the driver's.

    They are called by one thread at a time. What a library raises in them becomes a `DeviceError` by `_translated`.
    """

    def __init__(self, name: str, info: DeviceInfo) -> None:
        super().__init__(name, info)
        self._capabilities = _UNKNOWN
        self._settings = CameraSettings(0.0)
        self._wanted: CameraSettings | None = None
        self._aborted = threading.Event()
        self._given_up = threading.Event()
        """Whoever waits for the camera to come back waits no longer."""
        self._calling = threading.RLock()
        """Held during every call of the library: `abort` may come from any thread."""
        self._free_at_s = 0.0
        self._due_at_s = 0.0

    # ------------------------------------------------------------ the driver's part

    def _connect(self) -> tuple[DeviceInfo, CameraCapabilities, CameraSettings]:
        """Take control; say who the camera is, what it can, how it is set."""
        raise NotImplementedError

    def _disconnect(self) -> None:
        """Give everything back, also after a `_connect` that failed half-way; any number of times."""
        raise NotImplementedError

    def _apply(self, wanted: CameraSettings) -> CameraSettings:
        """Set what differs from `settings` and return what is read back. All of it was checked before."""
        raise NotImplementedError

    def _start(self, n_frames: int | None) -> None:
        """Provide buffers and start acquisition."""
        raise NotImplementedError

    def _stop(self) -> None:
        """Stop acquisition."""
        raise NotImplementedError

    def _ready(self, wait_s: float) -> bool:
        """Wait until the camera takes a trigger; without an answer of its own its exposure's end is waited for."""
        del wait_s
        return True

    def _fire(self) -> None:
        """Trigger by software."""
        raise NotImplementedError

    def _next(self, wait_s: float) -> Frame | None:
        """Return the oldest frame, or None if none comes in time."""
        raise NotImplementedError

    def _translated(self, error: Exception, doing: str) -> DeviceError | None:
        """Make a sentence of an error of the library; None: it isn't one, but a defect."""
        raise NotImplementedError

    # ------------------------------------------------------------ life

    def open(self) -> None:
        """Take control."""
        if self._state in (LinkState.READY, LinkState.ARMED):
            return
        with self._calling:
            self._disconnect()  # what a lost connection left behind
            try:
                with self._doing("opening"):
                    self._info, self._capabilities, self._settings = self._connect()
            except BaseException:
                self._disconnect()
                self._state = LinkState.CLOSED
                raise
        self._state = LinkState.READY

    def close(self) -> None:
        """Give the camera back; whoever waits for a frame stops waiting."""
        self._aborted.set()
        if not self._calling.acquire(timeout=_PATIENCE_S):
            log.warning("%s: its library doesn't return; the camera isn't given back", self.name)
            self._state = LinkState.CLOSED
            return
        try:
            self._stop_quietly()
            self._disconnect()
            self._state = LinkState.CLOSED
        finally:
            self._calling.release()

    def reconnect(self, timeout_s: float = 10.0) -> None:
        """Open again, with the settings of before; a former owner's heartbeat may have to end first."""
        wanted = self._wanted
        patience_s = max(timeout_s, 2 * HEARTBEAT_S)
        deadline_s = time.monotonic() + patience_s
        self._given_up.clear()
        while True:
            self.close()
            try:
                self.open()
                break
            except (DeviceBusy, DeviceNotFound, DeviceTimeout, DeviceDisconnected) as error:
                if self._given_up.wait(_RETRY_S):
                    raise self._lose(f"is no longer waited for ({error})") from error
                if time.monotonic() > deadline_s:
                    raise self._lose(
                        f"doesn't come back within {patience_s:g} s ({error})"
                    ) from error
        if wanted is not None:
            self.configure(wanted)

    @contextmanager
    def _doing(self, what: str) -> Iterator[None]:
        try:
            yield
        except DeviceError:
            raise
        except Exception as error:
            told = self._translated(error, what)
            if told is None:
                raise
            raise told from error

    # ------------------------------------------------------------ settings

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can be set to."""
        return self._capabilities

    @property
    def settings(self) -> CameraSettings:
        """The settings as read back."""
        return self._settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Check everything, then apply what changes, then read back."""
        self._need_link()
        refuse_impossible(self.name, settings, self.capabilities)
        wanted = replace(
            settings, pixel_format=settings.pixel_format or self._settings.pixel_format
        )
        if self._state is LinkState.ARMED:
            refuse_locked(self.name, self._settings, wanted)
        with self._calling, self._doing("setting up"):
            self._settings = self._apply(wanted)
        self._wanted = self._settings
        return self._settings

    # ------------------------------------------------------------ frames

    def arm(self, n_frames: int | None = None) -> None:
        """Provide buffers and start acquisition."""
        self._need_link()
        with self._calling:
            self.disarm()
            self._aborted.clear()
            self._free_at_s = self._due_at_s = 0.0
            with self._doing("arming"):
                self._start(n_frames)
            self._state = LinkState.ARMED

    def trigger(self) -> None:
        """Wait until the camera is ready for it, then start one exposure."""
        self._need_link()
        refuse_trigger(self.name, self._settings, armed=self._state is LinkState.ARMED)
        self._aborted.wait(max(0.0, self._free_at_s - time.monotonic()))
        with self._calling, self._doing("the trigger"):
            self._refuse_waiting()  # acquisition may have been aborted meanwhile
            self._wait_until_ready()
            self._fire()
        self._due_at_s = time.monotonic() + self._settings.exposure_us * 1e-6
        self._free_at_s = self._due_at_s + self.capabilities.min_frame_period_s

    def _wait_until_ready(self) -> None:
        deadline_s = time.monotonic() + _READY_S
        while not self._ready(SLICE_S):
            self._refuse_waiting()
            if time.monotonic() > deadline_s:
                raise DeviceTimeout(
                    self.name, f"isn't ready for a trigger within {_READY_S:g} s; arm it again"
                )

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        """Fetch the oldest frame."""
        self._need_link()
        deadline_s = max(self._due_at_s, time.monotonic()) + timeout_s
        if self._settings.trigger is TriggerSource.FREE_RUN:
            deadline_s += self._settings.exposure_us * 1e-6
        while True:
            self._refuse_waiting()
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise DeviceTimeout(
                    self.name, f"no frame came within {timeout_s:g} s; {self._cure}"
                )
            frame = self._fetched(min(left_s, SLICE_S))
            if frame is not None:
                return frame

    def _fetched(self, wait_s: float) -> Frame | None:
        with self._calling:
            if self._state is LinkState.ARMED:
                with self._doing("fetching a frame"):
                    return self._next(wait_s)
        self._aborted.wait(wait_s)  # not armed: nothing comes
        return None

    def _refuse_waiting(self) -> None:
        if self._aborted.is_set():
            raise DeviceTimeout(self.name, "waiting for a frame was aborted; arm again")
        if self._state is LinkState.LOST:
            raise self._lose("control was lost")

    def _told(
        self,
        data: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
        number: int,
        timestamp_s: float | None,
        bits: int,
    ) -> Frame:
        """Make a frame of a picture, with the settings in force."""
        settings = self._settings
        return Frame(
            data=data,
            pixel_format=settings.pixel_format or "Mono8",
            bits=bits,
            frame_id=number,
            exposure_us=settings.exposure_us,
            gain_db=settings.gain_db,
            timestamp_s=timestamp_s,
            host_time_s=time.monotonic(),
        )

    @property
    def _cure(self) -> str:
        """What to do when no frame comes."""
        return cure_of_silence(self._settings.trigger, triggered=self._due_at_s > 0)

    def disarm(self) -> None:
        """Stop acquisition."""
        with self._calling:
            if self._state is LinkState.ARMED:
                self._state = LinkState.READY
                with self._doing("disarming"):
                    self._stop()

    def abort(self) -> None:
        """Stop waiting; thread-safe. If the library doesn't return, acquisition ends when the camera is armed next."""
        self._given_up.set()
        self._aborted.set()
        if self._calling.acquire(timeout=_PATIENCE_S):
            try:
                self._stop_quietly()
            finally:
                self._calling.release()

    def _stop_quietly(self) -> None:
        try:
            self.disarm()
        except DeviceError as error:  # a camera that is gone streams no more either
            log.debug("%s", error)
