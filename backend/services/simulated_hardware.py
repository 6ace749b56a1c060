"""Simulated hardware: cameras on the network that look at a monitor, and the rig file that goes with them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from backend.devices.peers.gige_camera import Wire
from backend.devices.peers.monitor_display import (
    MonitorDisplay,
    MonitorHistory,
    Region,
    Screen,
    watch,
)
from backend.devices.peers.simulated_cameras import Peer, PeerProcess, make_rig
from backend.devices.protocols import Rig
from backend.devices.rig_file import RigFile
from backend.devices.sim.renderer import Light
from backend.domain.errors import InvalidSettingError, StartupError
from backend.domain.rig import PinholeModel, Pose, RigCalibration
from backend.services.kiosk import Monitor

LOOKS_PER_S = 100.0
_SIZE_OPTIONS = {"simulated": "projector_size", "sim-lcd": "screen_size"}
_STEADY = {"simulated": {"frame_period_ms": None}, "sim-lcd": {}}
"""A monitor's light isn't modulated within its frames."""


@dataclass(frozen=True)
class Hardware:
    """What is to be simulated."""

    rig: str
    """`simulated` or `sim-lcd`."""
    options: Mapping[str, Any]
    addresses: Sequence[str]
    monitor: Monitor
    """What the cameras look at."""
    lag_ms: float = 0.0
    """So much later than on the monitor everything comes to light."""
    packet_loss: float = 0.0
    refresh_hz: float = 60.0
    looks_per_s: float = LOOKS_PER_S
    seed: int = 0
    """Of the lost packets."""
    page: str = "projector"
    """Name of the projector page in the rig file."""
    camera_options: Mapping[str, Any] = field(default_factory=dict)
    """More keys of each camera in the rig file, for its driver."""

    @property
    def rig_options(self) -> dict[str, Any]:
        """Return the simulated rig's options: its display is the monitor.

        Raises
        ------
        InvalidSettingError
            If they say another size than the monitor's.
        """
        monitor, name = self.monitor, _SIZE_OPTIONS[self.rig]
        size = f"{monitor.width_px}x{monitor.height_px}"
        wanted = self.options.get(name, size)
        if wanted != size:
            raise InvalidSettingError(
                f"{name} is {wanted}, monitor {monitor} is {size}: leave the option out, or choose another --monitor."
            )
        return {**_STEADY[self.rig], **self.options, name: size}


class SimulatedHardware:
    """Cameras that look at a monitor; `run` looks at it for them.

    Raises
    ------
    StartupError
        If there aren't as many addresses as cameras, or one of them is taken.
    UnglareError
        If an option can't be used or the monitor can't be read.
    """

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        monitor, self._stack = hardware.monitor, ExitStack()
        region = Region(monitor.left_px, monitor.top_px, monitor.width_px, monitor.height_px)
        with ExitStack() as stack:
            self._screen = Screen(region)
            stack.callback(self._screen.close)
            self._history = MonitorHistory(monitor.width_px, monitor.height_px)
            stack.callback(self._history.destroy)
            light = MonitorDisplay(self._history, lag_s=hardware.lag_ms / 1000.0)
            rig = make_rig(hardware.rig, hardware.rig_options, light)
            self._file = rig_file(rig, hardware)
            self.peers = self._started(rig, light, stack)
            self._stack = stack.pop_all()

    def _started(self, rig: Rig, light: Light, stack: ExitStack) -> list[PeerProcess]:
        hardware = self._hardware
        if len(hardware.addresses) != len(rig.cameras):
            raise StartupError(
                f"{len(rig.cameras)} cameras need as many addresses, {len(hardware.addresses)} are given: use --address"
                " once for each."
            )
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
            process.wait_until_ready()
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

    def run(self, ended: Callable[[float], bool]) -> None:
        """Look at the monitor until told to end.

        Parameters
        ----------
        ended
            Waits for so many seconds at most and says whether to end.

        Raises
        ------
        StartupError
            If a camera's process ended by itself.
        """
        watch(
            self._screen.gray,
            self._history,
            looks_per_s=self._hardware.looks_per_s,
            ended=lambda left_s: ended(left_s) or self._refuse_dead(),
        )

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


def rig_file(rig: Rig, hardware: Hardware) -> dict[str, Any]:
    """Write the rig file of simulated hardware: the exact calibration, the sensors' true facts."""
    facts, calibration, monitor = rig.facts(), rig.calibration(), hardware.monitor
    gamma = facts.projector.gamma if facts.projector else 1.0
    document: dict[str, Any] = {
        "title": f"Simulated hardware: {rig.info.model}",
        "cameras": {
            name: {
                "driver": "aravis",
                "address": address,
                **hardware.camera_options,
                "sensor": {
                    "bit_depth": camera.bit_depth,
                    "black_level_gray": float(camera.black_level_gray),
                    "full_well_e": float(camera.full_well_e),
                    "read_noise_e": float(camera.read_noise_e),
                },
            }
            for (name, camera), address in zip(
                facts.cameras.items(), hardware.addresses, strict=False
            )
        },
        "projector": {
            "driver": "page",
            "page": hardware.page,
            "size": f"{monitor.width_px}x{monitor.height_px}",
            "refresh_hz": hardware.refresh_hz,
            "gamma": gamma,
        },
    }
    if calibration is not None and calibration.projector is not None:
        document["calibration"] = _calibration(calibration)
    RigFile.of(document, "of the simulated hardware")
    return document


def _calibration(calibration: RigCalibration) -> dict[str, Any]:
    written: dict[str, Any] = {
        "cameras": {
            name: _view(model, calibration.camera_from_world[name])
            for name, model in calibration.cameras.items()
        }
    }
    if calibration.projector is not None and calibration.projector_from_world is not None:
        written["projector"] = _view(calibration.projector, calibration.projector_from_world)
    return written


def _view(model: PinholeModel, device_from_world: Pose) -> dict[str, Any]:
    return {
        "width_px": model.width_px,
        "height_px": model.height_px,
        "K": model.K.tolist(),
        "distortion": model.distortion.tolist(),
        "R": device_from_world.R.tolist(),
        "t_mm": device_from_world.t_mm.tolist(),
    }
