"""`unglare rigs conform`: does a rig keep what the protocols promise."""

from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.house import Monitor, open_services
from backend.cli.options import AsJson, DataFolder, RigName, RigOptions, parse_rig_options
from backend.cli.output import ProgressLines, answering, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.services.conforming import Verdict


def conform(
    rig: RigName = "simulated",
    light: Annotated[
        bool,
        typer.Option("--light", help="The cameras see something that the projector lights."),
    ] = False,
    exposure_ms: Annotated[
        float,
        typer.Option(
            min=0.01, help="At which white gives a good picture: whole periods of the projector."
        ),
    ] = 50.0,
    rig_options: RigOptions = None,
    monitor: Monitor = None,
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Try a rig, and the drivers of its devices, by the suite that every rig has to pass."""
    from dataclasses import asdict

    from backend.services.conforming import conform

    quiet_logging()
    with answering(as_json) as answer:
        options = parse_rig_options(rig_options)
        with (
            open_services(data, rig=rig, monitor=monitor) as services,
            ProgressLines(hidden=as_json) as progress,
        ):
            found = conform(
                services.context,
                rig,
                options,
                progress.part("conformance"),
                light=light,
                exposure_ms=exposure_ms,
            )
        failed = [verdict for verdict in found if verdict.outcome == "failed"]
        answer.update({"rig": rig, "ok": not failed, "tests": [asdict(v) for v in found]})
        if not as_json:
            _show(found)
        if failed:
            answer["error"] = (
                f"Rig {rig} fails {len(failed)} of {len(found)} tests, the first is {failed[0].test}: {failed[0].why}"
            )


def _show(found: "tuple[Verdict, ...]") -> None:
    from rich.markup import escape

    rows = table("test", "outcome", "demands, or why not")
    for verdict in found:
        why = f" {verdict.why} ({verdict.where})" if verdict.where else f" {verdict.why}"
        rows.add_row(escape(verdict.test), verdict.outcome, escape(verdict.says + why.rstrip()))
    console().print(rows)
    counts = {o: sum(v.outcome == o for v in found) for o in ("passed", "failed", "skipped")}
    console().print(", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count))
