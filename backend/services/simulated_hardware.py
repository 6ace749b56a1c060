"""Simulated hardware: cameras on the network, what lights the scene before them, and their rig file."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from backend.devices.calibration_entries import entry_of
from backend.devices.peers.gige_camera import Wire
from backend.devices.peers.monitor_display import MonitorDisplay, MonitorHistory
from backend.devices.peers.simulated_cameras import Peer, PeerProcess, make_rig
from backend.devices.peers.simulated_light import Ended, LightSource
from backend.devices.protocols import Rig
from backend.devices.rig_file import RigFile
from backend.domain.errors import InvalidSettingError, StartupError
from backend.domain.rig import RigCalibration

_SIZE_OPTIONS = {"simulated": "projector_size", "sim-lcd": "screen_size"}
_STEADY: dict[str, dict[str, Any]] = {"simulated": {"frame_period_ms": None}, "sim-lcd": {}}
"""Light that isn't modulated within what is seen of it."""


@dataclass(frozen=True)
class Hardware:
    """What is to be simulated."""

    rig: str
    """`simulated` or `sim-lcd`."""
    options: Mapping[str, Any]
    addresses: Sequence[str]
    light: LightSource
    lag_ms: float = 0.0
    """So much later than it is shown everything comes to light."""
    packet_loss: float = 0.0
    seed: int = 0
    """Of the lost packets."""

    @property
    def rig_options(self) -> dict[str, Any]:
        """Return the simulated rig's options: its display is what lights it.

        Raises
        ------
        InvalidSettingError
            If they say another size.
        """
        name, (width, height) = _SIZE_OPTIONS[self.rig], self.light.size
        size = f"{width}x{height}"
        wanted = self.options.get(name, size)
        if wanted != size:
            raise InvalidSettingError(
                f"{name} is {wanted}, {self.light.words} is {size}: leave the option out."
            )
        return {**_STEADY[self.rig], **self.options, name: size}


class SimulatedHardware:
    """Cameras on the network, each in a process; `run` lights what they see.

    Parameters
    ----------
    hardware
        What is to be simulated.
    ended
        Asked while the cameras start, which may take minutes: whether nobody wants them any more.

    Raises
    ------
    StartupError
        If there aren't as many addresses as cameras, or one of them is taken.
    CancelledError
        If `ended` says so.
    UnglareError
        If an option can't be used.
    """

    def __init__(self, hardware: Hardware, ended: Callable[[], bool] = lambda: False) -> None:
        self._ended = ended
        self._hardware = hardware
        with ExitStack() as stack:
            self._history = MonitorHistory(*hardware.light.size)
            stack.callback(self._history.destroy)
            light = MonitorDisplay(self._history, lag_s=hardware.lag_ms / 1000.0)
            rig = make_rig(hardware.rig, hardware.rig_options, light)
            _refuse_other_counts(rig, hardware.addresses)
            self._file = rig_file(rig, hardware)
            self.peers = self._started(rig, light, stack)
            self._stack = stack.pop_all()

    def _started(self, rig: Rig, light: MonitorDisplay, stack: ExitStack) -> list[PeerProcess]:
        hardware = self._hardware
        peers = []
        for number, (camera, address) in enumerate(
            zip(rig.cameras, hardware.addresses, strict=True)
        ):
            wire = Wire(loss=hardware.packet_loss, seed=hardware.seed + number)
            peer = Peer(hardware.rig, hardware.rig_options, camera, address, wire)
            peers.append(PeerProcess(peer, light))
            stack.callback(peers[-1].stop)
        for process in peers:
            stack.callback(process.tell_end)  # all of them end at once, then they are waited for
        for process in peers:
            process.wait_until_ready(self._ended)
        return peers

    def write_rig(self, path: Path) -> None:
        """Write the rig file.

        Raises
        ------
        StartupError
            If it can't be written.
        """
        try:
            path.write_text(yaml.safe_dump(self._file, sort_keys=False), "utf-8")
        except OSError as error:
            raise StartupError(
                f"The rig file {path} can't be written ({error.strerror}): choose another name."
            ) from error

    def run(self, ended: Ended) -> None:
        """Light the scene until told to end.

        Raises
        ------
        StartupError
            If a camera's process ended by itself, or the light can't be had.
        """
        self._hardware.light.run(
            self._history, self._fire, lambda left_s: ended(left_s) or self._refuse_dead()
        )

    def _fire(self, number: int, time_s: float, shown_us: float) -> None:
        for process in self.peers:
            process.fire(number, time_s, shown_us)

    def _refuse_dead(self) -> bool:
        for process in self.peers:
            if not process.is_alive:
                raise StartupError(
                    f"The process of camera {process.peer.camera} ended: start again, and look at what it wrote."
                )
        return False

    def close(self) -> None:
        """Take the cameras off the network."""
        self._stack.close()


def _refuse_other_counts(rig: Rig, addresses: Sequence[str]) -> None:
    if len(addresses) != len(rig.cameras):
        raise StartupError(
            f"{len(rig.cameras)} cameras need as many addresses, {len(addresses)} are given: use --address once for each."
        )


def rig_file(rig: Rig, hardware: Hardware) -> dict[str, Any]:
    """Write the rig file of simulated hardware: the exact calibration, the sensors' true facts."""
    facts, calibration, light = rig.facts(), rig.calibration(), hardware.light
    wiring = {"trigger_line": light.trigger_line} if light.trigger_line else {}
    cameras = {
        name: {
            "driver": "aravis",
            "address": address,
            **wiring,
            "sensor": {
                "bit_depth": camera.bit_depth,
                "black_level_gray": float(camera.black_level_gray),
                "full_well_e": float(camera.full_well_e),
                "read_noise_e": float(camera.read_noise_e),
            },
        }
        for (name, camera), address in zip(facts.cameras.items(), hardware.addresses, strict=True)
    }
    gamma = facts.projector.gamma if facts.projector else 1.0
    document: dict[str, Any] = {
        "title": f"Simulated hardware: {rig.info.model}",
        "cameras": cameras,
        "projector": {**light.entry, "gamma": gamma},
    }
    if calibration is not None:
        document["calibration"] = _calibration(calibration, light.size, square=not wiring)
    RigFile.of(document, "of the simulated hardware")
    return document


def _calibration(
    calibration: RigCalibration, display_px: tuple[int, int], *, square: bool
) -> dict[str, Any]:
    """Write where the devices are; a projector whose mirrors stand on their corners has no model here."""
    entry = entry_of(calibration, display_px)
    if not square:
        entry = entry.model_copy(update={"projector": None})
    return entry.model_dump(mode="json", exclude_none=True)
