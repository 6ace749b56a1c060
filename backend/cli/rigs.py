"""`unglare rigs`: which rigs this station has, the files that describe them, and whether a rig works."""

from pathlib import Path
from typing import Annotated

import typer

from backend.cli.checking import check_rig
from backend.cli.conforming import conform
from backend.cli.discovering import discover
from backend.cli.house import Monitor, open_services
from backend.cli.options import AsJson, DataFolder
from backend.cli.output import answering, console, quiet_logging, table
from backend.cli.rig_files import calibration, open_shelf, show, template


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    group = typer.Typer(
        name="rigs",
        help="The station's rigs: built in, from packages, and described by files.",
        no_args_is_help=True,
    )
    group.command("list")(list_rigs)
    group.command("add")(add)
    group.command("remove")(remove)
    group.command("show")(show)
    group.command("template")(template)
    group.command("calibration")(calibration)
    group.command("check")(check_rig)
    group.command("conform")(conform)
    group.command("latency")(latency)
    group.command("discover")(discover)
    application.add_typer(group)


def list_rigs(data: DataFolder = None, as_json: AsJson = False) -> None:
    """List every rig that scans can be made with, and why one can't be used."""
    quiet_logging()
    with answering(as_json) as answer, open_services(data) as services:
        offers = services.rigs()
        answer["rigs"] = [offer.model_dump(mode="json") for offer in offers]
    if as_json:
        return
    rows = table("name", "title", "from")
    for offer in offers:
        rows.add_row(offer.name, offer.title, offer.error or offer.doc)
    console().print(rows)


def add(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Rig file (YAML).")],
    name: Annotated[str, typer.Option(help="Name of the rig; else the file's.")] = "",
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Check a rig file and keep it; scans can then be made with --rig NAME."""
    quiet_logging()
    with answering(as_json) as answer:
        kept = open_shelf(data).add(file, name)
        answer.update({"name": kept.name, "path": str(kept.path)})
        if not as_json:
            console().print(
                f"rig {kept.name} is kept in {kept.path}; try it: unglare rigs check --rig {kept.name}"
            )


def remove(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the rig.")],
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Take a rig file away; it is renamed, not deleted."""
    quiet_logging()
    with answering(as_json) as answer:
        left = open_shelf(data).remove(name)
        answer.update({"name": name, "path": str(left)})
        if not as_json:
            console().print(f"rig {name} is no longer offered; its file is {left}")


def latency(
    rig: Annotated[str, typer.Option(help="Name of a rig that is described by a file.")],
    repetitions: Annotated[int, typer.Option(min=3, max=100, help="Changes each way.")] = 10,
    monitor: Monitor = None,
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Measure how long after its acknowledgement the projector shows a pattern, and keep it for the rig."""
    from dataclasses import asdict

    from backend.services.latency import measure_latency

    quiet_logging()
    with answering(as_json) as answer:
        shelf = open_shelf(data)
        shelf.require(rig)
        with open_services(data, rig=rig, monitor=monitor) as services:
            found = measure_latency(
                services.context, rig, {}, _say_progress, repetitions=repetitions
            )
        path = found.keep(shelf.folder, rig)
        answer.update({**asdict(found), "path": str(path)})
    if as_json:
        return
    rows = table(">after acknowledgement", ">black to white", ">white to black")
    for delay_ms, up, down in zip(found.delays_ms, found.up, found.down, strict=True):
        rows.add_row(f"{delay_ms:.1f} ms", f"{up:.3f}", f"{down:.3f}")
    console().print(rows)
    console().print(f"settle time {found.settle_ms:.1f} ms, kept in {path}")
    if found.by_free_run:
        console().print(
            f"its cameras run freely: that may be up to {found.resolution_ms:.0f} ms longer than needed, and what their"
            " readout takes"
        )


def _say_progress(done: float, text: str = "") -> None:
    typer.echo(f"{100 * done:3.0f} %  {text}", err=True)
