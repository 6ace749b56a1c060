"""`unglare import`, `export` and `replay`: captures that come, go, and are done again."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.house import open_services, who
from backend.cli.options import (
    AsJson,
    DataFolder,
    Quiet,
    Settings,
    parse_settings,
    with_uploads,
)
from backend.cli.output import Document, ProgressLines, answering, console, quiet_logging, table
from backend.cli.scanning import (
    Out,
    WithFrames,
    describe_scan,
    edit_settings,
    refuse_place,
    run_and_export,
    show_summary,
)

if TYPE_CHECKING:
    from backend.services.replaying import Replay

_Scan = Annotated[str, typer.Argument(metavar="SCAN", help="Id of the scan.")]


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command("import")(import_capture)
    application.command("export")(export_scan)
    application.command("replay")(replay)


def import_capture(
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE", help="capture.json or its folder, or a SOFAST measurement."
        ),
    ],
    name: Annotated[str, typer.Option(help="Name of the scan; else the capture's.")] = "",
    settings: Settings = None,
    run: Annotated[bool, typer.Option(help="Run the stages from the frames on.")] = True,
    out: Out = None,
    frames: WithFrames = False,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Import captured frames as a new scan, and run the method's stages from there on."""
    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        changes = parse_settings(settings)
        with open_services(data, progress) as services:
            refuse_place(services, out)
            state = services.import_capture(str(capture), name, who(), progress.part("import"))
            answer.update(describe_scan(state))
            edit_settings(services, state.id, with_uploads(services, state.method, changes))
            if run:
                run_and_export(services, state.id, answer, progress, out=out, frames=frames)
            progress.finish()
    if not as_json:
        show_summary(answer)


def export_scan(
    scan: _Scan,
    out: Annotated[Path, typer.Option(help="Folder that the files are written into.")],
    frames: WithFrames = False,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a scan's results into a folder."""
    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        with open_services(data) as services:
            files = services.export(scan, str(out), frames, who(), progress.part("export"))
        progress.finish()
        answer.update({"scan": scan, "files": [str(file) for file in files]})
    if not as_json:
        console().print(f"{len(files)} files written to {out}")


def replay(
    target: Annotated[
        str,
        typer.Argument(
            metavar="SCAN|FOLDER", help="Id of a scan, or a folder exported with frames."
        ),
    ],
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Do a scan again from its captured frames, and compare the results hash by hash."""
    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        is_folder = Path(target).exists()
        with open_services(data) as services:
            do = services.replay_folder if is_folder else services.replay
            found = do(target, lambda done, text="": progress.step(text.partition(" ")[0], done))
        progress.finish()
        answer.update(describe_replay(found))
        if not as_json:
            _show_replay(found)
        if not found.is_same:
            different = [s.name for s in found.stages if s.expected and not s.is_same]
            answer["error"] = (
                f"{found.name!r} came out otherwise from {different[0]} on: "
                f"{len(different)} of {len(found.stages)} results differ."
            )


def describe_replay(found: "Replay") -> Document:
    """Write a replay as JSON values."""
    return {
        "name": found.name,
        "same": found.is_same,
        "stages": [
            {
                "name": stage.name,
                "verdict": stage.verdict,
                "expected": stage.expected,
                "found": stage.found,
                "message": stage.message,
            }
            for stage in found.stages
        ],
        "changed_versions": {n: list(pair) for n, pair in found.changed_versions.items()},
    }


def _show_replay(found: "Replay") -> None:
    out = console()
    rows = table("stage", "result", "then", "now", "finding")
    for stage in found.stages:
        short = [(hash or "")[:12] for hash in (stage.expected, stage.found)]
        rows.add_row(stage.name, stage.verdict, *short, stage.message)
    out.print(rows)
    for program, (then, now) in found.changed_versions.items():
        out.print(f"{program} was {then} then and is {now} now")
