"""`unglare serve` and `demo`: the application in the browser."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from backend.cli.options import DataFolder, RigOptions, parse_rig_options

if TYPE_CHECKING:
    from backend.services.services import Services

_Host = Annotated[
    str | None,
    typer.Option(
        help="Address to listen on; 0.0.0.0 for every network.  [default: 127.0.0.1]",
        show_default=False,
    ),
]
_Port = Annotated[
    int | None,
    typer.Option(min=0, max=65535, help="0: any free one.  [default: 8000]", show_default=False),
]

DEMO_SCENE = "high-contrast"


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(demo)
    application.command()(serve)


def serve(
    host: _Host = None,
    port: _Port = None,
    rig: Annotated[str | None, typer.Option(help="Rig that new scans are made with.")] = None,
    rig_options: RigOptions = None,
    data: DataFolder = None,
) -> None:
    """Serve the application in the browser, and print its address."""
    from backend import main
    from backend.settings import load_settings

    options = parse_rig_options(rig_options) or None
    main.serve(load_settings(host=host, port=port, data_folder=data, rig=rig, rig_options=options))


def demo(
    scene: Annotated[
        str, typer.Option(help="Scene of the first scan; others can be chosen in the browser.")
    ] = DEMO_SCENE,
    host: _Host = None,
    port: _Port = None,
    rig_options: RigOptions = None,
    data: DataFolder = None,
) -> None:
    """Serve the application with the simulated rigs, and begin a first scan."""
    from backend import main
    from backend.devices.loading import rig_for
    from backend.settings import load_settings

    options = parse_rig_options(rig_options, scene=scene)
    rig = rig_for(options["scene"], "")
    settings = load_settings(host=host, port=port, data_folder=data, rig=rig, rig_options=options)
    main.serve(settings, prepare=lambda services: begin_first_scan(services, options, rig))


def begin_first_scan(services: "Services", options: dict[str, Any], rig: str = "simulated") -> None:
    """Make and start a scan where there is none yet; an old data folder is left as it is."""
    import logging

    from backend.contract.requests import CreateScan, StartRun
    from backend.devices.loading import method_for
    from backend.domain.errors import UnglareError

    if services.scans(limit=1):
        return
    try:
        state = services.create_scan(
            CreateScan(method=method_for(rig), rig=rig, rig_options=options, name="First scan"),
            "demo",
        )
        services.run(state.id, StartRun(), "demo")
    except UnglareError as error:
        logging.getLogger(__name__).warning("The first scan can't begin: %s", error.sentence)
