"""`unglare simulate-hardware`: cameras on the network that look at a monitor of this machine."""

import signal
import tempfile
import threading
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from backend.cli.options import RigOptions, Scene, Seed, Size, parse_rig_options
from backend.cli.output import quiet_logging

if TYPE_CHECKING:
    from backend.devices.peers.simulated_light import MonitorLight

_FIRST_HOST = 2
_SOCKET = Path(tempfile.gettempdir()) / "unglare-lightcrafter.sock"


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command("simulate-hardware")(simulate_hardware)


def simulate_hardware(
    scene: Scene = None,
    size: Size = None,
    seed: Seed = None,
    rig_options: RigOptions = None,
    address: Annotated[
        list[str] | None,
        typer.Option(
            help="Address of a camera; once for each.  [default: 127.0.0.2, 127.0.0.3]",
            show_default=False,
        ),
    ] = None,
    monitor: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of the monitor that the cameras look at, as `unglare projector --list` shows; else the last one.",
        ),
    ] = None,
    projector: Annotated[
        Literal["monitor", "dlpc350"],
        typer.Option(
            help="What lights the scene: what a monitor shows, or a simulated LightCrafter 4500 that triggers the cameras."
        ),
    ] = "monitor",
    patterns: Annotated[
        Path | None,
        typer.Option(
            help="Set of patterns in the LightCrafter's flash, exported with --pack 24bit."
        ),
    ] = None,
    socket: Annotated[
        Path, typer.Option(help="Where the simulated LightCrafter's driver finds it.")
    ] = _SOCKET,
    write_rig: Annotated[
        Path | None,
        typer.Option(help="Write the rig file that goes with it: `unglare rigs add FILE`."),
    ] = None,
    page: Annotated[
        str, typer.Option(help="Name of the projector page in the rig file.")
    ] = "projector",
    lag_ms: Annotated[
        float,
        typer.Option(
            min=0, max=2000, help="So much later than on the monitor everything comes to light."
        ),
    ] = 0.0,
    packet_loss: Annotated[
        float, typer.Option(min=0, max=0.5, help="Share of the cameras' packets that get lost.")
    ] = 0.0,
) -> None:
    """Simulate a rig's hardware: GigE Vision cameras that see what a monitor shows, lit onto a scene.

    The projector page on that monitor is the projector, or a simulated LightCrafter is; everything between is the real
    thing. Ends with Ctrl+C.
    """
    from backend.devices.loading import DEFAULT_METHOD, rig_for
    from backend.devices.peers.simulated_light import LightcrafterLight
    from backend.domain.errors import CancelledError, InvalidSettingError
    from backend.services.simulated_hardware import Hardware, SimulatedHardware

    quiet_logging()
    options = parse_rig_options(rig_options, scene=scene, size=size, seed=seed)
    rig = rig_for(scene, DEFAULT_METHOD)
    count = 1 if rig == "sim-lcd" else int(options.get("cameras", 2))
    if projector == "dlpc350" and patterns is None:
        raise InvalidSettingError(
            "A simulated LightCrafter needs patterns in its flash: give --patterns FOLDER, made by unglare patterns export"
            " --projector-size 912x1140 --pack 24bit."
        )
    hardware = Hardware(
        rig=rig,
        options=options,
        addresses=address or [f"127.0.0.{_FIRST_HOST + n}" for n in range(count)],
        light=LightcrafterLight(patterns, socket)
        if projector == "dlpc350" and patterns is not None
        else _watched(monitor, page),
        lag_ms=lag_ms,
        packet_loss=packet_loss,
        seed=seed or 0,
    )
    ended = _told_to_end()
    with (
        suppress(CancelledError),  # Ctrl+C while they start ends them as it does later
        closing(SimulatedHardware(hardware, ended.is_set)) as simulated,
    ):
        if write_rig is not None:
            simulated.write_rig(write_rig)
            typer.echo(f"The rig file is {write_rig}; keep it: unglare rigs add {write_rig}")
        for process in simulated.peers:
            typer.echo(f"Camera {process.peer.camera} answers at {process.peer.address}.")
        typer.echo(f"The scene is lit by {hardware.light.words}. Stop with Ctrl+C.")
        simulated.run(ended.wait)


def _watched(monitor: int | None, page: str) -> "MonitorLight":
    from backend.devices.peers.monitor_display import Region
    from backend.devices.peers.simulated_light import MonitorLight
    from backend.services.kiosk import Kiosk, listed_monitors

    chosen = Kiosk.choose(listed_monitors(), monitor)
    region = Region(chosen.left_px, chosen.top_px, chosen.width_px, chosen.height_px)
    return MonitorLight(region, str(chosen), page=page)


def _told_to_end() -> threading.Event:
    """Return what is set by Ctrl+C and by SIGTERM, also where a shell has switched Ctrl+C off for us."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: ended.set())
    return ended
