"""`unglare projector`: the projector page full screen on the projector's monitor."""

import signal
import sys
from typing import Annotated

import typer

from backend.cli.options import DataFolder


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(projector)


def projector(
    monitor: Annotated[
        int | None,
        typer.Option(min=1, help="Number of the monitor, as listed; else the last one."),
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(help="Address of the server.  [default: this machine's]", show_default=False),
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="UNGLARE_TOKEN", help="Operators' token; without it the page asks for it."
        ),
    ] = None,
    name: Annotated[
        str, typer.Option(help="Which projector the page is, as the rig file says.")
    ] = "projector",
    listing: Annotated[bool, typer.Option("--list", help="List the monitors and end.")] = False,
    data: DataFolder = None,
) -> None:
    """Show the projector page in a window of its own that fills a monitor; ends with the window."""
    from backend.services.kiosk import Kiosk, listed_monitors
    from backend.settings import load_settings

    monitors = listed_monitors()
    if listing:
        for number, found in enumerate(monitors, start=1):
            typer.echo(f"{number}: {found}")
        return
    settings = load_settings(data_folder=data)
    address = url or f"http://127.0.0.1:{settings.port}"
    kiosk = Kiosk(settings.data_folder / "kiosk")
    chosen = kiosk.choose(monitors, monitor)
    typer.echo(
        f"The projector page of {address} is shown on monitor {chosen}. Close it with Alt+F4 or Ctrl+C."
    )
    # As Ctrl+C does: the window is closed behind the command.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    kiosk.run(chosen, address, name=name, token=token)
