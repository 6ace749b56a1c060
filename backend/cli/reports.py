"""`unglare report`: tables and figures as the papers have them, for a rig or a scene."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.house import open_services
from backend.cli.options import (
    AsJson,
    DataFolder,
    ProjectorSize,
    Quiet,
    RigName,
    RigOptions,
    Scene,
    Seed,
    Size,
    parse_rig_options,
)
from backend.cli.output import Document, ProgressLines, answering, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.domain.shots import Progress
    from backend.services.context import Context
    from backend.services.report_document import Report

Out = Annotated[
    Path | None, typer.Option(help="Folder for report.html, the tables as CSV and the pictures.")
]
Make = Callable[["Context", "Progress"], "Report"]

_reports = typer.Typer(
    name="report",
    help="Tables and figures as the papers have them; writes CSV, pictures and a page.",
    no_args_is_help=True,
)


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.add_typer(_reports)


@_reports.command(name="table-i")
def table_i(
    out: Out = None,
    size: Size = None,
    projector_size: ProjectorSize = None,
    rig: RigName = "simulated",
    rig_options: RigOptions = None,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell what an error of the assumed height costs in projector pixels, from the rig's calibration."""
    from backend.services.table_i import table_i as make

    options = parse_rig_options(rig_options, size=size, projector_size=projector_size)
    _report(
        lambda context, progress: make(context, rig, options),
        out=out,
        data=data,
        as_json=as_json,
        quiet=quiet,
    )


@_reports.command(name="table-iv")
def table_iv(
    scene: Scene = "workpieces",
    out: Out = None,
    size: Size = None,
    projector_size: ProjectorSize = None,
    seed: Seed = None,
    rig: RigName = "simulated",
    rig_options: RigOptions = None,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compare a scene without mask at two exposures, under the mask, and sprayed: completeness and error per part."""
    from backend.services.table_iv import table_iv as make

    options = parse_rig_options(
        rig_options, scene=scene, size=size, projector_size=projector_size, seed=seed
    )
    _report(
        lambda context, progress: make(context, options, rig=rig, progress=progress),
        out=out,
        data=data,
        as_json=as_json,
        quiet=quiet,
    )


@_reports.command(name="masked-fringe")
def masked_fringe(
    scene: Scene = "metal",
    out: Out = None,
    size: Size = None,
    projector_size: ProjectorSize = None,
    seed: Seed = None,
    rig: RigName = "simulated",
    rig_options: RigOptions = None,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compare fringes without mask, under the mask, and under bands of epipolar lines: completeness and error per part."""
    from backend.services.masked_fringe_report import masked_fringe_report as make

    options = parse_rig_options(
        rig_options, scene=scene, size=size, projector_size=projector_size, seed=seed
    )
    _report(
        lambda context, progress: make(context, options, rig=rig, progress=progress),
        out=out,
        data=data,
        as_json=as_json,
        quiet=quiet,
    )


@_reports.command(name="edge-tolerance")
def edge_tolerance(
    out: Out = None,
    draws: Annotated[int, typer.Option(min=100, help="Random edges per gap.")] = 20_000,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell over which saturated gap a stripe's edge can be extrapolated: the error over the gap's width."""
    from backend.services.edge_tolerance import edge_tolerance as make

    _report(
        lambda context, progress: make(draws=draws, seed=seed),
        out=out,
        data=data,
        as_json=as_json,
        quiet=quiet,
    )


def _report(make: Make, *, out: Path | None, data: Path | None, as_json: bool, quiet: bool) -> None:
    """Make a report, write it, show it."""
    from backend.services.report_document import refuse_report_folder

    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        if out is not None:
            refuse_report_folder(out)
        with open_services(data) as services:
            found = make(services.context, lambda done, text="": progress.step(text, 0.0))
        progress.finish()
        answer.update(written_report(found, out))
    if not as_json:
        show_report(found, out)


def written_report(report: "Report", folder: Path | None) -> Document:
    """Write a report into its folder, if there is one, and return the command's answer."""
    from backend.services.report_document import write_report

    files = write_report(folder, report) if folder is not None else ()
    return {**report.document(), "files": [str(file) for file in files]}


def show_report(report: "Report", folder: Path | None) -> None:
    """Print tables and sentences, and where the report was written."""
    out = console()
    out.print(report.title)
    for shown in report.tables:
        numbers = {
            column.name: any(isinstance(row.get(column.name), int | float) for row in shown.rows)
            for column in shown.columns
        }
        titles = [f">{c.title}" if numbers[c.name] else c.title for c in shown.columns]
        rows = table(*titles, title=shown.title)
        for row in shown.rows:
            rows.add_row(*(column.words(row.get(column.name)) for column in shown.columns))
        out.print(rows)
    for text in (*report.findings, *report.introduction):
        out.print(text)
    if folder is not None:
        out.print(f"page, tables and pictures are in {folder}")
