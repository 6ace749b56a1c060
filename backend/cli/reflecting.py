"""`unglare reflect`: a captured reflection, from its file to slopes, surface and figures in one go."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from backend.cli.house import open_services, who
from backend.cli.options import AsJson, DataFolder, Quiet, Settings, parse_settings, with_uploads
from backend.cli.output import Document, ProgressLines, answering, console, quiet_logging, table
from backend.cli.scanning import (
    WithFrames,
    describe_scan,
    edit_settings,
    refuse_place,
    run_and_export,
)

SUMMARY = "summary.json"
_PROCESSING = ("screen_phase", "slopes", "surface", "mirror_cloud")


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(reflect)


def reflect(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="SOFAST measurement (.npz, .h5, or a folder of them), or a capture.json or its folder.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for result.npz, summary.json, cloud.ply, surface.csv, surface.h5 and maps."
        ),
    ],
    name: Annotated[str, typer.Option(help="Name of the scan; else the measurement's.")] = "",
    settings: Settings = None,
    frames: WithFrames = False,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure a mirror from captured fringes: slopes, focal lengths, surface; the scan stays for the browser."""
    from backend.numerics.warm_up import MIRROR, warm_up

    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        changes = parse_settings(settings)
        with open_services(data, progress) as services:
            refuse_place(services, out)
            state = services.import_capture(str(file), name, who(), progress.part("import"))
            answer.update(describe_scan(state))
            # So that the time taken is that of the measurement, not of loading its tools.
            warm_up(MIRROR)
            edit_settings(services, state.id, with_uploads(services, state.method, changes))
            run_and_export(services, state.id, answer, progress, out=out, frames=frames)
            if answer.get("error"):
                # Fringes that can't become slopes are still phases.
                services.export(state.id, str(out), False, who(), progress.part("export"))
            progress.finish()
        answer.update(_summary(answer, out))
    if not as_json:
        _show(answer, out)


def _summary(answer: Document, out: Path) -> Document:
    """Return the figures that the export holds, the sentences of the checks, and the time taken."""
    took = {s["name"]: s["duration_s"] for s in answer["stages"] if s["name"] in _PROCESSING}
    found: Document = {"time_s": round(sum(t or 0.0 for t in took.values()), 4), "times_s": took}
    file = out / SUMMARY
    if file.is_file():
        found |= json.loads(file.read_text(encoding="utf-8"))
    found["findings"] = [
        check["sentence"]
        for stage in answer["stages"]
        for check in stage["checks"]
        if check["level"] != "ok"
    ]
    return found


def _show(answer: Document, out: Path) -> None:
    rows = table("figure", ">x", ">y")
    for title, key, form in (
        ("focal length, m", "focal_lengths_m", ".2f"),
        ("slopes, rms, mrad", "rms_slopes_mrad", ".3f"),
    ):
        if answer.get(key):
            rows.add_row(title, *(_number(v, form) for v in answer[key]))
    ripple: dict[str, dict[str, Any]] = answer.get("ripple_mrad", {})
    for periods in ripple.get("x") or ripple.get("y") or {}:
        values = [_number(ripple.get(axis, {}).get(periods), ".2f") for axis in ("x", "y")]
        rows.add_row(f"ripple of {periods} periods, mrad", *values)
    console().print(rows)
    for sentence in answer["findings"]:
        console().print(sentence)
    console().print(f"processed in {answer['time_s']:.2f} s, written to {out}")


def _number(value: float | None, form: str) -> str:
    return "" if value is None else f"{value:{form}}"
