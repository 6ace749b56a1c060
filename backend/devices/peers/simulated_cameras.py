"""Cameras of a simulated rig on the network, a process each: rendering one never delays the other's packets."""

import errno
import logging
import multiprocessing
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

from backend.devices.errors import DeviceError
from backend.devices.options import read_options
from backend.devices.peers.gige_camera import GigECamera, Wire
from backend.devices.peers.monitor_display import MonitorDisplay
from backend.devices.protocols import Camera
from backend.devices.sim import (
    SimulatedLcdConfig,
    SimulatedLcdRig,
    SimulatedRig,
    SimulatedRigConfig,
)
from backend.devices.sim.camera import SimulatedCamera
from backend.devices.sim.renderer import Light
from backend.domain.errors import CancelledError, StartupError, UnglareError

log = logging.getLogger(__name__)

_START_S = 300.0
"""So long a large scene may take to be cast."""
_END_S = 5.0
_LOOK_S = 0.2


@dataclass(frozen=True)
class Peer:
    """One camera to be: which, of what rig, where."""

    rig: str
    """`simulated` or `sim-lcd`."""
    options: Mapping[str, Any]
    camera: str
    address: str
    wire: Wire = field(default_factory=Wire)


def make_rig(
    name: str, options: Mapping[str, Any], light: Light | None
) -> SimulatedRig | SimulatedLcdRig:
    """Make a simulated rig that something outside lights; nothing is opened yet.

    Raises
    ------
    RigConfigError
        If an option is unknown or can't be used.
    """
    if name == "sim-lcd":
        return SimulatedLcdRig(read_options(SimulatedLcdConfig, "simulated rig", options), light)
    return SimulatedRig(read_options(SimulatedRigConfig, "simulated rig", options), light)


class PeerProcess:
    """A process that serves one camera; it ends with this object's `stop`, and with the process that made it."""

    def __init__(self, peer: Peer, light: MonitorDisplay) -> None:
        self.peer = peer
        context = multiprocessing.get_context("spawn")
        self._told, theirs = context.Pipe()
        self._process: SpawnProcess = context.Process(
            target=_serve, args=(peer, light, theirs), name=f"camera-{peer.camera}", daemon=True
        )
        self._process.start()
        theirs.close()

    def wait_until_ready(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Wait until the camera answers, or until `ended` says that nobody wants it any more.

        Raises
        ------
        StartupError
            If it can't: the address is taken, or the scene can't be made.
        CancelledError
            If `ended` says so.
        """
        problem = f"it isn't ready after {_START_S:g} s; choose a smaller size"
        deadline_s = time.monotonic() + _START_S
        try:
            while not (there := self._told.poll(_LOOK_S)) and time.monotonic() < deadline_s:
                if ended():
                    raise CancelledError("Ended before the cameras were ready.")
            if there:
                problem = self._told.recv()
        except EOFError:
            problem = "its process ended at once; look at what it wrote"
        if problem:
            raise StartupError(
                f"The simulated camera {self.peer.camera} at {self.peer.address} can't start: {problem}"
            )

    def fire(self, number: int, time_s: float, shown_us: float) -> None:
        """Fire the camera's trigger line: a frame of the light is shown from a time on, for so long."""
        with suppress(OSError):  # a camera that is gone isn't triggered
            self._told.send((number, time_s, shown_us))

    @property
    def is_alive(self) -> bool:
        """Whether the camera is served still."""
        return self._process.is_alive()

    @property
    def pid(self) -> int | None:
        """Number of the process."""
        return self._process.pid

    def kill(self) -> None:
        """End it as a power cut would."""
        self._process.kill()
        self._process.join()

    def tell_end(self) -> None:
        """Have it end, without waiting for that."""
        self._told.close()

    def stop(self) -> None:
        """Take the camera off the network; any number of times."""
        self.tell_end()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(peer: Peer, light: MonitorDisplay, told: Connection) -> None:
    """Serve, and fire the trigger line, until the other end of the pipe is closed."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl+C is for who started this, and ends it in order
    try:
        _warm_up(peer)
        rig = make_rig(peer.rig, peer.options, light)
        camera = rig.cameras[peer.camera]
        with rig, GigECamera(camera, peer.address, peer.wire):
            told.send("")
            _fire_until_end(camera, light, told)
    except UnglareError as error:
        _tell(told, error.sentence)
    except OSError as error:
        _tell(told, _address_problem(error))


def _warm_up(peer: Peer) -> None:
    """Take a picture by the rig's own light: compiling its kernels would make the first real one late."""
    with make_rig(peer.rig, peer.options, None) as rig:
        camera = rig.cameras[peer.camera]
        camera.arm()
        camera.trigger()
        camera.get_frame()


def _fire_until_end(camera: Camera, light: MonitorDisplay, told: Connection) -> None:
    while True:
        try:
            number, time_s, shown_us = told.recv()
        except (EOFError, OSError):
            return
        if not isinstance(camera, SimulatedCamera):
            continue
        try:
            camera.line_edge(light.held(number), time_s, shown_us)
        except DeviceError as error:  # exposed for too long, or far too late
            log.warning("An edge of the trigger line had no effect: %s", error)


def _tell(told: Connection, problem: str) -> None:
    try:
        told.send(problem)
    except OSError:
        return  # whoever started this is gone


def _address_problem(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "another camera has this address; stop that one, or choose another with --address"
    if error.errno == errno.EADDRNOTAVAIL:
        return "this machine hasn't got this address; choose one of 127.0.0.0/8 with --address"
    return f"{error.strerror or error}; choose another address with --address"
