"""`unglare calibrations`: results that are kept for a rig and handed to later scans."""

from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.house import open_services, who
from backend.cli.options import AsJson, DataFolder
from backend.cli.output import answering, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.contract.scans import CalibrationView


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    group = typer.Typer(
        name="calibrations",
        help="Results that are kept for a rig; later scans with it get the newest.",
        no_args_is_help=True,
    )
    group.command("list")(list_calibrations)
    group.command("keep")(keep)
    group.command("withdraw")(withdraw)
    application.add_typer(group)


def list_calibrations(
    rig: Annotated[str | None, typer.Option(help="Only those of this rig.")] = None,
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """List what was ever kept, newest first."""
    quiet_logging()
    with answering(as_json) as answer, open_services(data) as services:
        found = services.calibrations(rig)
        answer["calibrations"] = [view.model_dump(mode="json") for view in found]
    if not as_json:
        _show(found)


def keep(
    scan: Annotated[str, typer.Argument(metavar="SCAN", help="Id of the scan.")],
    stage: Annotated[str, typer.Argument(metavar="STAGE", help="The stage whose result is kept.")],
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Keep a stage's result for the scan's rig."""
    from backend.domain.errors import ConflictError, NotFoundError

    quiet_logging()
    with answering(as_json) as answer, open_services(data) as services:
        state = services.scan(scan)
        runs = {s.name: s.stage_run for s in state.stages}
        if stage not in runs:
            raise NotFoundError(f"{state.method} has no stage {stage!r}; it has {', '.join(runs)}.")
        run = runs[stage]
        if run is None:
            raise ConflictError(f"{stage} has no result of its own in {scan}: run it first.")
        kept = services.keep(run, who())
        answer["calibration"] = kept.model_dump(mode="json")
    if not as_json:
        console().print(f"{kept.title} kept as calibration {kept.number} of rig {kept.rig}")


def withdraw(
    number: Annotated[
        int, typer.Argument(metavar="NUMBER", help="Number of the calibration.", min=1)
    ],
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Take a calibration back: no later scan gets it; scans that have it keep it."""
    quiet_logging()
    with answering(as_json) as answer, open_services(data) as services:
        taken = services.withdraw(number, who())
        answer["calibration"] = taken.model_dump(mode="json")
    if not as_json:
        console().print(f"calibration {number} withdrawn")


def _show(found: "tuple[CalibrationView, ...]") -> None:
    rows = table(">number", "what", "rig", "from scan", "stage", "by", "when", "")
    for view in found:
        note = "newest" if view.newest else ""
        if view.withdrawn_by:
            note = f"withdrawn by {view.withdrawn_by}"
        scan = f"{view.scan_name} ({view.scan})" if view.scan_name else view.scan
        when = f"{view.when:%Y-%m-%d %H:%M}"
        rows.add_row(str(view.number), view.type, view.rig, scan, view.stage, view.who, when, note)
    console().print(rows)
